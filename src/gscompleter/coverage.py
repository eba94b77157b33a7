"""When a scene covers a pixel."""

COVERED = 0.5
"""Alpha from which a pixel is covered, by half: its rendered depth means something, and it is no
hole unless `holes.max_alpha` asks for more (τ of Eq. 12)."""
