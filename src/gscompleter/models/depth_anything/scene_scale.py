"""Estimation of the scene unit in metres from common features."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from gscompleter.numerics.geometry import sample
from gscompleter.reconstructors.features.depth_range import MIN_RANGE_MATCHES
from gscompleter.reconstructors.features.matches import triangulate
from gscompleter.reconstructors.features.neighbours import find_neighbours
from gscompleter.reconstructors.features.stereo_image import make_stereo_images
from gscompleter.system.errors import InputError
from gscompleter.types import DepthMap, View


def estimate_units_per_metre(views: Sequence[View], metres: Sequence[DepthMap]) -> float:
    """Estimate scene units per metre: the median over features that two photographs share.

    Raises:
        InputError: Too few features have a depth in `metres`.
    """
    images, unit = make_stereo_images(views)
    neighbours = find_neighbours(images)
    ratios = [np.zeros(0)]
    for i, j in neighbours.pairs:
        a, b = neighbours.matches[i, j]
        if len(a) == 0:
            continue
        # From each of the two photographs: a feature has its own depth in both.
        for one, two, at, to in ((i, j, a, b), (j, i, b, a)):
            inverse, good = triangulate(images[one], images[two], at, to)
            known = sample_depths(metres[one], at)
            good &= known > 0
            # Triangulated inverse depths are in the unit of `make_stereo_images`.
            ratios.append(unit / (inverse[good] * known[good]))

    all_ratios = np.concatenate(ratios)
    if len(all_ratios) < MIN_RANGE_MATCHES:
        raise InputError(
            f"The photographs share {len(all_ratios)} features of known depth, and the scale of "
            f"the scene needs {MIN_RANGE_MATCHES}; choose another reconstructor, or frames with "
            "more overlap."
        )
    return float(np.median(all_ratios))


def sample_depths(depth: DepthMap, pixels: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k"]:
    """Sample z-depth at pixel coordinates; 0 if invalid."""
    known = (depth.depth * depth.valid).cpu()[..., None]
    return sample(known, torch.from_numpy(pixels).float(), "nearest")[..., 0].double().numpy()
