"""Alignment of an input splat with the photographs it was trained on."""
