"""Requests to write splats in another format, joined, cut, turned and reduced on the way."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class ConversionRequest:
    """Write one splat or several to a file; numbers are in the axes of a .ply."""

    sources: tuple[Path, ...]
    """Splats to read; labels of what is generated in one follow those of the splats before it."""
    out: Path
    """File to write, whose name tells its format."""
    level: int | None = None
    """Level of detail to read of a streamed scene; None for files without levels."""
    bands: int | None = None
    """Largest degree of harmonics to keep; None for all."""
    crop_box: tuple[float, float, float, float, float, float] | None = None
    """Smallest x, y and z of what is kept, then largest; None to keep all."""
    crop_sphere: tuple[float, float, float, float] | None = None
    """Centre and radius of what is kept; None to keep all."""
    scale: float = 1.0
    rotate: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Angles about x, then y, then z, in degrees."""
    translate: tuple[float, float, float] = (0.0, 0.0, 0.0)
    decimate: float | int | None = None
    """Number of Gaussians that are left, or a share as a float from 0 to 1; None for all."""
    drop_nonfinite: bool = False
    """True to drop Gaussians that contain NaN or infinity."""
    ignore_properties: bool = False
    """True to read files whose further properties change what is seen."""
    plain: bool = False
    """True to write neither labels nor who made them."""
