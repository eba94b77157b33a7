"""The correction of depth for what photographs show and a scene lacks (in place of Eq. 8).

The paper fits scale and shift at one image, and moves by it what stands in the same depths. What a
scene lacks may stand anywhere: a shift that far walls fit by a hair moves what stands before them.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from gscompleter.numerics.robust import find_affine_inliers, fit_line_ransac, fit_scale
from gscompleter.stages.align_paper import (
    MAX_SCORED_PIXELS,
    MIN_DEPTH_SPREAD,
    MIN_FIT_PIXELS,
    pair_depths,
)
from gscompleter.types import DepthAffine, DepthMap

MIN_GAIN_OF_SHIFT = 0.1
"""Share of the compared pixels that a shift has to explain beyond those that a scale explains.

With a Ψ that has the scale of the cameras it explained at most 0.05 more in all scenes, and with
drawn errors of a network at most 0.05, too."""


def align_photographs(
    predicted: Sequence[DepthMap], scene: Sequence[DepthMap], rng: torch.Generator
) -> DepthAffine:
    """Fit one correction `scene ≈ scale * predicted` to all photographs of one reconstruction.

    A shift is fitted, too, only where a scale does not explain the depths: where it is not
    determined, it moves nothing at the depths that are compared, and everything elsewhere. A
    photograph of a fox, with 0.93 of its pixels explained by a scale, had an affine of scale 0.71
    and shift 0.88 for all of them, which cost 2.3 dB at photographs kept back. Of what is compared
    at one photograph, little may tell; Ψ saw all of them, so they share its errors, and what two of
    them show stays in one place.

    `scene` is the depth of the scene at these photographs, valid where it is to be compared. The
    identity is returned if nothing can be compared.
    """
    pairs = [pair_depths(*maps) for maps in zip(predicted, scene, strict=True)]
    x, y = (torch.cat(depths) for depths in zip(*pairs, strict=True))
    if len(x) < MIN_FIT_PIXELS:
        return DepthAffine()
    if len(x) > MAX_SCORED_PIXELS:
        sample = torch.randperm(len(x), generator=rng)[:MAX_SCORED_PIXELS]
        x, y = x[sample], y[sample]

    scale = fit_scale(x, y)
    inliers = find_affine_inliers(x, y, scale, 0.0).double().mean().item()
    by_scale = DepthAffine(scale, 0.0, inliers, "median")
    low, median, high = x.quantile(x.new_tensor([0.05, 0.5, 0.95])).tolist()
    if inliers > 1 - MIN_GAIN_OF_SHIFT or (high - low) / median < MIN_DEPTH_SPREAD:
        return by_scale
    scale, shift = fit_line_ransac(x, y, rng, predicted[0].depth.device)
    inliers = find_affine_inliers(x, y, scale, shift).double().mean().item()
    if scale <= 0 or inliers < by_scale.inliers + MIN_GAIN_OF_SHIFT:
        return by_scale
    return DepthAffine(scale, shift, inliers, "ransac")
