"""Requests to look at a splat: in the browser, or in numbers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gscompleter.apps.requests.answer import AnswerRequest


@dataclass(frozen=True, kw_only=True)
class ViewRequest:
    """Show a scene before and after in a page."""

    scene: Path
    """Output folder of a completion, or a file of Gaussians."""
    other: Path | None = None
    """The scene after, if `scene` is the one before; None for `scene` with what is generated."""
    cameras: Path | None = None
    """Cameras that the page jumps to; None for those of the completion, if it is one."""
    resolution: tuple[int, int] | None = None
    """Height and width of images of cameras whose file has none."""
    up: tuple[float, float, float] | None = None
    """Upward direction in the axes of the file; None to find it."""
    save: Path | None = None
    """File to write the page to; None to serve it."""
    overwrite: bool = False
    """True to replace that file."""
    port: int = 0
    """Port of a page that is served; 0 for a free one."""
    opens_browser: bool = True
    drop_nonfinite: bool = False
    """True to drop Gaussians that contain NaN or infinity."""
    ignore_properties: bool = False
    """True to read files whose further properties change what is seen."""
    answer: AnswerRequest = AnswerRequest()


@dataclass(frozen=True, kw_only=True)
class InspectionRequest:
    """Tell what is in a splat, and what of its pictures is invented."""

    file: Path
    """File of Gaussians, or output folder of a completion."""
    cameras: Path | None = None
    """Cameras of the pictures; None for those of the completion in whose folder the file lies."""
    resolution: tuple[int, int] | None = None
    """Height and width of images of cameras whose file has none."""
    device: Literal["cpu", "cuda"] = "cpu"
