"""The hole masks of a target: Eq. 12, and what we make of it.

`compute_hole_mask` is the equation. `find_hole_masks` applies ours to it in this order: of the
padding only what goes on from the image, of an object only what it encloses, after a removal only
what that opened, and at last what a user marked as wrong. In `paper()` none of them acts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from gscompleter.config import HoleConfig
from gscompleter.numerics.image_ops import dilate
from gscompleter.stages.enclosed_holes import keep_enclosed
from gscompleter.types import Camera, PaddedCamera, Render

RenderAt = Callable[[Camera], Render]
"""Renders the same scene at another camera."""


@dataclass(frozen=True)
class HoleEdits:
    """What edits of a user say about the holes of an image."""

    opened: Bool[Tensor, "h w"] | None = None
    """Pixels in which a removal may have opened a hole; None if all of them may be holes."""
    forced: Bool[Tensor, "h w"] | None = None
    """Pixels that are holes whatever stands there, as the user marked them; None without."""


@dataclass(frozen=True)
class HoleMasks:
    """The holes of a padded target, before any dilation."""

    holes: Bool[Tensor, "h w"]
    """Pixels that Φ fills: empty or not trusted."""
    empty: Bool[Tensor, "h w"]
    """Hole mask M_hole of Eq. 12: Gaussians are added here. Under full trust it is `holes`."""
    edits: HoleEdits = HoleEdits()


def compute_hole_mask(
    alpha: Float[Tensor, "h w"], config: HoleConfig = HoleConfig()
) -> Bool[Tensor, "h w"]:
    """Return True where alpha is below the threshold, before dilation (paper, Eq. 12)."""
    return alpha < config.max_alpha


def find_hole_masks(
    render: Render,
    trusted_alpha: Float[Tensor, "h w"],
    camera: PaddedCamera,
    config: HoleConfig,
    edits: HoleEdits,
    render_at: RenderAt,
) -> HoleMasks:
    """Find the holes of a padded target in the `render` of the scene there.

    `trusted_alpha` is its alpha weighted by trust; under full trust it is that alpha itself.
    """

    def find_holes(alpha: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
        holes = compute_hole_mask(alpha, config)
        if config.padding == "beside":
            holes = holes & beside_holes(holes, camera, config.dilation)
        # Beside an object nothing is missing; nor is it where an object was taken away from there.
        if config.kind == "enclosed":
            holes = keep_enclosed(holes, render, camera.padded, render_at)
        # After a removal nothing else is completed, and counts as no hole.
        if edits.opened is not None:
            holes = holes & edits.opened
        return holes if edits.forced is None else holes | edits.forced

    holes = find_holes(trusted_alpha)
    empty = holes if trusted_alpha is render.alpha else find_holes(render.alpha)
    return HoleMasks(holes, empty, edits)


def beside_holes(
    holes: Bool[Tensor, "wide_h wide_w"], camera: PaddedCamera, dilation: int
) -> Bool[Tensor, "wide_h wide_w"]:
    """Mark the image of the target, and its padding beside holes that reach the border.

    What is not beside them was not asked for: one pixel of a hole at the border would open all of
    the padding. `dilation` in pixels is that of the hole mask.
    """
    inside = dilate(camera.crop(holes), dilation)[None, None].float()
    sides = (camera.left, camera.left, camera.top, camera.top)
    continued = pad(inside, sides, mode="replicate")[0, 0] > 0
    camera.crop(continued).fill_(True)
    return continued
