"""Readers for posed photographs in every supported format."""
