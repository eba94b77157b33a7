"""Commands, one per file. They raise InputError for errors that the user can correct."""
