"""Which cameras: the targets to complete next, and the photographs that are their context."""
