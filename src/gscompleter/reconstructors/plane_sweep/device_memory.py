"""Bytes that plane-sweep takes on a GPU, by formula."""

from __future__ import annotations

import math
from collections.abc import Sequence

from gscompleter.numerics.tensor_tgv import FIT_BYTES
from gscompleter.reconstructors.plane_sweep.gaussians import DISC_BYTES
from gscompleter.reconstructors.plane_sweep.matching import estimate_group_bytes
from gscompleter.reconstructors.plane_sweep.sweep import MAX_PLANES


def estimate_sweep_bytes(sizes: Sequence[tuple[int, int]]) -> int:
    """Estimate the most bytes that the reconstruction of photographs takes on a GPU at once.

    `sizes` are their heights and widths in pixels. Planes are as many as there may be, and of what
    is built little is fitted: the discs of all pixels are made before what is lacking is selected.
    """
    pixels = [math.prod(size) for size in sizes]
    searching = estimate_group_bytes(sizes, MAX_PLANES)
    # Maps are fitted one after the other.
    smoothing = FIT_BYTES * max(pixels)
    splatting = DISC_BYTES * sum(pixels)
    return max(searching, smoothing, splatting)
