"""What a reader is shown: the files of a completion, tables and plots of a run."""
