"""Stage 3, coarse: one affine depth correction for all that was lifted (paper, Sec. III-E)."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import AlignmentConfig, DepthAgreementConfig
from gscompleter.types import DepthAffine, DepthMap, Lift, Render

MAX_TRIALS = 512
"""Two-point hypotheses."""
AT_ONCE = 32
"""Of them that are scored at once: so few that their residuals stay in the cache."""
MAX_PIXELS = 8192
"""Pixels the hypotheses are scored on, drawn at random where there are more."""
RESIDUAL_THRESHOLD = 0.05
"""Largest residual of an inlier, relative to the context depth."""
MIN_INLIERS = 0.3
"""Smallest share of inliers that makes a fit trustworthy."""
MIN_PIXELS = 64
"""Fewest comparable pixels; under it there is nothing to fit."""
MIN_SEEN = 0.01
"""Share of its image that the target must see of the scene, before this can refute an affine."""
MIN_DEPTH_SPREAD = 0.05
"""Smallest spread of the predicted depths ((p95 - p5) / median) that tells scale and shift apart;
under it only a scale is fitted."""


def fit_affine(predicted: DepthMap, context: DepthMap, rng: torch.Generator) -> DepthAffine:
    """Robust `context ≈ scale * predicted + shift` over pixels valid in both (paper, Eq. 8).

    Where RANSAC cannot be trusted (few pixels, hardly any range of depth, few inliers) the median
    ratio with shift 0 takes its place, and the identity where there is nothing to compare; which
    of them was used is part of the result.
    """
    x, y = compared(predicted, context)
    if len(x) < MIN_PIXELS:
        return DepthAffine()
    if len(x) > MAX_PIXELS:
        drawn = torch.randperm(len(x), generator=rng)[:MAX_PIXELS].to(x.device)
        x, y = x[drawn], y[drawn]

    if depth_spread(x) >= MIN_DEPTH_SPREAD:
        scale, shift = ransac_line(x, y, rng)
        inliers = affine_inliers(x, y, scale, shift).double().mean().item()
        if scale > 0 and inliers >= MIN_INLIERS:
            return DepthAffine(scale, shift, inliers, "ransac")

    scale = (y / x).median().item()
    inliers = affine_inliers(x, y, scale, 0.0).double().mean().item()
    return DepthAffine(scale, 0.0, inliers, "median")


def compared(
    predicted: DepthMap, context: DepthMap
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Both z-depths at the pixels where both are known."""
    comparable = predicted.valid & context.valid & (predicted.depth > 0) & (context.depth > 0)
    return predicted.depth[comparable].double(), context.depth[comparable].double()


def depth_spread(depth: Float[Tensor, "n"]) -> float:
    """(p95 - p5) / median: how much range of depth there is to fit a line through."""
    low, median, high = depth.quantile(depth.new_tensor([0.05, 0.5, 0.95])).tolist()
    return (high - low) / median


def affine_inliers(
    x: Float[Tensor, "n"], y: Float[Tensor, "n"], scale: float, shift: float
) -> Bool[Tensor, "n"]:
    return (scale * x + shift - y).abs() < RESIDUAL_THRESHOLD * y


def ransac_line(
    x: Float[Tensor, "n"], y: Float[Tensor, "n"], rng: torch.Generator
) -> tuple[float, float]:
    """Scale and shift with the most inliers among two-point hypotheses, refitted on its inliers.

    Residuals count relative to depth, so that the far end of the scene does not outvote the near
    one, and the refit weighs them alike. (0, 0) where no hypothesis has a positive scale.
    """
    i, j = torch.randint(len(x), (2, MAX_TRIALS), generator=rng).to(x.device)
    scales = (y[i] - y[j]) / torch.where(x[i] == x[j], torch.inf, x[i] - x[j])
    shifts = y[i] - scales * x[i]
    points = torch.stack([x / y, 1 / y])
    counts = torch.cat(
        [
            ((some @ points).sub_(1).abs_() < RESIDUAL_THRESHOLD).sum(dim=1)
            for some in torch.stack([scales, shifts], dim=1).split(AT_ONCE)
        ]
    )
    best = counts.where(scales > 0, -1).argmax()
    if scales[best] <= 0:
        return 0.0, 0.0

    scale, shift = scales[best].item(), shifts[best].item()
    for _ in range(3):
        agree = affine_inliers(x, y, scale, shift)
        weight = 1 / y[agree]
        design = torch.stack([x[agree], torch.ones_like(x[agree])], dim=-1) * weight[:, None]
        # The normal equations have a closed form on any device, which lstsq has not.
        normal = design.T @ design
        # Its second column is in inverse depths: measured by their own size, no unit matters.
        even = torch.stack([torch.ones_like(x[0]), y.median()])
        if torch.linalg.cond(normal * even * even[:, None]) > 1e12:
            break
        scale, shift = torch.linalg.solve(normal, design.T @ (y[agree] * weight)).tolist()
    return scale, shift


def fit_bridge(
    lift: Lift,
    at_target: Render,
    at_anchor: Render,
    rng: torch.Generator,
    config: AlignmentConfig = AlignmentConfig(),
    reject_below: float | None = DepthAgreementConfig.reject_below,
) -> DepthAffine:
    """The affine that brings the lifted depths to the scene's, compared in the bridge view.

    The anchor is the paper's bridge: the scene is dense there, while at the target it has the very
    holes that are to be filled. What the target sees nevertheless may contradict it.
    """
    if config.align_at == "none":
        return DepthAffine()
    if config.align_at == "target":
        return fit_affine(lift.reference_depth, at_target.depth_map(), rng)
    affine = fit_affine(lift.anchor_depth, at_anchor.depth_map(), rng)
    return unless_contradicted(
        affine, lift.reference_depth, at_target.depth_map(), rng, config, reject_below
    )


def unless_contradicted(
    affine: DepthAffine,
    predicted: DepthMap,
    context: DepthMap,
    rng: torch.Generator,
    config: AlignmentConfig,
    reject_below: float | None = DepthAgreementConfig.reject_below,
) -> DepthAffine:
    """`affine`, unless the scene that the target sees has other depths and one other affine.

    Where a pair shares too little for stereo (hardly any overlap, poses that drift), Ψ's depths of
    its two views need not be of one scale, and what fits the anchor is wrong at the target. Where
    no other fits there either, the paper's choice stands, and is refuted if hardly anything agrees.
    """
    x, y = compared(predicted, context)
    if config.min_agreement is None or len(x) < MIN_PIXELS:
        return affine
    agree = affine_inliers(x, y, affine.scale, affine.shift).double().mean().item()
    affine = replace(affine, agreement=agree)
    if agree >= config.min_agreement:
        return affine
    own = fit_affine(predicted, context, rng)
    if own.inliers >= max(MIN_INLIERS, 2 * agree):
        return replace(own, agreement=own.inliers, contradicted=True)
    enough = len(x) >= MIN_SEEN * context.depth.numel()
    return replace(affine, refuted=enough and agree < (reject_below or 0.0))
