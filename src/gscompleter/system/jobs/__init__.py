"""Independent jobs, resumable and shared by processes and machines."""
