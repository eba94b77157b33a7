"""Size of the images that a splat was trained on, as its trainer recorded it.

Gaussians are fitted to pixels of one size. In larger images they are blurred, and differ from the
photographs in what the training never saw; smaller ones are harmless.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from gscompleter.data.camera_files import read_camera_list
from gscompleter.data.photographs import Photographs
from gscompleter.splats.alignment.trainer_frames import (
    find_camera_lists,
    list_trainer_folders,
    match_names,
)
from gscompleter.system.errors import InputError
from gscompleter.system.files.reading import read_head

INRIA_FILE = "cfg_args"
"""Settings of Inria's trainer, in the folder of the model."""
GSPLAT_FILE = "cfg.yml"
"""Settings of gsplat's example trainer, in the folder of the model."""
INRIA_DIVISORS = (1, 2, 4, 8)
"""Values of Inria's `resolution` that divide the width; others above 0 are the width itself."""
INRIA_MAX_WIDTH = 1600
"""Width in pixels to which Inria's trainer shrinks wider images by default."""
MAX_SETTINGS_BYTES = 65536
SIZE_TOLERANCE = 0.02
"""Relative difference of two sizes that rounding explains."""


@dataclass(frozen=True)
class TrainingSize:
    """Size that a trainer recorded."""

    long_side: int
    """Longer side of most training images, in pixels."""
    source: str
    """Name of the file that says so."""


def find_training_size(
    splat: Path, folder: Path, photographs: Photographs, frames: Sequence[int]
) -> TrainingSize | None:
    """Find the size that a splat was trained at; None if no file names one other than theirs.

    `folder` is that of the photographs, and `frames` are some of those whose size is compared. The
    first record of another size counts: a folder may hold files of several trainers. What cannot be
    read is no record, and leaves photographs the working size that they have without a splat.
    """
    sizes = [photographs.frame(frame).size() for frame in frames]
    if not sizes:
        return None
    own = float(median(max(size) for size in sizes))
    width = round(median(size[0] for size in sizes))
    records = [
        read_inria_scale(splat, folder, width),
        read_gsplat_scale(splat, folder),
        read_listed_scale(splat, folder, photographs, own),
    ]
    for record in records:
        if record is not None and abs(record[0] - 1) > SIZE_TOLERANCE:
            scale, source = record
            return TrainingSize(round(scale * own), source)
    return None


Record = tuple[float, str]
"""Size of the training images relative to the photographs, and the file that says so."""


def read_inria_scale(splat: Path, folder: Path, width: int) -> Record | None:
    """Read the scale of Inria's trainer: of its folder of images, and of what it makes of them.

    `width` is that of the photographs in pixels.
    """
    text = read_trainer_settings(splat, folder, INRIA_FILE)
    resolution = re.search(r"\bresolution=(-?\d{1,5})\b", text)
    if resolution is None:
        return None
    reduced = re.search(r"\bimages=['\"]images_(\d{1,2})['\"]", text)
    scale = 1.0 if reduced is None else 1 / max(int(reduced[1]), 1)
    setting = int(resolution[1])
    reduced_width = scale * width
    if setting in INRIA_DIVISORS:
        scale /= setting
    elif setting > 0:
        scale *= setting / reduced_width
    elif reduced_width > INRIA_MAX_WIDTH:
        scale *= INRIA_MAX_WIDTH / reduced_width
    return scale, INRIA_FILE


def read_gsplat_scale(splat: Path, folder: Path) -> Record | None:
    """Read the scale of gsplat's example trainer."""
    text = read_trainer_settings(splat, folder, GSPLAT_FILE)
    factor = re.search(r"^data_factor:\s*(\d{1,2})\s*$", text, re.MULTILINE)
    return None if factor is None else (1 / max(int(factor[1]), 1), GSPLAT_FILE)


def read_listed_scale(
    splat: Path, folder: Path, photographs: Photographs, own: float
) -> Record | None:
    """Read the scale of the first list of cameras whose names are those of the photographs.

    `own` is the longer side of most photographs in pixels.
    """
    names = [frame.name for frame in photographs.frames]
    for file in find_camera_lists(splat, list_trainer_folders(splat, folder)):
        with suppress(InputError):
            listed = {frame.name: frame.intrinsics.size for frame in read_camera_list(file)}
            matched = [listed[name] for _, name in match_names(names, list(listed))]
            sides = [max(size) for size in matched if size is not None]
            if sides:
                return median(sides) / own, file.name
    return None


def read_trainer_settings(splat: Path, folder: Path, name: str) -> str:
    """Read a small text file of the trainer from the nearest folder that has it, or nothing."""
    for place in list_settings_folders(splat, list_trainer_folders(splat, folder)):
        content = read_head(place / name, MAX_SETTINGS_BYTES)
        if content:
            return content.decode(errors="replace")
    return ""


def list_settings_folders(splat: Path, folders: Sequence[Path]) -> list[Path]:
    """List the folders where trainers of a splat leave settings: `folders`, and the one above."""
    # gsplat keeps its files in folders beside `cfg.yml`.
    return [*folders, splat.parent.resolve().parent]
