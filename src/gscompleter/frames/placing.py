"""A user's splat and the photographs of a folder, brought together."""

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
    """Where a splat lies relative to the photographs, both told from their origins.

    Args:
        frames: Numbers of photographs to look at in any case.

    Raises:
        InputError: where it fits in no frame, or one of `frames` cannot be used.
    """
    views = [view.to(splat.scene.means.device) for view in witnesses(photographs, frames)]
    points = photographs.points()
    return find_frame(
        Evidence(splat.scene, views, renderer),
        usable_poses(photographs),
        None if points is None else points.double().numpy(),
        frames_left(splat, photographs),
    )
