"""The affine of depth as the paper has it: Eq. 8 (Sec. III-E).

`align_depth.py` is what we make of it. `docs/paper.md` lists how we read what the paper leaves
open; comments here say "our reading" at these places.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from gscompleter.numerics.robust import find_affine_inliers, fit_line_ransac
from gscompleter.stages.select_anchor import Anchor
from gscompleter.types import DepthAffine, DepthMap, Lift

MAX_SCORED_PIXELS = 8192
"""Pixels that hypotheses are scored on; of more, a random sample is used. Our reading: the paper
names no number."""
MIN_FIT_PIXELS = 64
"""Fewest comparable pixels that a fit needs. Our reading, as are both limits below: the paper does
not say what happens where RANSAC finds nothing."""
MIN_INLIER_SHARE = 0.3
"""Smallest inlier fraction of a reliable fit."""
MIN_DEPTH_SPREAD = 0.05
"""Smallest (p95 - p5) / median of depths that separates scale and shift.
Below, only a scale is fitted."""


@dataclass(frozen=True)
class ComparedDepths:
    """Two z-depths at the pixels of one image where both are valid, on the CPU.

    A fit reads so many numbers that the host would wait for a GPU dozens of times. So it gets both
    maps in one copy, and gives back what takes a GPU (the scores of hypotheses).
    """

    predicted: Float64[Tensor, "n"]
    """D_pred, as Ψ lifted it."""
    context: Float64[Tensor, "n"]
    """D_ctx, as the scene is rendered."""
    num_pixels: int
    """Number of pixels of the whole image."""
    device: torch.device
    """Device of the maps."""

    def __len__(self) -> int:
        return len(self.predicted)


def compare_at_anchor(lift: Lift, anchor: Anchor) -> ComparedDepths:
    """Compare D_pred^anc and D_ctx^anc, the depths that Eq. 8 aligns.

    The anchor bridges both depths: Ψ predicts its depth with that of the target, and the context is
    rendered there, which has holes at the target.
    """
    return compare_depth_maps(lift.anchor_depth, anchor.depth)


def fit_affine(depths: ComparedDepths, rng: torch.Generator) -> DepthAffine:
    """Minimize `Σ ρ(|D_ctx - (s D_pred + t)|)` over s and t by RANSAC (paper, Eq. 8).

    The fallback is the median ratio with shift 0, and the identity if nothing can be compared.
    """
    x = depths.predicted
    y = depths.context
    if len(x) < MIN_FIT_PIXELS:
        return DepthAffine()
    if len(x) > MAX_SCORED_PIXELS:
        sample = torch.randperm(len(x), generator=rng)[:MAX_SCORED_PIXELS]
        x, y = x[sample], y[sample]

    # In a flat view, such as a wall from the front, scale and shift cannot be told apart.
    low, median, high = x.quantile(x.new_tensor([0.05, 0.5, 0.95])).tolist()
    if (high - low) / median >= MIN_DEPTH_SPREAD:
        # Our reading: ρ counts pixels whose error, relative to their depth, is small.
        scale, shift = fit_line_ransac(x, y, rng, depths.device)
        inliers = find_affine_inliers(x, y, scale, shift).double().mean().item()
        if scale > 0 and inliers >= MIN_INLIER_SHARE:
            return DepthAffine(scale, shift, inliers, "ransac")

    scale = (y / x).median().item()
    inliers = find_affine_inliers(x, y, scale, 0.0).double().mean().item()
    return DepthAffine(scale, 0.0, inliers, "median")


def compare_depth_maps(predicted: DepthMap, context: DepthMap) -> ComparedDepths:
    """Take the depths of two maps of one image where both are valid."""
    comparable = predicted.valid & context.valid & (predicted.depth > 0) & (context.depth > 0)
    depths = torch.stack([predicted.depth, context.depth]).where(comparable, 0.0).cpu()
    x, y = depths[:, depths[0] > 0].double()
    return ComparedDepths(x, y, comparable.numel(), predicted.depth.device)
