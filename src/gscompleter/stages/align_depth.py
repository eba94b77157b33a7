"""Stage 3, coarse: one affine depth correction for all lifted Gaussians, as we choose it.

Eq. 8 itself, with all that acts in `paper()`, is in `align_paper.py`. Here is what we add, a check
at the target and a second fit there, and the ablations that fit elsewhere or nowhere (`align_at`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch

from gscompleter.config import AlignmentConfig
from gscompleter.numerics.robust import find_affine_inliers
from gscompleter.stages.align_paper import (
    MIN_FIT_PIXELS,
    MIN_INLIER_SHARE,
    align_as_paper,
    fit_affine,
    pair_depths,
)
from gscompleter.stages.select_anchor import Anchor
from gscompleter.stages.target_view import TargetView
from gscompleter.system.timing import timed_stage
from gscompleter.types import DepthAffine, DepthMap, DepthPairs, Lift

MAX_DEPTH_PAIRS = 1000
"""Most compared depths that are kept as a sample."""


@timed_stage("register")
def align_depth(lift: Lift, anchor: Anchor, view: TargetView, rng: torch.Generator) -> DepthAffine:
    """Fit the affine depth correction at the anchor (the paper's bridge) or at the target.

    The context has holes at the target, but the part that is visible there can contradict the
    anchor.
    """
    config = view.state.config.alignment
    if config.align_at == "none":
        return DepthAffine()

    # Pairs of D_pred, as Ψ lifted it, and D_ctx, as the scene is rendered.
    at_target = (lift.reference_depth, view.render.depth_map())
    if config.align_at == "target":
        affine = fit_affine(*at_target, rng)
    else:
        affine = refit_at_target(align_as_paper(lift, anchor, rng), *at_target, rng, config)
    if config.align_at == "target" or affine.is_refitted_at_target:
        return replace(affine, pairs=sample_depth_pairs("target", *at_target, affine))
    at_anchor = (lift.anchor_depth, anchor.render.depth_map())
    return replace(affine, pairs=sample_depth_pairs("anchor", *at_anchor, affine))


def refit_at_target(
    affine: DepthAffine,
    predicted: DepthMap,
    context: DepthMap,
    rng: torch.Generator,
    config: AlignmentConfig,
) -> DepthAffine:
    """Replace an affine that contradicts the context at the target by a fit at the target.

    With little overlap or pose drift, Ψ's two depth maps differ in scale. If no fit at the target
    is better, the paper's choice stays.
    """
    x, y = pair_depths(predicted, context)
    if len(x) < MIN_FIT_PIXELS:
        return affine
    agree = find_affine_inliers(x, y, affine.scale, affine.shift).double().mean().item()
    affine = replace(affine, agreement=agree, coverage=len(x) / context.depth.numel())
    if agree >= config.min_agreement:
        return affine
    refitted = fit_affine(predicted, context, rng)
    if refitted.inliers < max(MIN_INLIER_SHARE, 2 * agree):
        return affine
    return replace(refitted, agreement=refitted.inliers, is_refitted_at_target=True)


def sample_depth_pairs(
    fit_view: Literal["anchor", "target"],
    predicted: DepthMap,
    context: DepthMap,
    affine: DepthAffine,
) -> DepthPairs:
    """Sample the depths that `affine` was fitted to."""
    x, y = pair_depths(predicted, context)
    step = max(1, -(-len(x) // MAX_DEPTH_PAIRS))
    x, y = x[::step], y[::step]
    inlier_mask = find_affine_inliers(x, y, affine.scale, affine.shift)
    # All tensors of a completion lie on one device.
    device = predicted.depth.device
    x, y, inlier_mask = (part.to(device, non_blocking=True) for part in (x, y, inlier_mask))
    return DepthPairs(fit_view, x, y, inlier_mask)
