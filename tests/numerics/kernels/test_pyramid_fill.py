"""Means of a pyramid at single pixels are those of whole images."""

import cv2
import numpy as np
import pytest

from gscompleter.numerics.kernels.pyramid_fill import MIN_LEVEL_WEIGHT, build_pyramid, compute_means
from gscompleter.numerics.smooth import build_sum_pyramid


def whole_images(levels):
    """Enlarge every level to the image, taking missing values from the level above."""
    h, w = levels[0].shape[:2]
    total = levels[0].sum(axis=(0, 1))
    wider, found = np.broadcast_to(total[:-1] / total[-1], (h, w, len(total) - 1)), []
    for level in reversed(levels):
        planes = [cv2.resize(plane, (w, h)) for plane in np.moveaxis(level, -1, 0)]
        sums = np.stack(planes, axis=-1)
        own = sums[..., :-1] / np.maximum(sums[..., -1:], 1e-12)
        wider = np.where(sums[..., -1:] > MIN_LEVEL_WEIGHT, own, wider)
        found.append(wider)
    return np.stack(found[::-1])


@pytest.mark.parametrize("channels", [1, 4])
@pytest.mark.parametrize("size", [(61, 90), (64, 48), (5, 7)])
def test_means_at_pixels_are_those_of_whole_images(size, channels):
    rng = np.random.default_rng(0)
    weight = (rng.random(size) < 0.01).astype(np.float32)
    weight[:4, :3] = 1
    values = rng.random((*size, channels), np.float32)
    weighted = np.concatenate([values * weight[..., None], weight[..., None]], axis=-1)
    levels = build_sum_pyramid(weighted)
    pixels = np.argwhere(weight >= 0)
    level = rng.uniform(0, len(levels) - 1, len(pixels))
    below = level.astype(int)
    above, share = np.minimum(below + 1, len(levels) - 1), (level - below)[:, None]
    plain = whole_images(levels)
    rows, columns = pixels.T
    expected = (1 - share) * plain[below, rows, columns] + share * plain[above, rows, columns]
    found = compute_means(build_pyramid(levels), pixels, level)
    assert np.abs(found - expected).max() < 1e-5
    assert np.ptp(expected) > 0.01
