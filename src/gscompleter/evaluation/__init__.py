"""Runs of methods over tasks: protocols, resuming, saved results and scores."""
