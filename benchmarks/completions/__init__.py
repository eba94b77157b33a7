"""Time and memory of completions: cases, measurements and their tables."""
