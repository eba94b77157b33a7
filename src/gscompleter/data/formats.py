"""Detection and opening of posed photographs in all formats.

A format is a module of this package and a row in `SCENE_FORMATS`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from pathlib import Path

from gscompleter.data.camera_files import has_camera_list, open_camera_list, refuse_other_exports
from gscompleter.data.colmap import has_colmap, open_colmap
from gscompleter.data.driving.dgp import list_scene_files, open_dgp
from gscompleter.data.driving.kitti import has_kitti, has_kitti_raw, open_kitti, open_kitti_raw
from gscompleter.data.driving.mmdet3d import has_infos, open_infos
from gscompleter.data.driving.pandaset import has_pandaset, open_pandaset
from gscompleter.data.driving.waymo import list_segments, open_waymo
from gscompleter.data.ego_vehicle import attach_vehicle_detector
from gscompleter.data.file_names import is_photograph_name
from gscompleter.data.frame import FOLDERS, describe_moved, describe_unposed
from gscompleter.data.limits import check_planes, require
from gscompleter.data.llff import has_llff, open_llff
from gscompleter.data.masks import attach_masks
from gscompleter.data.multi_view_stereo import has_idr, has_mvsnet, open_idr, open_mvsnet
from gscompleter.data.one_photograph import find_photograph, open_photograph
from gscompleter.data.phones.apps import POLYCAM, SCANNER_APP, find_recordings, open_recording
from gscompleter.data.photographs import Photographs
from gscompleter.data.real_estate import (
    has_chunks,
    list_camera_files,
    open_camera_files,
    open_chunks,
)
from gscompleter.data.rgbd import has_replica, has_scannet, open_replica, open_scannet
from gscompleter.data.sfm.poses import is_own, list_unplaced
from gscompleter.data.transforms import has_transforms, open_transforms
from gscompleter.data.unused_files import list_unused
from gscompleter.system.errors import InputError, join_names, quote_value, require_path
from gscompleter.system.files.names import is_hidden_name
from gscompleter.system.files.reading import list_folders


@dataclass(frozen=True)
class SceneFormat:
    """A layout of posed photographs on disk."""

    detect: Callable[[Path], object]
    """Detects the format of a file or folder by names and first bytes; may return its files."""
    open: Callable[[Path], Iterable[Photographs]]
    """Opens the scenes in such a file or folder one at a time, at least one; reads only cameras.
    Raises InputError where it is damaged, at once or while iterating."""
    unit: str | None = None
    """Unit of the coordinates, or None if the format does not define it."""


# fmt: off
UNREAD = (
    ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf", ".raw",  # of cameras
    ".jxl", ".exr", ".hdr", ".psd",
)
# fmt: on
"""Endings of photographs that are not read: raw data of cameras, and formats of other programs."""
MAX_NAMED_SCENES = 4
"""Most scenes that the sentence names which refuses a folder of scenes."""
MAX_SEARCHED_FOLDERS = 1000
"""Most folders below a path that are searched for scenes to name."""

SCENE_FORMATS = {
    "chunks": SceneFormat(has_chunks, open_chunks),
    "dgp": SceneFormat(list_scene_files, open_dgp, "m"),
    "nerfstudio": SceneFormat(has_transforms, open_transforms),
    "colmap": SceneFormat(has_colmap, open_colmap),
    "cameras-json": SceneFormat(has_camera_list, open_camera_list),
    "llff": SceneFormat(has_llff, open_llff),
    "kitti": SceneFormat(has_kitti, open_kitti, "m"),
    "kitti-raw": SceneFormat(has_kitti_raw, open_kitti_raw, "m"),
    "pandaset": SceneFormat(has_pandaset, open_pandaset, "m"),
    "mmdet3d": SceneFormat(has_infos, open_infos, "m"),
    "waymo": SceneFormat(list_segments, open_waymo, "m"),
    "real-estate-10k": SceneFormat(list_camera_files, open_camera_files),
    "polycam": SceneFormat(POLYCAM.find_frames, POLYCAM.open, "m"),
    "record3d": SceneFormat(find_recordings, open_recording, "m"),
    "3d-scanner-app": SceneFormat(SCANNER_APP.find_frames, SCANNER_APP.open, "m"),
    "scannet": SceneFormat(has_scannet, open_scannet, "m"),
    "replica": SceneFormat(has_replica, open_replica, "m"),
    "mvsnet": SceneFormat(has_mvsnet, open_mvsnet),
    "idr": SceneFormat(has_idr, open_idr),
    "photograph": SceneFormat(find_photograph, open_photograph),
}
"""Formats by the names that `open_photographs` takes, in the order of detection."""


def open_photographs(
    path: Path | str, format: str | None = None, near: float | None = None, far: float | None = None
) -> Photographs:
    """Open the photographs of one scene; reads only its cameras.

    The format is detected if None. `near` and `far` are the smallest and largest z-depth in scene
    units; those of the files if None. Masks beside the photographs, and what tells the vehicle that
    carries the camera, are attached; they are read when they are needed.

    Raises:
        InputError: There are no posed photographs, several scenes, or damaged files; or the planes
            are impossible.
    """
    check_planes(near, far)
    path = require_path(path)
    format_name = detect_format(path, format)
    # Two scenes are enough to know that there are several, and opening one may take long.
    scene, *others = islice(SCENE_FORMATS[format_name].open(path), 2)
    names = " and ".join(quote_value(one.name) for one in (scene, *others))
    require(
        not others,
        f"{quote_value(path)} holds several scenes, such as {names}; name a path with one of them.",
    )
    near = scene.near if near is None else near
    far = scene.far if far is None else far
    check_planes(near, far)
    sparse = None if scene.sparse is None else cache(scene.sparse)
    unposed = describe_unposed(scene.frames, scene.title)
    notes = (*scene.notes, *unposed, *describe_moved(scene.frames, scene.title))
    frames = scene.frames
    # Photographs for which our own search found no camera keep their numbers.
    unplaced = list_unplaced(scene, path)
    if unplaced:
        frames = tuple(sorted([*frames, *unplaced], key=lambda frame: frame.name))
    frames = attach_vehicle_detector(attach_masks(frames))
    # Poses in layouts that are not known matter only where these had to be found. An archive may
    # lie anywhere, and what lies beside it is not of the scene.
    folder = path.parent if path.suffix.lower() == ".json" else path
    unused = list_unused(folder, frames, has_found_cameras=format_name == "photograph")
    return replace(
        scene,
        frames=frames,
        near=near,
        far=far,
        notes=notes,
        unused=unused,
        format=format_name,
        sparse=sparse,
    )


def detect_format(path: Path, name: str | None = None) -> str:
    """Return the given format name after checking it, or detect the format of `path`.

    InputError is raised if there are no such photographs.
    """
    formats = ", ".join(SCENE_FORMATS)
    advice = "name photographs with cameras, such as colmap, nerfstudio or others (docs/formats.md)"
    require(
        name is None or (isinstance(name, str) and name in SCENE_FORMATS),
        f"There is no format '{quote_value(name)}'; choose one of {formats}.",
    )
    require(os.path.exists(path), f"There is no {quote_value(path)}; {advice}.")
    if name is not None and SCENE_FORMATS[name].detect(path):
        return name
    # A named format that does not fit is an error; another one is not tried.
    detected = None if name else find_format(path)
    if detected is None:
        refuse_other_exports(path)
        refuse_scenes_below(path)
        refuse_unread(path)
        kind = f"photographs in the format {name}" if name else "posed photographs"
        raise InputError(f"There are no {kind} in {quote_value(path)}; {advice}.")
    return detected


def refuse_scenes_below(path: Path) -> None:
    """Refuse a folder without photographs whose subfolders hold scenes, and name them."""

    def has_image_folder(folder: Path) -> bool:
        return any(os.path.isdir(folder / name) for name in FOLDERS)

    if not os.path.isdir(path) or has_image_folder(path):
        return
    if any(is_photograph_name(name) for name in os.listdir(path)):
        return

    # Two levels down: a folder of scenes, or one of such folders.
    near = [folder for folder in list_folders(path) if is_own(folder)]
    inside = [child for folder in near for child in list_folders(folder)]
    require(
        len(near) + len(inside) <= MAX_SEARCHED_FOLDERS,
        f"{quote_value(path)} is no scene itself, and has {len(near) + len(inside):,} folders "
        "below it; name the folder of one scene.",
    )
    below = sorted(near + [folder for folder in inside if is_own(folder)])
    posed = [folder for folder in below if find_format(folder)]
    plain = [folder for folder in below if has_image_folder(folder)]
    scenes = posed or (plain if len(plain) > 1 else [])
    # A folder of a scene, such as sparse/0, may be readable by itself and is not another scene.
    scenes = [folder for folder in scenes if folder.parent not in scenes]
    names = join_names([folder.relative_to(path) for folder in scenes], MAX_NAMED_SCENES, 20)
    require(
        not scenes,
        f"{quote_value(path, 50)} is no scene itself, but holds {len(scenes)} scene(s) below it: "
        f"{names}; name one of them.",
    )


def refuse_unread(path: Path) -> None:
    """Refuse photographs in a file format that is not read, by its name and with the way out."""
    names = sorted(os.listdir(path)) if os.path.isdir(path) else [path.name]
    unread = [name for name in names if not is_hidden_name(name) and name.lower().endswith(UNREAD)]
    if unread:
        example = quote_value(unread[0])
        count = f"the photograph {example}"
        if len(unread) > 1:
            count = f"{len(unread)} photographs such as {example}"
        raise InputError(
            f"{quote_value(path)} holds {count}, whose format is not read; export JPEG or PNG from "
            "the program that develops them."
        )


def find_format(path: Path) -> str | None:
    """Detect the first format that fits a file or folder; None if none does."""
    return next((name for name, format in SCENE_FORMATS.items() if format.detect(path)), None)
