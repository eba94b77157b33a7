"""Other completion methods, for comparison only."""
