"""A user's splat and the photographs of a folder, brought together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gscompleter.data.dataparser import read_dataparser_transforms
from gscompleter.data.photographs import Photographs
from gscompleter.frames.finding import Evidence, SplatFrame, find_frame
from gscompleter.frames.similarity import Matrix
from gscompleter.frames.witnesses import usable_poses, witnesses
from gscompleter.render import Renderer
from gscompleter.types import Gaussians

DATAPARSER = "dataparser_transforms.json"
"""What a nerfstudio run writes about the frame that it trains in."""


def frame_of_splat(
    path: Path,
    scene: Gaussians,
    photographs: Photographs,
    frames: Sequence[int],
    renderer: Renderer,
) -> SplatFrame:
    """Where the splat of a file lies relative to the photographs.

    Args:
        path: The file, beside which its trainer may have left word of the frame.
        scene: What it holds.
        frames: Numbers of photographs to look at in any case.

    Raises:
        InputError: where it fits in no frame, or one of `frames` cannot be used.
    """
    device = scene.means.device
    views = [view.to(device) for view in witnesses(photographs, frames)]
    points = photographs.points()
    return find_frame(
        Evidence(scene, views, renderer),
        usable_poses(photographs),
        None if points is None else points.double().numpy(),
        None if photographs.origin.any() else dataparser_beside(path),
    )


def dataparser_beside(path: Path) -> Matrix | None:
    """The transform that nerfstudio left in the folder of a splat; None where it left none.

    Raises:
        InputError: where that file is damaged.
    """
    file = path.parent / DATAPARSER
    return read_dataparser_transforms(file) if file.is_file() else None
