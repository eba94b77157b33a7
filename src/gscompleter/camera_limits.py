"""Bounds that every real camera keeps, of files and of `Camera` alike.

Files hold float64 and the pipeline uses float32, where 1e300 is infinity and 1e-300 is zero. The
bounds admit squares and quotients of the numbers.
"""

MAX_SIDE = 16_384
"""Largest width or height of an image, in pixels."""
MAX_COORDINATE = 1e9
"""Largest coordinate of a camera centre, in scene units."""
FOCAL_RANGE = (1e-3, 1e6)
"""Range of focal lengths, in image widths (or heights)."""
MAX_CENTER = 100.0
"""Largest distance of the principal point from the corner, in image widths (or heights)."""
