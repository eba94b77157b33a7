"""Independent jobs: claimed, done once, resumed, shared among processes and machines."""
