"""Threshold of alpha at which a pixel counts as covered."""

COVERED = 0.5
"""Alpha from which a pixel is covered, unless `holes.max_alpha` (τ of Eq. 12) demands more."""
