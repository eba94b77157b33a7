"""Holes of a splat without photographs, and places that the user marked as such."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Bool
from torch import Tensor
from torch.nn.functional import interpolate

from gscompleter.config import HoleConfig
from gscompleter.data.cameras import has_same_aspect
from gscompleter.data.mask_checks import read_selected
from gscompleter.data.mask_reading import MaskReading
from gscompleter.numerics.enclosed_holes import keep_enclosed
from gscompleter.numerics.geometry import add_near_plane
from gscompleter.render.protocols import Renderer
from gscompleter.render.removed import mark_shown
from gscompleter.stages.hole_masks import compute_hole_mask
from gscompleter.stages.refusals import explain_little_covered
from gscompleter.system.errors import InputError, quote_value
from gscompleter.types import Camera, Gaussians
from gscompleter.virtual_capture.kind import is_object

HoleKind = Literal["all", "enclosed"]


@dataclass(frozen=True)
class SplatAloneKind:
    """What a splat without photographs is, which is decided once from its Gaussians."""

    is_lifted: bool
    """True if it was lifted from pixels, beside which everything is empty; False if trained."""
    holes: HoleKind
    """What a hole of it is."""


OPAQUE_ADVICE = (
    "The splat is opaque everywhere in the image of the target, and nothing in it tells what is "
    "wrong; mark that with --mask, or name the photographs of the scene as SCENE."
)
NOTHING_ENCLOSED_ADVICE = (
    "The splat is an object on nothing, and its only hole there is the space around it, which "
    "stays empty; mark what is wrong with --mask, or fill all that is empty with --holes all."
)
OBJECT_NOTE = (
    "The splat is an object on nothing: only holes that it encloses are filled, and nothing is "
    "added outside of its hull (--holes all fills what is around it, too)."
)


def choose_kind(
    kind: Literal["auto"] | HoleKind,
    scene: Gaussians,
    is_lifted: bool,
    given: Sequence[Camera],
    renderer: Renderer,
) -> HoleKind:
    """Choose what a hole is: of an object on nothing, only what it encloses.

    A scene that was lifted from pixels has nothing around it either, and is no object. `given` are
    the cameras that the user named, none that was found.
    """
    if kind == "enclosed" or (
        kind == "auto"
        and not is_lifted
        and is_object(scene, renderer, [camera.to(scene.means.device) for camera in given])
    ):
        return "enclosed"
    return "all"


def find_target_holes(
    targets: Sequence[Camera], scene: Gaussians, renderer: Renderer, config: HoleConfig
) -> list[Bool[Tensor, "h w"]]:
    """Find the holes that each target sees; refuse targets if none of them can be completed."""
    reasons = []
    holes = []
    for target in targets:
        ranged = add_near_plane(target, scene.means)
        render = renderer.render(scene, ranged)
        covered = render.depth_map().valid.float().mean().item()
        reason = explain_little_covered(covered, config)
        empty = compute_hole_mask(render.alpha, config)
        if reason is None and not empty.any():
            reason = OPAQUE_ADVICE
        if config.kind == "enclosed":
            empty = keep_enclosed(empty, render, ranged, partial(renderer.render, scene))
        if reason is None and not empty.any():
            reason = NOTHING_ENCLOSED_ADVICE
        reasons.append(reason)
        holes.append(empty)
    # One target that can be completed is enough; the report says why others were not.
    if reasons and None not in reasons:
        raise InputError(str(reasons[0]), "target")
    return holes


def mark_selected(
    scene: Gaussians,
    chosen: Bool[Tensor, "n"],
    targets: Sequence[Camera],
    renderer: Renderer,
) -> list[Bool[Tensor, "h w"]]:
    """Mark the pixels of the targets that show chosen Gaussians.

    Raises an InputError if no target shows any.
    """
    others = scene.hide(chosen)
    marks = [
        mark_shown(scene[chosen], others, add_near_plane(target, scene.means), renderer)
        for target in targets
    ]
    if not any(mark.any() for mark in marks):
        raise InputError(
            "No target camera sees the selected Gaussians; name a camera that does.", "target"
        )
    return marks


def pair_masks(masks: Sequence[Path], targets: Sequence[Camera]) -> list[tuple[Path, Camera]]:
    """Pair masks with the targets that they belong to, in order."""
    if masks and len(masks) != len(targets):
        raise InputError(
            f"There are {len(masks)} masks and {len(targets)} target cameras; give a mask for each "
            "target, in their order.",
            "mask",
        )
    return list(zip(masks, targets, strict=True)) if masks else []


def read_marks(
    stored: Path | bytes, target: Camera, reading: MaskReading = MaskReading(), name: str = ""
) -> Bool[Tensor, "h w"]:
    """Read the white pixels of a mask, or the black ones if inverted, at the size of its target.

    `stored` is its file, or its bytes, of which `name` is for errors.
    """
    marked = read_selected(stored, reading, name)
    shown = name if isinstance(stored, bytes) else quote_value(stored)
    size = marked.shape[1], marked.shape[0]
    if not has_same_aspect(size, (target.width, target.height)):
        raise InputError(
            f"{shown} has {size[0]} × {size[1]} pixels, and its target has the aspect "
            f"ratio of {target.width} × {target.height}; paint it on the image of the target.",
            "mask",
        )
    if not marked.any() or marked.all():
        wrong, right = ("black", "white") if reading.is_inverted else ("white", "black")
        raise InputError(
            f"{shown} marks {'all' if marked.all() else 'nothing'} of its target; "
            f"paint {wrong} what is wrong, and {right} what is right.",
            "mask",
        )
    mask = torch.from_numpy(marked).to(target.K.device)[None, None].float()
    size_at_target = (target.height, target.width)
    # A pixel is marked if half of it is.
    return interpolate(mask, size=size_at_target, mode="area")[0, 0] >= 0.5
