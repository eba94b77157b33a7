"""Requests to read a splat, and to choose a part of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gscompleter.data.mask_reading import MaskReading


@dataclass(frozen=True)
class SplatRequest:
    """A file of Gaussians to work on."""

    path: Path
    drop_nonfinite: bool = False
    """True to drop Gaussians that contain NaN or infinity instead of refusing the file."""
    ignore_properties: bool = False
    """True to read a file whose further properties change what is seen."""
    forget_edits: bool = False
    """True to use photographs also where they show what earlier edits took out."""
    beside: Path | None = None
    """Keep the harmonics of a large splat in a temporary file in this folder, that of the results;
    None to keep them in memory."""


@dataclass(frozen=True)
class Selection:
    """Gaussians of a splat that are selected in any of these ways; coordinates are the file's."""

    boxes: Sequence[float] = ()
    """Six numbers per box: its smallest x, y and z, then its largest, before it is rotated."""
    box_rotation: Sequence[float] = (1.0, 0.0, 0.0, 0.0)
    """Quaternion wxyz that rotates the boxes about their centres."""
    sphere: Sequence[float] | None = None
    """Centre x, y and z, and radius."""
    masks: Path | None = None
    """Folder of images that are named as photographs, white (or as `mask_reading` says) where
    something goes."""
    file: Path | None = None
    """File of selected Gaussians, which are found in the splat by their positions."""
    drop_nonfinite: bool = False
    """True to drop Gaussians of that file that contain NaN or infinity."""
    margin: float = 0.0
    """Distance by which boxes and the sphere reach farther than given, on every side."""
    mask_reading: MaskReading = MaskReading()
    """How masks are read."""
