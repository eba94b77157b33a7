"""What a completion takes on this machine: time, memory, and how both grow."""
