"""Pixels of the hole mask that a completion leaves empty, and the step that lost them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool
from torch import Tensor

from gscompleter.numerics.image_ops import dilate
from gscompleter.stages.target_view import TargetView, compute_hole_mask
from gscompleter.state import Step, Unfilled
from gscompleter.types import Render

MAX_REGIONS = 3
"""Most regions that are listed, the largest first."""


def find_unfilled(after: Render, steps: Sequence[Step], view: TargetView) -> Unfilled:
    """Find the pixels of the dilated hole mask that are still holes after a target.

    `after` is the result at the padded camera, `steps` are the new Gaussians after each step, in
    order. The steps are rendered only if more than `Unfilled.MAX_SHARE` stays empty.
    """
    holes = view.state.config.holes
    mask = dilate(view.empty, holes.dilation)
    empty = mask & compute_hole_mask(after.alpha, holes)
    total = max(int(mask.sum()), 1)
    share = int(empty.sum()) / total
    if share <= Unfilled.MAX_SHARE:
        return Unfilled(share)

    # Each empty pixel is put down to the first step after which it is open. A later step is not
    # to blame, since there was nothing left for it to lose.
    lost: dict[str, float] = {}
    unexplained = empty
    for step in steps:
        alpha = view.frozen.composite(step.gaussians).alpha
        is_open = compute_hole_mask(alpha, holes)
        lost[step.name] = int((unexplained & is_open).sum()) / total
        unexplained = unexplained & ~is_open
    regions = find_regions(empty, -view.camera.left, -view.camera.top)
    return Unfilled(share, {name: part for name, part in lost.items() if part > 0}, regions)


def find_regions(
    mask: Bool[Tensor, "h w"], left: int, top: int
) -> tuple[tuple[int, int, int, int], ...]:
    """Find the bounding boxes (left, top, right, bottom) of the largest connected regions.

    The corner of the mask has the coordinates `left`, `top`; right and bottom are exclusive.
    """
    pixels = mask.cpu().numpy().astype(np.uint8)
    _, _, stats, _ = cv2.connectedComponentsWithStats(pixels, connectivity=8)
    regions = stats[1:]  # the first component is the background
    largest_first = (-regions[:, cv2.CC_STAT_AREA]).argsort(kind="stable")
    largest = regions[largest_first][:MAX_REGIONS]
    return tuple(
        (left + int(x), top + int(y), left + int(x + width), top + int(y + height))
        for x, y, width, height, _ in largest
    )
