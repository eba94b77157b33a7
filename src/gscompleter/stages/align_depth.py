"""Stage 3, coarse: one affine depth correction for all lifted Gaussians (paper, Sec. III-E)."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.config import AlignmentConfig
from gscompleter.numerics.robust import find_affine_inliers, fit_line_ransac
from gscompleter.stages.target_view import TargetView
from gscompleter.system.timing import timed_stage
from gscompleter.types import DepthAffine, DepthMap, DepthPairs, Lift

MAX_PIXELS = 8192
"""Pixels that hypotheses are scored on; of more, a random sample is used."""
MIN_INLIERS = 0.3
"""Smallest inlier fraction of a reliable fit."""
MIN_PIXELS = 64
"""Fewest comparable pixels that a fit needs."""
MAX_PAIRS = 1000
"""Most compared depths that are kept as a sample."""
MIN_DEPTH_SPREAD = 0.05
"""Smallest (p95 - p5) / median of depths that separates scale and shift.
Below, only a scale is fitted."""


def fit_affine(predicted: DepthMap, context: DepthMap, rng: torch.Generator) -> DepthAffine:
    """Fit `context ≈ scale * predicted + shift` by RANSAC over valid pixels (paper, Eq. 8).

    The fallback is the median ratio with shift 0, and the identity if nothing can be compared.
    """
    x, y = pair_depths(predicted, context)
    if len(x) < MIN_PIXELS:
        return DepthAffine()
    if len(x) > MAX_PIXELS:
        sample = torch.randperm(len(x), generator=rng)[:MAX_PIXELS]
        x, y = x[sample], y[sample]

    # In a flat view, such as a wall from the front, scale and shift cannot be told apart.
    low, median, high = x.quantile(x.new_tensor([0.05, 0.5, 0.95])).tolist()
    if (high - low) / median >= MIN_DEPTH_SPREAD:
        scale, shift = fit_line_ransac(x, y, rng, predicted.depth.device)
        inliers = find_affine_inliers(x, y, scale, shift).double().mean().item()
        if scale > 0 and inliers >= MIN_INLIERS:
            return DepthAffine(scale, shift, inliers, "ransac")

    scale = (y / x).median().item()
    inliers = find_affine_inliers(x, y, scale, 0.0).double().mean().item()
    return DepthAffine(scale, 0.0, inliers, "median")


def pair_depths(
    predicted: DepthMap, context: DepthMap
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Return both z-depths at the pixels where both are valid, on the CPU.

    A fit reads so many numbers that the host would wait for a GPU dozens of times. So it gets both
    maps in one copy, and gives back what takes a GPU (the scores of hypotheses).
    """
    comparable = predicted.valid & context.valid & (predicted.depth > 0) & (context.depth > 0)
    depths = torch.stack([predicted.depth, context.depth]).where(comparable, 0.0).cpu()
    x, y = depths[:, depths[0] > 0].double()
    return x, y


@timed_stage("register")
def align_depth(lift: Lift, view: TargetView, rng: torch.Generator) -> DepthAffine:
    """Fit the affine depth correction at the anchor (the paper's bridge) or at the target.

    The context has holes at the target, but the part that is visible there can contradict the
    anchor.
    """
    config = view.state.config.alignment
    if config.align_at == "none":
        return DepthAffine()

    # Pairs of D_pred, as Ψ lifted it, and D_ctx, as the scene is rendered.
    at_target = (lift.reference_depth, view.render.depth_map())
    at_anchor = (lift.anchor_depth, view.anchor_render.depth_map())
    if config.align_at == "target":
        affine = fit_affine(*at_target, rng)
    else:
        affine = refit_at_target(fit_affine(*at_anchor, rng), *at_target, rng, config)
    if config.align_at == "target" or affine.is_refitted_at_target:
        return replace(affine, pairs=sample_depth_pairs("target", *at_target, affine))
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
    if len(x) < MIN_PIXELS:
        return affine
    agree = find_affine_inliers(x, y, affine.scale, affine.shift).double().mean().item()
    affine = replace(affine, agreement=agree, coverage=len(x) / context.depth.numel())
    if agree >= config.min_agreement:
        return affine
    refitted = fit_affine(predicted, context, rng)
    if refitted.inliers < max(MIN_INLIERS, 2 * agree):
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
    step = max(1, -(-len(x) // MAX_PAIRS))
    x, y = x[::step], y[::step]
    inlier_mask = find_affine_inliers(x, y, affine.scale, affine.shift)
    # All tensors of a completion lie on one device.
    device = predicted.depth.device
    x, y, inlier_mask = (part.to(device, non_blocking=True) for part in (x, y, inlier_mask))
    return DepthPairs(fit_view, x, y, inlier_mask)
