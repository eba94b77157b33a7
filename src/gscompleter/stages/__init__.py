"""The four stages of the paper, a file each, in its order."""
