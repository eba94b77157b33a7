"""Stage 3, coarse: one affine depth correction for all lifted Gaussians, as we choose it.

Eq. 8 itself, with all that acts in `paper()`, is in `align_paper.py`. Here is what we add, a check
at the target and a second fit there, and the ablations that fit elsewhere or nowhere (`align_at`).
Depths are z-depths in scene units.
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
    ComparedDepths,
    compare_at_anchor,
    compare_depth_maps,
    fit_affine,
)
from gscompleter.stages.select_anchor import Anchor
from gscompleter.stages.target_view import TargetView
from gscompleter.system.timing import timed_stage
from gscompleter.types import DepthAffine, DepthPairs, Lift

MIN_AGREEMENT_RATIO = 2.0
"""Smallest agreement of a fit at the target, relative to that of the fit at the anchor, to replace
it: it is fitted to what it is judged by, and agrees a little more with any depths."""
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

    at_target = compare_depth_maps(lift.reference_depth, view.depth)
    if config.align_at == "target":
        affine = fit_affine(at_target, rng)
        return replace(affine, pairs=sample_depth_pairs("target", at_target, affine))
    at_anchor = compare_at_anchor(lift, anchor)
    affine = refit_at_target(fit_affine(at_anchor, rng), at_target, rng, config)
    if affine.is_refitted_at_target:
        return replace(affine, pairs=sample_depth_pairs("target", at_target, affine))
    return replace(affine, pairs=sample_depth_pairs("anchor", at_anchor, affine))


def refit_at_target(
    affine: DepthAffine,
    at_target: ComparedDepths,
    rng: torch.Generator,
    config: AlignmentConfig,
) -> DepthAffine:
    """Replace an affine that contradicts the context at the target by a fit at the target.

    With little overlap or pose drift, Ψ's two depth maps differ in scale. If no fit at the target
    is clearly better, the paper's choice stays. Either way the result tells how much of the context
    at the target agrees with it, unless too few pixels can be compared.
    """
    if len(at_target) < MIN_FIT_PIXELS:
        return affine
    x = at_target.predicted
    y = at_target.context
    agree = find_affine_inliers(x, y, affine.scale, affine.shift).double().mean().item()
    affine = replace(affine, agreement=agree, coverage=len(x) / at_target.num_pixels)
    if agree >= config.min_agreement:
        return affine
    refitted = fit_affine(at_target, rng)
    if refitted.inliers < max(MIN_INLIER_SHARE, MIN_AGREEMENT_RATIO * agree):
        return affine
    return replace(
        refitted,
        agreement=refitted.inliers,
        coverage=affine.coverage,
        is_refitted_at_target=True,
    )


def sample_depth_pairs(
    fit_view: Literal["anchor", "target"], depths: ComparedDepths, affine: DepthAffine
) -> DepthPairs:
    """Sample the depths that `affine` was fitted to, at even steps."""
    # Rounded up, so that there are at most as many.
    step = max(1, -(-len(depths) // MAX_DEPTH_PAIRS))
    x = depths.predicted[::step]
    y = depths.context[::step]
    inlier_mask = find_affine_inliers(x, y, affine.scale, affine.shift)
    # Depths are compared on the CPU, and all tensors of a completion lie on one device.
    x, y, inlier_mask = (part.to(depths.device, non_blocking=True) for part in (x, y, inlier_mask))
    return DepthPairs(fit_view, x, y, inlier_mask)
