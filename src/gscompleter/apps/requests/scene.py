"""Requests to open photographs, or a splat of which renders take their place."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.sfm import NUM_VIDEO_FRAMES

DEFAULT_LONG_SIDE = 640
"""Default length of a photograph's longer side, in pixels."""

Size = tuple[int, int] | int | Literal["full"]
"""Height and width, the longest side, or `full` for the photographs' own size."""
Names = tuple[int | str, ...]
"""Photographs by number or by name."""
FRAME_NUMBER = re.compile("-?[0-9]{1,9}")
"""Words that are numbers of photographs. Longer ones are names, such as times in nanoseconds; one
below 0 is refused as a number, not searched for as a name."""


@dataclass(frozen=True)
class SceneRequest:
    """Photographs to open, and how to read them."""

    folder: Path
    """Folder of the photographs, or a video."""
    format: str | None = None
    """Format of the folder; None to detect it."""
    resolution: tuple[int, int] | int | None = DEFAULT_LONG_SIDE
    """Height and width, or the longest side; None for the photographs' own size."""
    follows_training: bool = False
    """True to work at the size at which the splat was trained if that is smaller."""
    near: float | None = None
    """Smallest depth in the unit of the cameras; None for that of the data."""
    far: float | None = None
    """Largest depth in the unit of the cameras; None for that of the data."""
    uses_given_depth: bool = True
    """True to read the depth that the scene holds."""
    refines_poses: bool = True
    """True to refine poses that matches contradict, and to take refined ones beside a splat."""
    uses_masks: bool = True
    """True to ignore what masks of the scene hide."""
    masks: MaskReading = MaskReading()
    """How these masks are read."""
    removal_masks: Path | None = None
    """Folder of masks that show what to remove; lying in the scene, they hide nothing."""
    removal_reading: MaskReading = MaskReading()
    """How masks of what to remove are read."""

    @property
    def search_masks(self) -> MaskReading:
        """How masks of photographs are read where the cameras of these are searched for."""
        return replace(self.masks, is_used=self.uses_masks, left_out=self.removal_masks)


@dataclass(frozen=True)
class PosesRequest:
    """Search for the cameras of photographs that have none."""

    out: Path
    """Output folder of the command, which keeps them in its folder `colmap`."""
    overwrite: bool = False
    """True to replace a folder that is not of an earlier search."""
    num_frames: int = NUM_VIDEO_FRAMES
    """Most frames of a video to take as photographs."""
    named: Names = ()
    """Photographs that the command names; their numbers are checked before the search."""


@dataclass(frozen=True)
class PhotographsRequest:
    """A scene that photographs show."""

    scene: SceneRequest
    poses: PosesRequest
    """How cameras are found if the photographs have none."""
    context: Names | None = None
    """Photographs to work with; None to choose those that help most, once cameras are known."""


@dataclass(frozen=True)
class AloneRequest:
    """A splat without photographs, of which renders take their place."""

    scene: SceneRequest
    """Resolution, depth range and masks; its folder is the file of the splat."""
    context: Names | None = None
    """Cameras of a file to render at; None to choose them."""
    cameras: Path | None = None
    """File of cameras; None for those that lie beside the splat or are found."""
    up: tuple[float, float, float] | None = None
    """Upward direction, in the axes of its file, for cameras that are found; None to find it."""
    holes: Literal["auto", "all", "enclosed"] = "auto"
    """What a hole is; `auto` looks whether the splat is an object on nothing."""


def decide_resolution(given: Size | None) -> tuple[int, int] | int | None:
    """Return a size as the readers of photographs take it; the default one if none is given."""
    size = DEFAULT_LONG_SIDE if given is None else given
    return None if size == "full" else size
