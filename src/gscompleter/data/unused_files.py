"""Depth and poses that lie in a folder of photographs and are not read, by their names.

Data sets and apps write them in many layouts. One that is not known must not look as if nothing
were there: a line names it.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from fnmatch import fnmatch
from pathlib import Path

from gscompleter.data.file_names import is_photograph_name
from gscompleter.data.frame import FOLDERS, Frame
from gscompleter.data.masks import leave_out_masks
from gscompleter.system.errors import InputError, join_names, quote_value
from gscompleter.system.files.image_opening import open_image
from gscompleter.system.files.names import is_hidden_name

DEPTH_FOLDERS = (
    "depth", "depths", "depth_maps", "depth_map", "depths_any", "depth_any", "mono_depth",
    "sensor_depth", "lowres_depth", "highres_depth", "lidar_depth", "rendered_depth_maps",
)  # fmt: skip
"""Folders of depth maps, as data sets and trainers name them."""
OTHER_FOLDERS = ("confidence", "normals", "mono_normals", "mono_normal")
"""Folders of images that are no photographs either."""
DEPTH_FILES = ("*depth*.png", "*depth*.exr", "*depth*.npy", "*depth*.tif*", "*depth*.pfm")
"""Depth maps beside photographs."""
SWEEPS = ("lidar", "velodyne", "velodyne_points", "fused.ply", "*.las", "*.laz", "*.e57", "*.pcd")
"""Laser sweeps, and point clouds of scanners and dense stereo."""
POSE_FILES = {
    "pose": "poses as text, a file for each photograph",
    "poses": "poses, a file for each photograph",
    "cams": "cameras of MVSNet",
    "extrinsics": "poses, a file for each photograph",
    "ego_pose": "poses of a vehicle",
    "lowres_wide.traj": "poses of ARKitScenes",
    "*.traj": "a trajectory",
    "*.pose.txt": "poses of 7-Scenes",
    "traj.txt": "a trajectory",
    "trajectory.txt": "a trajectory",
    "traj_w_c.txt": "a trajectory",
    "poses.txt": "a trajectory",
    "groundtruth.txt": "a trajectory of TUM RGB-D",
    "odometry.csv": "poses of Stray Scanner",
    "cameras_sphere.npz": "cameras of IDR and NeuS",
    "cameras.npz": "cameras of IDR and NeuS",
    "sfm_data.json": "cameras of OpenMVG",
    "cameras.sfm": "cameras of Meshroom",
    "sfm.abc": "cameras of Meshroom",
    "*.nvm": "cameras of VisualSFM",
    "bundle.out": "cameras of Bundler",
    "reconstruction.json": "cameras of OpenSfM",
    "frame_annotations.jgz": "cameras of CO3D",
}
"""Files and folders of poses in layouts that are not read, and what they are."""
MAX_UNUSED_FILES = 3
"""Files that a phrase names."""


def list_unused(folder: Path, frames: Sequence[Frame], has_found_cameras: bool) -> tuple[str, ...]:
    """List what lies in a folder and is not used, in phrases.

    Args:
        folder: Folder of a scene.
        frames: Its frames; depth counts as used if any has some.
        has_found_cameras: True if cameras were searched for, so that no poses of files are used.
    """
    if not os.path.isdir(folder):
        return ()
    names = sorted(name for name in os.listdir(folder) if not is_hidden_name(name))
    unused = []
    if not any(frame.depth or frame.predicted_depth for frame in frames):
        kept = [name for name in names if name.casefold() in DEPTH_FOLDERS]
        unused += [f"{name} ({_count(folder / name)} of depth)" for name in kept]
        unused += _list_depth_beside(frames)
        if has_found_cameras:
            maps = [name for name in names if is_depth_map(folder / name)]
            unused += [f"{len(maps):,} depth maps such as {quote_value(maps[0])}"] if maps else []
    if not any(frame.laser_points for frame in frames):
        sweeps = [name for name in names if _matches(name, SWEEPS)]
        unused += [f"{name} (points of a laser or of dense stereo)" for name in sweeps]
    if has_found_cameras:
        kinds: dict[str, list[str]] = {}
        for name in names:
            pattern = next((one for one in POSE_FILES if fnmatch(name.casefold(), one)), None)
            if pattern is not None:
                kinds.setdefault(pattern, []).append(name)
        unused += [
            f"{join_names(found, MAX_UNUSED_FILES)} ({POSE_FILES[pattern]})"
            for pattern, found in kinds.items()
        ]
    return (*unused, *_list_without_camera(frames))


def is_depth_map(path: Path) -> bool:
    """Check whether an image is a depth map by its name and its grey values of 16 or 32 bits."""
    if "depth" not in path.name.casefold() or path.suffix.lower() not in (".png", ".tif", ".tiff"):
        return False
    # What cannot be read is named as a photograph later.
    with suppress(InputError), open_image(path) as image:
        return image.mode[0] in "IF"
    return False


def _count(folder: Path) -> str:
    """Count the files in a folder, or say that it is a file."""
    if not os.path.isdir(folder):
        return "a file"
    return f"{sum(not is_hidden_name(name) for name in os.listdir(folder)):,} files"


def _matches(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch(name.casefold(), pattern) for pattern in patterns)


def _list_homes(frames: Sequence[Frame]) -> dict[Path, set[str]]:
    """Map the folders of photographs to the names of those that are used."""
    homes: dict[Path, set[str]] = {}
    for frame in frames:
        path = None if frame.file is None else frame.file.path
        if path is not None:
            homes.setdefault(path.parent, set()).add(path.name)
    return homes


def _list_depth_beside(frames: Sequence[Frame]) -> list[str]:
    """Name depth maps that lie between the photographs."""
    phrases = []
    for home, used in _list_homes(frames).items():
        names = [name for name in sorted(os.listdir(home)) if not is_hidden_name(name)]
        found = [name for name in names if _matches(name, DEPTH_FILES) and name not in used]
        if found:
            phrases.append(
                f"{len(found):,} depth maps such as {quote_value(found[0])} in {home.name}"
            )
    return phrases


def _list_without_camera(frames: Sequence[Frame]) -> list[str]:
    """Name photographs in the usual folders of which no frame has the camera."""
    phrases = []
    for home, used in _list_homes(frames).items():
        if home.name.casefold() not in FOLDERS:
            continue
        images = [name for name in sorted(os.listdir(home)) if is_photograph_name(name)]
        # Names are compared as they are on the disk: `used` come from there, too.
        extra = [name for name in leave_out_masks(images) if name not in used]
        extra = [name for name in extra if not _matches(name, DEPTH_FILES)]
        if extra:
            noun = "photograph" if len(extra) == 1 else "photographs"
            phrases.append(
                f"{len(extra):,} {noun} in {home.name} without a camera "
                f"({join_names(extra, MAX_UNUSED_FILES)})"
            )
    return phrases
