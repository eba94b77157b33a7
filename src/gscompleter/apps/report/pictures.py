"""Pictures of a completion: targets and photographs, before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.apps.inputs.task import Target
from gscompleter.config.settings import COVERED
from gscompleter.evaluation.metrics.coverage import RenderPair
from gscompleter.evaluation.verdict.held_out import Drawing
from gscompleter.numerics.image_ops import dilate, paint_marked
from gscompleter.numerics.kernels.parallel import map_in_parallel
from gscompleter.state import Completion
from gscompleter.system.files.image import write_image
from gscompleter.target_result import TargetResult
from gscompleter.types import View

IMAGES_FOLDER = "images"
"""Folder of the pictures of a completion."""


def write_pictures(
    folder: Path,
    completion: Completion,
    targets: Sequence[Target],
    at_targets: Sequence[RenderPair],
    has_renders: bool = False,
) -> None:
    """Write pictures of the targets and of photographs with ignored regions to `folder`.

    `at_targets` are the scene before and after at the targets, in their order. With `has_renders`,
    renders of a splat took the place of the photographs: all of them are written.
    """
    results = zip(targets, completion.targets, at_targets, strict=True)
    for number, (target, result, pair) in enumerate(results, start=1):
        images = name_target_images(target, result, pair, completion.config.holes.dilation)
        write_images(folder, f"target{number}", images)
    ending = "render" if has_renders else "ignored"
    for number, view in enumerate(completion.views, start=1):
        if has_renders or view.ignore_mask is not None:
            write_images(folder, f"context{number}", {ending: paint_ignored(view)})


def make_writing_draw(folder: Path, views: Sequence[View], draw: Drawing) -> Drawing:
    """Make a `draw` that also writes the photograph and both renders of what it draws.

    `views` are all views that it may be asked for, the same objects, and number the files from 1.
    So no image has to be kept, or rendered twice.
    """

    def draw_and_write(view: View) -> RenderPair:
        pair = draw(view)
        number = 1 + next(index for index, other in enumerate(views) if other is view)
        images = {
            "before": pair.before.image,
            "after": pair.after.image,
            "truth": paint_ignored(view),
        }
        write_images(folder, f"photograph{number}", images)
        return pair

    return draw_and_write


def paint_ignored(view: View) -> Float[Tensor, "h w 3"]:
    """Paint the ignored pixels of a photograph in a colour that no scene has."""
    return paint_marked(view.image, ~view.valid_mask)


def paint_unfilled(result: TargetResult, pair: RenderPair) -> Float[Tensor, "h w 3"] | None:
    """Paint what stays empty of the hole of a target; None if the report has no word on it."""
    if not result.unfilled.describe():
        return None
    is_open = result.hole_mask & (pair.after.alpha < COVERED)
    return paint_marked(pair.after.image, is_open)


def paint_reference(result: TargetResult, dilation: int) -> Float[Tensor, "h w 3"] | None:
    """Paint what was synthesized for a target where it was used; None if nothing was.

    Elsewhere it is the scene as this target found it, with what earlier ones added: there the image
    of Φ only guides the registration, and it may look worse than the scene.
    """
    if result.reference is None:
        return None
    is_used = dilate(result.hole_mask, dilation)[..., None]
    return result.reference.image.where(is_used, result.before.image)


def name_target_images(
    target: Target, result: TargetResult, pair: RenderPair, dilation: int
) -> dict[str, Tensor | None]:
    """Name the images of a target: colours [h, w, 3], or grey and masks [h, w]; None to have none.

    `dilation` is that of the hole mask, in pixels. `before` and `after` are of the whole completion
    (`pair`), and the rest is of the step of this target (`result`). `support` is the trusted part
    of the scene's alpha, which tells nothing where all of it is trusted.
    """
    alpha = result.trusted_alpha
    return {
        "before": pair.before.image,
        "after": pair.after.image,
        "hole_mask": result.hole_mask.float(),
        "unfilled": paint_unfilled(result, pair),
        "support": None if torch.equal(alpha, result.before.alpha) else alpha,
        "reference": paint_reference(result, dilation),
        "truth": None if target.view is None else paint_ignored(target.view),
    }


def write_images(folder: Path, name: str, images: Mapping[str, Tensor | None]) -> None:
    """Write images by their endings, in parallel, as `{name}_{ending}.png`; None is left out."""
    known = {ending: image for ending, image in images.items() if image is not None}
    paths = [folder / f"{name}_{ending}.png" for ending in known]
    map_in_parallel(write_image, paths, known.values())


def join_images(
    pictures: Sequence[Float[Tensor, "h _w 3"]], gap: int = 4
) -> Float[Tensor, "h wide 3"]:
    """Join images of one height side by side on white, `gap` pixels apart, on the CPU."""
    white = torch.ones((pictures[0].shape[0], gap, 3))
    parts = [part for picture in pictures for part in (white, picture.cpu().clamp(0, 1))]
    return torch.cat(parts[1:], dim=1)
