"""Photographs that only score a completion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import torch

from gscompleter.config.settings import COVERED
from gscompleter.editing.removal import hide_removed
from gscompleter.evaluation.metrics.coverage import RenderPair
from gscompleter.evaluation.metrics.image import compute_masked_psnr, compute_masked_ssim
from gscompleter.evaluation.metrics.unused_photographs import measure_likeness, shrink_view
from gscompleter.evaluation.verdict.rows import HeldOutRow, ScoreRow
from gscompleter.numerics.image_ops import compute_mask_fraction
from gscompleter.render.protocols import HidingScene, Renderer
from gscompleter.render.view_map import get_view_map
from gscompleter.state import Completion
from gscompleter.types import Camera, View

Drawing = Callable[[View], RenderPair]
"""Renders the context and the completed scene at the camera of a photograph."""


@dataclass(frozen=True)
class HeldOut:
    """A photograph that is neither context nor target and only scores the result."""

    view: View
    is_check: bool = False
    """True if a small copy of it checked the input splat."""


def render_before_after(completion: Completion, camera: Camera, renderer: Renderer) -> RenderPair:
    """Render the context and the completed scene."""
    with torch.no_grad():
        frozen = renderer.freeze(completion.context, camera)
        before = frozen.render
        # What a removed Gaussian hid comes to light.
        gone = completion.source.gone_mask
        if gone.any():
            kept = completion.context.hide(gone)
            if isinstance(frozen, HidingScene):
                frozen = frozen.hide(gone, (kept,))
            else:
                frozen = renderer.freeze(kept, camera)
        # New colours change no depth and no opacity, and the frozen scene is painted over.
        if len(completion.recolored) > 0:
            rows = completion.recolored_mask.nonzero()[:, 0]
            frozen = frozen.repaint(rows, completion.recolored)
        return RenderPair(before, frozen.composite(completion.added))


def make_drawing(completion: Completion, renderer: Renderer) -> Drawing:
    """Return what renders the context and the completed scene at the camera of a photograph."""
    return lambda view: render_before_after(completion, view.camera, renderer)


def score_held_out(
    completion: Completion,
    held_out: Sequence[HeldOut],
    renderer: Renderer,
    draw: Drawing | None = None,
) -> list[HeldOutRow]:
    """Make the rows of held-out photographs; `draw` is by default that of `make_drawing`."""
    draw = draw or make_drawing(completion, renderer)
    # Photographs in use, as they are: what a reconstruction has to be better than (decision 048).
    used = [shrink_view(view).image for view in completion.views]

    def score(photograph: HeldOut) -> HeldOutRow:
        view = hide_removed(photograph.view, completion.source, renderer)
        row = score_photograph(draw(photograph.view), view)
        small = shrink_view(view)
        with torch.no_grad():
            render = renderer.render(completion.source.rendered, small.camera)
        likeness = measure_likeness(render, small, used)
        # Without what shows the removed, which is no mask of the user.
        unmasked = 1 - compute_mask_fraction(photograph.view.ignore_mask)
        row = replace(row, is_check=photograph.is_check, unmasked=unmasked)
        return row if likeness is None else replace(row, **asdict(likeness))

    map_views = get_view_map(completion.context.means, len(completion.context))
    return list(map_views(score, held_out))


def score_context(completion: Completion, renderer: Renderer) -> list[ScoreRow]:
    """Score the photographs in use, except where they show what was removed, by PSNR alone."""

    def score(view: View) -> ScoreRow:
        shown = hide_removed(view, completion.source, renderer)
        pair = render_before_after(completion, view.camera, renderer)
        renders = (pair.before, pair.after)
        before, after = (
            compute_masked_psnr(render.image, shown.image, shown.valid_mask) for render in renders
        )
        return ScoreRow(view.frame, before, after, None, None)

    map_views = get_view_map(completion.context.means, len(completion.context))
    return list(map_views(score, completion.views))


def score_photograph(pair: RenderPair, view: View) -> HeldOutRow:
    """Score a held-out photograph where the completed scene covers it."""
    truth = view.image
    valid = view.valid_mask
    # Both scores over what the completed scene covers: their difference is then a gain.
    covered_before = (pair.before.alpha >= COVERED) & valid
    covered_after = (pair.after.alpha >= COVERED) & valid
    num_valid = max(int(valid.sum()), 1)
    return HeldOutRow(
        view.frame,
        psnr_before=compute_masked_psnr(pair.before.image, truth, covered_after),
        psnr_after=compute_masked_psnr(pair.after.image, truth, covered_after),
        ssim_before=compute_masked_ssim(pair.before.image, truth, covered_after),
        ssim_after=compute_masked_ssim(pair.after.image, truth, covered_after),
        covered_before=int(covered_before.sum()) / num_valid,
        covered_after=int(covered_after.sum()) / num_valid,
    )
