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
    compare_depth_maps,
)
from gscompleter.types import DepthAffine, DepthMap

MIN_GAIN_OF_SCALE = 0.1
"""Share of the compared pixels that a scale has to explain beyond the identity.

With `plane-sweep` it was at most 0.07 in twelve of fourteen scenes of two photographs; in the other
two their depth was off by 5 and 36 %. With drawn errors of a network it was 0.2 to 0.9 in most."""
MIN_GAIN_OF_SHIFT = 0.25
"""Share of them that a shift has to explain beyond a scale.

In all of these cases it was at most 0.09, and 0.15 in a coarse synthetic room where Ψ is right."""


def align_photographs(
    predicted: Sequence[DepthMap], scene: Sequence[DepthMap], rng: torch.Generator
) -> DepthAffine:
    """Fit one correction `scene ≈ scale * predicted + shift` to all photographs together.

    It is the identity, a scale, or an affine; each has to explain clearly more than what is
    simpler. Ψ knows the cameras, so that its depth has their scale unless the scene clearly
    contradicts it. Rendered depth is off by itself where a surface is seen at a grazing angle, and
    additions in their place gained 15 to 20 dB in a coarse synthetic room.

    A shift is the least certain: where it hardly matters to what is compared, it moves what stands
    before that. For 1 % of a far wall a crate moved by 5 to 8 %. A photograph of a fox got scale
    0.71 and shift 0.88, which cost 2.4 dB at photographs kept back. Ψ saw all photographs, so that
    they share its errors, and what two of them show has to stay in one place.

    `scene` is the depth of the scene at these photographs, valid where it is to be compared.
    """
    compared = [compare_depth_maps(*maps) for maps in zip(predicted, scene, strict=True)]
    x = torch.cat([depths.predicted for depths in compared])
    y = torch.cat([depths.context for depths in compared])
    if len(x) < MIN_FIT_PIXELS:
        return DepthAffine()
    if len(x) > MAX_SCORED_PIXELS:
        sample = torch.randperm(len(x), generator=rng)[:MAX_SCORED_PIXELS]
        x, y = x[sample], y[sample]

    def count(scale: float, shift: float = 0.0) -> float:
        return find_affine_inliers(x, y, scale, shift).double().mean().item()

    chosen = DepthAffine(inliers=count(1.0))
    scale = fit_scale(x, y)
    scaled = DepthAffine(scale, 0.0, count(scale), "median")
    if scaled.inliers >= chosen.inliers + MIN_GAIN_OF_SCALE:
        chosen = scaled
    low, median, high = x.quantile(x.new_tensor([0.05, 0.5, 0.95])).tolist()
    if (high - low) / median < MIN_DEPTH_SPREAD:
        return chosen
    scale, shift = fit_line_ransac(x, y, rng, predicted[0].depth.device)
    if scale > 0 and count(scale, shift) >= scaled.inliers + MIN_GAIN_OF_SHIFT:
        chosen = DepthAffine(scale, shift, count(scale, shift), "ransac")
    return chosen
