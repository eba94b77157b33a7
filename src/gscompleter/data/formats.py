"""Detection and opening of posed photographs in all formats.

A format is a module of this package and a line in `FORMATS`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from pathlib import Path

from gscompleter.data.camera_files import has_camera_list, open_camera_list, refuse_other_exports
from gscompleter.data.chunks import has_chunks, open_chunks
from gscompleter.data.colmap.scene import has_colmap, open_colmap
from gscompleter.data.driving.dgp import has_dgp, open_dgp
from gscompleter.data.driving.kitti import has_kitti, has_kitti_raw, open_kitti, open_kitti_raw
from gscompleter.data.driving.mmdet3d import has_infos, open_infos
from gscompleter.data.driving.pandaset import has_pandaset, open_pandaset
from gscompleter.data.driving.waymo import has_waymo, open_waymo
from gscompleter.data.ego_vehicle import attach_vehicle_detector
from gscompleter.data.image_folders import FOLDERS
from gscompleter.data.limits import check_planes
from gscompleter.data.llff import has_llff, open_llff
from gscompleter.data.photographs import Photographs
from gscompleter.data.real_estate import has_camera_files, open_camera_files
from gscompleter.data.sfm.poses import ENDINGS, is_own
from gscompleter.data.transforms import has_transforms, open_transforms
from gscompleter.errors import InputError, join_names, quote_value


@dataclass(frozen=True)
class Format:
    """A layout of posed photographs on disk."""

    detect: Callable[[Path], bool]
    """Detects the format of a file or folder by names and first bytes."""
    open: Callable[[Path], Iterable[Photographs]]
    """Opens the scenes in such a file or folder one at a time; reads only cameras."""
    unit: str | None = None
    """Unit of the coordinates, or None if the format does not define it."""


SCENE_DEPTH = 2
"""Levels of subfolders searched for scenes that an error message names."""
MAX_NAMED = 4
"""Most scenes that the message names."""

FORMATS = {
    "chunks": Format(has_chunks, open_chunks),
    "dgp": Format(has_dgp, open_dgp, "m"),
    "nerfstudio": Format(has_transforms, open_transforms),
    "colmap": Format(has_colmap, open_colmap),
    "cameras-json": Format(has_camera_list, open_camera_list),
    "llff": Format(has_llff, open_llff),
    "kitti": Format(has_kitti, open_kitti, "m"),
    "kitti-raw": Format(has_kitti_raw, open_kitti_raw, "m"),
    "pandaset": Format(has_pandaset, open_pandaset, "m"),
    "mmdet3d": Format(has_infos, open_infos, "m"),
    "waymo": Format(has_waymo, open_waymo, "m"),
    "real-estate-10k": Format(has_camera_files, open_camera_files),
}
"""Formats by the names that `open_photographs` takes, in the order of detection."""


def open_photographs(
    path: Path | str, format: str | None = None, near: float | None = None, far: float | None = None
) -> Photographs:
    """Open the photographs of one scene; reads only its cameras.

    Args:
        path: A file or folder of one of `FORMATS` with a single scene.
        format: Name of the format; detected if None.
        near: Smallest z-depth in scene units; that of the files if None.
        far: Largest z-depth in scene units; that of the files if None.

    Raises:
        InputError: If there is no scene or more than one, or its cameras cannot be read.
    """
    check_planes(near, far)
    path = Path(path)
    found = detect_format(path, format)
    scenes = list(islice(FORMATS[found].open(path), 2))
    if len(scenes) > 1:
        raise InputError(
            f"{quote_value(path)} holds several scenes, such as {quote_value(scenes[0].name)} and "
            f"{quote_value(scenes[1].name)}; name a file or folder with one of them."
        )
    (scene,) = scenes
    near, far = scene.near if near is None else near, scene.far if far is None else far
    check_planes(near, far)
    sparse = None if scene.sparse is None else cache(scene.sparse)
    frames = attach_vehicle_detector(scene.frames)
    return replace(scene, frames=frames, near=near, far=far, format=found, sparse=sparse)


def detect_format(path: Path, name: str | None = None) -> str:
    """Return the given format name after checking it, or detect the format of `path`."""
    if name is not None and name not in FORMATS:
        raise InputError(
            f"There is no format '{quote_value(name)}'; choose one of {', '.join(FORMATS)}."
        )
    if not os.path.exists(path):
        raise InputError(f"There is no {quote_value(path)}; {describe_formats()}.")
    found = find_format(path) if name is None else name
    if found is None:
        refuse_other_exports(path)
        refuse_scenes_below(path)
        raise InputError(
            f"There are no posed photographs in {quote_value(path)}; {describe_formats()}."
        )
    return found


def refuse_scenes_below(path: Path) -> None:
    """Refuse a folder without photographs whose subfolders hold scenes, and name them."""

    def has_image_folder(folder: Path) -> bool:
        return any(os.path.isdir(folder / name) for name in FOLDERS)

    if not os.path.isdir(path) or has_image_folder(path):
        return
    if any(name.lower().endswith(ENDINGS) for name in os.listdir(path)):
        return
    found = list(_list_scenes_below(path, lambda folder: find_format(folder) is not None))
    if not found:
        found = list(_list_scenes_below(path, has_image_folder))
        if len(found) < 2:
            return
    names = join_names([one.relative_to(path) for one in found], MAX_NAMED, 20)
    scenes = "one" if len(found) == 1 else f"{len(found)} scenes"
    raise InputError(
        f"{quote_value(path, 50)} is no scene itself, but holds {scenes} below it: {names}; "
        f"name one of them, as in {quote_value(found[0], 60)}."
    )


def _list_scenes_below(
    path: Path, is_scene: Callable[[Path], bool], depth: int = SCENE_DEPTH
) -> Iterator[Path]:
    """List the scenes at most `depth` folders down, sorted; skips our own results."""
    for folder in sorted(path.iterdir()):
        if not folder.is_dir() or not is_own(folder):
            continue
        if is_scene(folder):
            yield folder
        elif depth > 1:
            yield from _list_scenes_below(folder, is_scene, depth - 1)


def find_format(path: Path) -> str | None:
    """Detect the first format that fits a file or folder; None if none does."""
    return next((name for name, format in FORMATS.items() if format.detect(path)), None)


def describe_formats() -> str:
    """Describe the accepted formats for error messages."""
    return (
        "name photographs with cameras, in one of these formats (docs/formats.md): "
        f"{', '.join(FORMATS)}"
    )
