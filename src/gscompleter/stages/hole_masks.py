"""The hole masks of a target: Eq. 12, and what we make of it.

`compute_hole_mask` is the equation. `find_hole_masks` then applies our rules to it, in this order:

1. `HoleConfig.padding`: in the padding, only what continues holes of the image counts.
2. `HoleConfig.kind`: of an object that stands on nothing, only what it encloses.
3. `HoleEdits.opened`: after a removal, only what that opened.
4. `HoleEdits.forced`: what a user marked as wrong is a hole in any case, so it comes last.

With `CompleterConfig.paper()` none of them acts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from gscompleter.config import HoleConfig
from gscompleter.numerics.enclosed_holes import keep_enclosed
from gscompleter.numerics.image_ops import dilate
from gscompleter.types import Camera, PaddedCamera, Render

RenderAt = Callable[[Camera], Render]
"""Renders the same scene at another camera."""


@dataclass(frozen=True)
class HoleEdits:
    """What edits of a user say about the holes at a padded target."""

    opened: Bool[Tensor, "h w"] | None = None
    """Pixels at which a removal may have opened a hole; None if any pixel may be a hole."""
    forced: Bool[Tensor, "h w"] | None = None
    """Pixels that are holes whatever stands there, as the user marked them; None for none."""


@dataclass(frozen=True)
class HoleMasks:
    """The holes of a padded target, before they are dilated to hide seams."""

    holes: Bool[Tensor, "h w"]
    """Pixels that Φ fills: those of `empty`, and those whose Gaussians are not trusted."""
    empty: Bool[Tensor, "h w"]
    """Hole mask M_hole of Eq. 12: Gaussians are added here. Under full trust it is `holes`."""
    edits: HoleEdits = HoleEdits()
    """The edits that both of them follow."""


def compute_hole_mask(
    alpha: Float[Tensor, "h w"], config: HoleConfig = HoleConfig()
) -> Bool[Tensor, "h w"]:
    """Return True where alpha, in [0, 1], is below the threshold τ (paper, Eq. 12)."""
    return alpha < config.max_alpha


def find_hole_masks(
    render: Render,
    trusted_alpha: Float[Tensor, "h w"],
    camera: PaddedCamera,
    config: HoleConfig,
    edits: HoleEdits,
    render_at: RenderAt,
) -> HoleMasks:
    """Find the holes of a padded target.

    Args:
        render: Render of the scene at the padded camera.
        trusted_alpha: Its alpha weighted by trust, in [0, 1]. Under full trust it is the tensor
            `render.alpha` itself, and the same masks are not computed twice.
        camera: The target and its padding.
        config: What a hole is.
        edits: What the user removed, or marked as wrong.
        render_at: Is asked only where `config.kind` is `enclosed`.
    """

    def find_holes(alpha: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
        holes = compute_hole_mask(alpha, config)
        if config.padding == "beside":
            holes = holes & mark_beside_holes(holes, camera, config.dilation)
        # Around an object nothing is missing, nor where another object beside it was removed. So
        # this comes before `opened`, and judges whole gaps.
        if config.kind == "enclosed":
            holes = keep_enclosed(holes, render, camera.padded, render_at)
        if edits.opened is not None:
            holes = holes & edits.opened
        return holes if edits.forced is None else holes | edits.forced

    holes = find_holes(trusted_alpha)
    if trusted_alpha is render.alpha:
        return HoleMasks(holes, holes, edits)
    empty = find_holes(render.alpha)
    # Pixels that are not trusted may join an enclosed hole to the space around the object. Both
    # together are then no hole in it, but the hole is one still, and Φ has to fill it.
    return HoleMasks(holes | empty, empty, edits)


def mark_beside_holes(
    holes: Bool[Tensor, "wide_h wide_w"], camera: PaddedCamera, dilation: int
) -> Bool[Tensor, "wide_h wide_w"]:
    """Mark the image of the target, and the padding beside holes that reach its border.

    The marks go straight outwards from the border. The rest of the padding was not asked for: one
    pixel of a hole at the border would open all of it. `dilation`, in pixels, is that of the hole
    mask, which the padding has to continue.
    """
    inside = dilate(camera.crop(holes), dilation)[None, None].float()
    # Left, right, top and bottom; opposite sides of a padded camera are equally wide.
    sides = (camera.left, camera.left, camera.top, camera.top)
    marks = pad(inside, sides, mode="replicate")[0, 0] > 0
    camera.crop(marks).fill_(True)
    return marks
