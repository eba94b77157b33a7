"""Time and memory of a completion on this machine, and their growth."""
