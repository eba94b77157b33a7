"""A sample of the depths that the affine was fitted to, for the report."""

from __future__ import annotations

from gscompleter.config import AlignmentConfig
from gscompleter.stages.alignment import find_affine_inliers, pair_depths
from gscompleter.types import DepthAffine, DepthPairs, Lift, Render

MAX_PAIRS = 1000
"""Most pixels in the sample."""


def sample_depth_pairs(
    lift: Lift, at_target: Render, at_anchor: Render, affine: DepthAffine, config: AlignmentConfig
) -> DepthPairs | None:
    """Sample the depths that `affine` was fitted to; None if there are none."""
    if config.align_at == "none":
        return None
    at_the_target = config.align_at == "target" or affine.is_refitted_at_target
    predicted, render = lift.anchor_depth, at_anchor
    if at_the_target:
        predicted, render = lift.reference_depth, at_target
    x, y = pair_depths(predicted, render.depth_map())
    step = max(1, -(-len(x) // MAX_PAIRS))
    x, y = x[::step], y[::step]
    if len(x) == 0:
        return None
    agrees = find_affine_inliers(x, y, affine.scale, affine.shift)
    return DepthPairs("target" if at_the_target else "anchor", x, y, agrees)
