"""The commands, a file each, and what they can be told."""
