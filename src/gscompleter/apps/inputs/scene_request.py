"""Requests of a user to open photographs. Nothing here needs torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gscompleter.data.mask_reading import MaskReading

LONG_SIDE = 640
"""Default length of a photograph's longer side, in pixels."""


@dataclass(frozen=True)
class SceneRequest:
    """Photographs to open, and how to read them."""

    folder: Path
    """Folder of the photographs, or a video."""
    format: str | None = None
    """Format of the folder; None to detect it."""
    resolution: tuple[int, int] | int | None = LONG_SIDE
    """Height and width, or the longest side; None for the photographs' own size."""
    near: float | None = None
    """Smallest depth in the unit of the cameras; None for that of the data."""
    far: float | None = None
    """Largest depth in the unit of the cameras; None for that of the data."""
    uses_given_depth: bool = True
    """True to read the depth that the scene holds."""
    uses_masks: bool = True
    """True to ignore what masks of the scene hide."""
    masks: MaskReading = MaskReading()
    """How these masks are read."""
    removal_masks: Path | None = None
    """Folder of masks that show what to remove; lying in the scene, they hide nothing."""
    removal_reading: MaskReading = MaskReading()
    """How masks of what to remove are read."""


@dataclass(frozen=True)
class PosesRequest:
    """Search for the cameras of photographs that have none."""

    out: Path
    """Output folder of the command, which keeps them in its folder `colmap`."""
    overwrite: bool = False
    """True to replace a folder that is not of an earlier search."""
    num_frames: int = 40
    """Most frames of a video to take as photographs."""
    named: tuple[int | str, ...] = ()
    """Photographs that the command names; their numbers are checked before the search."""
