"""Thin gaps: cracks between surfaces, which open as soon as the camera leaves the target.

A hole counts from alpha 0.5 down. Gaps of parallax and of depth edges are mostly more opaque than
that, so that no score of holes tells of them, and they are seen as dark lines all the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gscompleter.numerics.geometry import interpolate_camera, measure_baseline
from gscompleter.numerics.image_ops import keep_thin
from gscompleter.render.protocols import Renderer
from gscompleter.types import Camera, Gaussians, Render

OPAQUE_ALPHA = 0.85
"""Alpha below which the black behind a surface is seen through it."""
FLIGHT_SHARES = (0.2, 0.4, 0.6, 0.8)
"""Places of the cameras of a flight, as shares of the way to the target."""
AT_TARGET = "at the target"
"""Place of a render at the target itself, as `WorstGap.where` names it."""
WINDOW = 64
"""Side in pixels of the window in which the worst place of gaps is looked for."""


@dataclass(frozen=True)
class WorstGap:
    """The window that has most thin gaps."""

    where: str
    """Camera that sees it, in words that follow a noun."""
    share: float
    """Share of the window that is thin gaps."""
    left: int
    top: int
    """Pixel of the image at the upper left corner of the window."""
    crop: Float[Tensor, "s s 3"]
    """Rendered colours of the window, over black."""
    gaps: Bool[Tensor, "s s"]
    """The thin gaps in it."""

    @property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns of the window."""
        height, width = self.gaps.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)

    def describe(self) -> str:
        """Describe the window in two lines."""
        side = len(self.crop)
        return f"{100 * self.share:.1f} % of {side} x {side} pixels,\n{self.where}"


def find_thin_gaps(alpha: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Find the pixels below `OPAQUE_ALPHA` in structures thinner than 5 pixels.

    Along the border of the image they are thinner than 3, since beyond it a gap may go on.
    """
    return keep_thin(alpha < OPAQUE_ALPHA)


def measure_thin_gaps(alpha: Float[Tensor, "h w"]) -> float:
    """Compute the share of an image that is thin gaps."""
    return find_thin_gaps(alpha).float().mean().item()


def find_worst_gap(renders: Mapping[str, Render]) -> WorstGap | None:
    """Find the window with the largest share of thin gaps in renders by where they were taken.

    Return None if there are no thin gaps. Of equal windows it is the first one.
    """
    worst = None
    for where, render in renders.items():
        gaps = find_thin_gaps(render.alpha)
        # A crop is square, and an image may be smaller than the window.
        side = min(WINDOW, *gaps.shape)
        shares = count_in_windows(gaps, side) / side**2
        share = shares.max().item()
        if share > (0.0 if worst is None else worst.share):
            row, column = divmod(int(shares.argmax()), shares.shape[1])
            top, left = center_window(gaps, row, column, side)
            box = (slice(top, top + side), slice(left, left + side))
            # A copy, so that the image is not kept for it.
            worst = WorstGap(where, share, left, top, render.image[box].clone(), gaps[box].clone())
    return worst


def count_in_windows(mask: Bool[Tensor, "h w"], side: int) -> Float[Tensor, "rows columns"]:
    """Count the True pixels in each square window, by its upper left pixel."""
    # Whole numbers, which add up without rounding. A box is separable: along x, then along y.
    counts = mask.to(torch.float64)[None, None]
    for window in ((1, side), (side, 1)):
        counts = avg_pool2d(counts, window, stride=1, divisor_override=1)
    return counts[0, 0]


def center_window(gaps: Bool[Tensor, "h w"], top: int, left: int, side: int) -> tuple[int, int]:
    """Center a window of the most gaps around those in it, as far as the image reaches.

    The first of several such windows has its gaps at its lower right. Return row and column of the
    upper left pixel. The window that results holds all gaps of the given one, and no more, since
    none has more.
    """
    inside = gaps[top : top + side, left : left + side].nonzero()
    middle = (inside.amin(dim=0) + inside.amax(dim=0) + 1) // 2 - side // 2
    height, width = gaps.shape
    return (
        min(max(top + int(middle[0]), 0), height - side),
        min(max(left + int(middle[1]), 0), width - side),
    )


def plan_flight(photographs: Sequence[Camera], target: Camera) -> list[Camera]:
    """Place cameras between the nearest photograph and the target, with the lens of the target."""
    nearest = min(photographs, key=lambda camera: measure_baseline(camera, target))
    # Seen from the target, since its image size and intrinsics are kept.
    return [interpolate_camera(target, nearest, 1 - share) for share in FLIGHT_SHARES]


def render_flight(
    scene: Gaussians, photographs: Sequence[Camera], target: Camera, renderer: Renderer
) -> dict[str, Render]:
    """Render the way from the nearest photograph to the target; by where that is."""
    cameras = plan_flight(photographs, target)
    return {
        f"at {100 * share:.0f} % of the way": renderer.render(scene, camera)
        for share, camera in zip(FLIGHT_SHARES, cameras, strict=True)
    }


def measure_flight(flight: Mapping[str, Render]) -> float:
    """Compute the mean share of thin gaps of the renders of a flight."""
    return fmean(measure_thin_gaps(render.alpha) for render in flight.values())
