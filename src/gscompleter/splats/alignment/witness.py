"""A splat as a witness of poses: which of two cameras of a photograph does it agree with?"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

from gscompleter.config.settings import COVERED
from gscompleter.render.protocols import Renderer
from gscompleter.splats.alignment.fit import (
    MIN_COVERED_SHARE,
    convert_to_psnr,
    match_render,
    render_from,
)
from gscompleter.types import Gaussians, View


def compare_poses(
    scene: Gaussians, given: Sequence[View], refined: Sequence[View], renderer: Renderer
) -> tuple[float, float] | None:
    """Compute the mean PSNR in dB of a splat against photographs at two cameras of each.

    Both are in the frame of the splat. Pixels count where it is opaque from both, after the
    exposure is matched; None if no photograph has enough of them.
    """
    scores = []
    for before, after in zip(given, refined, strict=True):
        renders = [render_from(scene, view.camera, renderer) for view in (before, after)]
        where = before.valid_mask
        for render in renders:
            where = where & (render.alpha >= COVERED)
        if where.sum() < MIN_COVERED_SHARE * where.numel():
            continue
        truth = before.image[where].double()
        images = [match_render(render.image[where].double(), truth) for render in renders]
        scores.append([convert_to_psnr((image - truth).square().mean()) for image in images])
    if not scores:
        return None
    before_mean, after_mean = (fmean(column) for column in zip(*scores, strict=True))
    return before_mean, after_mean
