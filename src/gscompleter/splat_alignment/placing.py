"""Aligns an input splat with a folder of photographs."""

from __future__ import annotations

from collections.abc import Sequence

from gscompleter.data.photographs import Photographs
from gscompleter.render import Renderer
from gscompleter.splat_alignment.estimate import AlignmentData, SplatAlignment, estimate_alignment
from gscompleter.splat_alignment.sample_views import collect_poses, sample_views
from gscompleter.splat_alignment.sidecars import InputSplat, read_trainer_frames


def align_splat(
    splat: InputSplat, photographs: Photographs, frames: Sequence[int], renderer: Renderer
) -> SplatAlignment:
    """Estimate the transform from photographs to splat, relative to their origins.

    The photographs numbered `frames` are used in any case.

    Raises:
        InputError: No frame fits, or one of `frames` cannot be read.
    """
    views = [view.to(splat.scene.means.device) for view in sample_views(photographs, frames)]
    points = photographs.points()
    return estimate_alignment(
        AlignmentData(splat.scene, views, renderer),
        collect_poses(photographs),
        None if points is None else points.double().numpy(),
        read_trainer_frames(splat, photographs),
    )
