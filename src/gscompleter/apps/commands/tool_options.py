"""Options of the commands that complete nothing. Nothing here needs torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.commands.options import ComputeOptions, Options, Port
from gscompleter.config.settings import Settings


@dataclass(frozen=True, kw_only=True)
class ModelsOptions(Settings):
    """List published model weights with their licences, and show which are downloaded."""

    json: bool = False
    """Print all details as JSON."""


@dataclass(frozen=True, kw_only=True)
class PosesOptions(ComputeOptions):
    """Find the cameras of photographs with COLMAP, and write a COLMAP folder.

    A second run with the same photographs keeps the result.
    """

    photographs: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS")]
    """Folder of overlapping photographs of one scene. They are not changed."""
    out: Path
    """Output folder: upright copies in images, cameras and points in sparse/0."""
    overwrite: bool = False
    """Replace the results of an earlier run in the output folder."""


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(Options):
    """Convert a file of Gaussians to .ply, .compressed.ply, .spz or .splat, by the name of B.

    It also reads .ksplat, .sog (a bundle or its folder) and .glb.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """File to read, or the folder of a .sog."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="B")]
    """File to write."""
    drop_nonfinite: bool = False
    """Drop Gaussians that contain NaN or infinity instead of refusing the file."""
    plain: bool = False
    """Write no labels of generated Gaussians: no property `generated` in a .ply, which some
    programs misread, and no file of labels beside other formats. All Gaussians are kept."""
    overwrite: bool = False
    """Replace an existing file."""


@dataclass(frozen=True, kw_only=True)
class StripOptions(Options):
    """Undo a completion: remove what was generated and put the originals back."""

    completed: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="COMPLETED")]
    """Completed scene. Gaussians of a removed.ply beside it are put back."""
    out: Path
    """File for the original scene."""
    overwrite: bool = False
    """Replace an existing file."""


@dataclass(frozen=True, kw_only=True)
class ReportOptions(Options):
    """Write report.html of a completion or an evaluation again."""

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Output folder of `complete`, `demo` or `evaluate`."""


@dataclass(frozen=True, kw_only=True)
class ViewOptions(Options):
    """Show a scene before and after its completion in the browser.

    Side by side, with a slider, or one at a time; generated Gaussians can be tinted or hidden.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """Output folder of `complete`, or a file of Gaussians in any format that `convert` reads."""
    other: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="B")] = None
    """Scene after completion if A is the scene before. If not given, A is shown with and without
    its generated Gaussians."""
    cameras: Path | None = None
    """Cameras to jump to: a file of cameras as in `complete --target`, or a folder with a
    transforms.json or a COLMAP model. They are in the coordinates of the photographs if A is an
    output folder, otherwise in those of A."""
    resolution: tuple[int, int] | None = None
    """Image size (height and width) of cameras whose file has none."""
    save: Path | None = None
    """Write the page to this file instead of serving it."""
    overwrite: bool = False
    """Replace an existing file."""
    port: Port = 0
    """Port of the page on 127.0.0.1; a free one if not given."""
    no_open: bool = False
    """Print the address without opening a browser."""
    drop_nonfinite: bool = False
    """Drop Gaussians that contain NaN or infinity instead of refusing the file."""


@dataclass(frozen=True, kw_only=True)
class WarmupOptions(ComputeOptions):
    """Compile all kernels for this machine, for container images and cluster nodes.

    They are stored in numba's cache, beside the package or in NUMBA_CACHE_DIR, and are valid for
    one type of processor.
    """


@dataclass(frozen=True, kw_only=True)
class DoctorOptions(Settings):
    """Print what is installed (device, renderers, packages, extras, weights, caches).

    For everything that is missing it prints the purpose and what to do. Nothing is downloaded or
    changed. The default models need the packages only.
    """

    json: bool = False
    """Print the result as JSON."""
