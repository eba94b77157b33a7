"""Applications on the method: commands, reports, viewer, live and batch."""
