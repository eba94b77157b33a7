"""Measure and draw the parts of an object that a removal may have left, in one photograph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.apps.report.schema import RemovalRow
from gscompleter.editing.outline import Outline, trace_outline
from gscompleter.evaluation.metrics.coverage import RenderPair
from gscompleter.evaluation.verdict.held_out import render_before_after
from gscompleter.numerics.image_ops import compute_mask_fraction, paint_marked
from gscompleter.render.protocols import Renderer
from gscompleter.render.removed import find_removed
from gscompleter.state import Completion

ENDED_COLOR = (0.0, 1.0, 1.0)
"""Colour of the outline where the surface ends; where it goes on, it is `MARK_COLOR`."""


@dataclass(frozen=True)
class RemovalPictures:
    """A photograph that shows what was removed, before and after."""

    row: RemovalRow
    pair: RenderPair
    outline: Outline

    def name_images(self) -> dict[str, Tensor]:
        """Name the images [h, w, 3]."""
        return {
            "before": self.pair.before.image,
            "after": self.pair.after.image,
            "outline": paint_outline(self.pair.after.image, self.outline),
        }


def draw_removal(
    completion: Completion, renderer: Renderer, files: Mapping[int | None, str]
) -> RemovalPictures | None:
    """Draw what was removed in the photograph of the context that shows it largest.

    Check photographs, which may be smaller, are no pictures for a report. `files` are those of the
    photographs by frame. Return None if no photograph of the context shows any of it.
    """
    if len(completion.source.removed) == 0:
        return None
    masks = [
        find_removed(completion.source, view.camera, renderer).cpu() for view in completion.views
    ]
    number = find_largest(masks)
    if number is None:
        return None

    view, mask = completion.views[number], masks[number]
    pair = render_before_after(completion, view.camera, renderer)
    outline = trace_outline(mask.to(pair.before.image.device), pair.before, pair.after, view.camera)
    file = files.get(view.frame)
    row = RemovalRow(view.frame, file, compute_mask_fraction(mask), outline.share)
    return RemovalPictures(row, pair, outline)


def find_largest(masks: Sequence[Bool[Tensor, "_h _w"]]) -> int | None:
    """Find the mask with the largest share of its image; None if all are empty.

    One that reaches the border of its image, beyond which its outline is not seen, is found only if
    all do.
    """
    sizes = {number: compute_mask_fraction(mask) for number, mask in enumerate(masks) if mask.any()}
    whole = [number for number in sizes if not reaches_border(masks[number])]
    return max(whole or sizes, key=sizes.__getitem__, default=None)


def reaches_border(mask: Bool[Tensor, "h w"]) -> bool:
    """Return True if a pixel at the border of the image is set."""
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


def paint_outline(image: Float[Tensor, "h w 3"], outline: Outline) -> Float[Tensor, "h w 3"]:
    """Paint the outline of what was removed over an image, by whether the surface goes on."""
    traced = paint_marked(image, outline.pixels, ENDED_COLOR)
    return paint_marked(traced, outline.continued)
