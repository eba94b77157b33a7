"""Applications on the method: commands, reports, viewer, live, batch and bench."""
