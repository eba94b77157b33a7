"""Files of a trainer that go with its splat from command to command (decision 152).

Beside a splat its trainer leaves the cameras of the photographs, the transform to its frame, and
the size of the images. A result lies in another folder, where a later command would know nothing of
that: it would look from elsewhere, or fit the frame anew.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from gscompleter.data.camera_files import INRIA_CAMERAS_FILE, write_camera_list
from gscompleter.data.transforms import DATAPARSER_FILE
from gscompleter.splats.alignment.trainer_frames import (
    TRAINER_FOLDER,
    find_cameras_beside,
    list_model_folders,
)
from gscompleter.splats.alignment.training_size import (
    GSPLAT_FILE,
    INRIA_FILE,
    list_settings_folders,
)
from gscompleter.types import Camera

KEPT_NAMES = (INRIA_CAMERAS_FILE, DATAPARSER_FILE, INRIA_FILE, GSPLAT_FILE)
TRAINER_FILES = tuple(f"{TRAINER_FOLDER}/{name}" for name in KEPT_NAMES)
"""Files that `keep_trainer_files` may write, below the folder of a result."""


def keep_trainer_files(splat: Path, folder: Path) -> None:
    """Copy what a trainer left beside a splat to the folder of a result made of it.

    A file that cannot be copied is left out: the result is whole without it.
    """
    for source, name in find_trainer_files(splat):
        target = folder / TRAINER_FOLDER / name
        target.parent.mkdir(exist_ok=True)
        with suppress(OSError):
            shutil.copyfile(source, target)


def find_trainer_files(splat: Path) -> Iterator[tuple[Path, str]]:
    """Find the files of the trainer of a splat, and the names that any splat is found by.

    Of several files of one kind it is the one that a command would read.
    """
    folders = list_model_folders(splat)
    # `cameras_2.json` belongs to `splat_2.ply`; the result has another name.
    cameras = find_cameras_beside(splat)
    if cameras is not None:
        yield cameras, INRIA_CAMERAS_FILE
    places = {DATAPARSER_FILE: folders}
    places |= dict.fromkeys((INRIA_FILE, GSPLAT_FILE), list_settings_folders(splat, folders))
    for name, among in places.items():
        files = [place / name for place in among if os.path.isfile(place / name)]
        for file in files[:1]:
            yield file, name


def write_trainer_cameras(folder: Path, cameras: Mapping[str, Camera]) -> None:
    """Write the cameras that a scene was reconstructed from to the folder of a result.

    `cameras`, by the names of their photographs, are in the frame of the scene's file.
    """
    (folder / TRAINER_FOLDER).mkdir(exist_ok=True)
    write_camera_list(folder / TRAINER_FOLDER / INRIA_CAMERAS_FILE, cameras)
