"""A splat as a witness of poses: which of two cameras of a photograph does it agree with?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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


@dataclass(frozen=True)
class PoseComparison:
    """How well a splat agrees with photographs at two cameras of each: mean PSNR, in dB."""

    given: float
    refined: float


def compare_poses(
    scene: Gaussians, given: Sequence[View], refined: Sequence[View], renderer: Renderer
) -> PoseComparison | None:
    """Compare a splat with photographs at two cameras of each, in the frame of the splat.

    `given` and `refined` are the same photographs. Pixels count where the splat is opaque from both
    cameras, after the exposure is matched for each. None if no photograph has enough of them.
    """
    given_psnrs: list[float] = []
    refined_psnrs: list[float] = []
    for photograph, at_refined in zip(given, refined, strict=True):
        given_render = render_from(scene, photograph.camera, renderer)
        refined_render = render_from(scene, at_refined.camera, renderer)
        # The same pixels for both, or a camera that sees less of the splat could look better.
        is_covered = (given_render.alpha >= COVERED) & (refined_render.alpha >= COVERED)
        where = photograph.valid_mask & is_covered
        if where.sum() < MIN_COVERED_SHARE * where.numel():
            continue
        truth = photograph.image[where].double()
        for render, psnrs in ((given_render, given_psnrs), (refined_render, refined_psnrs)):
            matched = match_render(render.image[where].double(), truth)
            psnrs.append(convert_to_psnr((matched - truth).square().mean()))
    if not given_psnrs:
        return None
    return PoseComparison(given=fmean(given_psnrs), refined=fmean(refined_psnrs))
