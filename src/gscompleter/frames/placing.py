"""Aligns an input splat with a folder of photographs."""

from __future__ import annotations

from collections.abc import Sequence

from gscompleter.data.photographs import Photographs
from gscompleter.frames.beside import GivenSplat, frames_left
from gscompleter.frames.finding import Evidence, SplatFrame, find_frame
from gscompleter.frames.witnesses import usable_poses, witnesses
from gscompleter.render import Renderer


def frame_of_splat(
    splat: GivenSplat, photographs: Photographs, frames: Sequence[int], renderer: Renderer
) -> SplatFrame:
    """Estimate the transform from photographs to splat, relative to their origins.

    The photographs numbered `frames` are used in any case.

    Raises:
        InputError: No frame fits, or one of `frames` cannot be read.
    """
    views = [view.to(splat.scene.means.device) for view in witnesses(photographs, frames)]
    points = photographs.points()
    return find_frame(
        Evidence(splat.scene, views, renderer),
        usable_poses(photographs),
        None if points is None else points.double().numpy(),
        frames_left(splat, photographs),
    )
