"""Depth that a monocular network predicts, as an observation where stereo measures nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gscompleter.numerics.robust import find_affine_inliers, fit_line_ransac
from gscompleter.reconstructors.plane_sweep.sweep import (
    Measurement,
    compute_inverse_depth,
    compute_plane_index,
)
from gscompleter.types import DepthMap

MIN_CONFIDENCE = 0.5
"""Confidence from which a measured pixel takes part in the alignment."""
MIN_PIXELS = 200
"""Fewest pixels for an alignment; with fewer, nothing of the prediction is used."""
MAX_PIXELS = 8192
"""Most pixels of an alignment, evenly spaced among all."""
MIN_INLIERS = 0.3
"""Smallest share of pixels that a used prediction fits."""
WEIGHT = np.float32(0.1)
"""Weight of a predicted pixel in the surface fit; a confident measurement has 1."""


def add_prediction(measured: Measurement, predicted: DepthMap) -> Measurement:
    """Use predicted depth where stereo measured nothing, aligned to the confident pixels.

    RANSAC fits one affine function of inverse depth, up to which monocular depth is right.
    """
    valid = predicted.valid.cpu().numpy()
    full = measured.resize_to(valid.shape)
    guess = np.where(valid, 1 / predicted.depth.cpu().numpy().clip(1e-9), 0)
    sure = np.flatnonzero(valid & (full.confidence >= MIN_CONFIDENCE))
    if len(sure) < MIN_PIXELS:
        return measured

    # Inverse depths of every n-th confident pixel: x predicted, y measured.
    sample = sure[:: -(-len(sure) // MAX_PIXELS)]
    inverse_measured = compute_inverse_depth(full.planes, full.index)
    x = torch.from_numpy(guess.ravel()[sample]).double()
    y = torch.from_numpy(inverse_measured.ravel()[sample]).double()
    scale, shift = fit_line_ransac(x, y, torch.Generator().manual_seed(0))
    if find_affine_inliers(x, y, scale, shift).double().mean() < MIN_INLIERS:
        return measured

    # At most twice as far as the far plane; the shift may bring inverse depths to 0 and below.
    inverse = np.maximum(scale * guess + shift, full.planes[0] / 2).astype(np.float32)
    empty = valid & (full.weight == 0)
    index = np.where(empty, compute_plane_index(full.planes, inverse), full.index)
    return replace(full, index=index, weight=np.where(empty, WEIGHT, full.weight))
