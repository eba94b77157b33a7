"""Recordings of depth cameras with poses, as two data sets lay them out; in metres.

* ScanNet exports `color/N.jpg`, `depth/N.png` (millimetres), `pose/N.txt` (camera-to-world, OpenCV
  axes, infinite where tracking was lost) and `intrinsic/intrinsic_color.txt`.
* Replica as rendered for SLAM has `results/frameN.jpg`, `results/depthN.png`, `traj.txt` (a line of
  16 numbers for each, camera-to-world) and `cam_params.json`, there or one folder above, with the
  intrinsics at whole pixels as centres and the `scale` of depth.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.file_names import FolderListings
from gscompleter.data.frame import Frame, find_file
from gscompleter.data.json_fields import get_intrinsics, get_number, get_size
from gscompleter.data.limits import DEPTH_RANGE, require
from gscompleter.data.number_files import read_numbers
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.system.errors import quote_value
from gscompleter.system.files.depth_file import read_depth
from gscompleter.system.files.reading import read_json

COLOR = "color"
POSE = "pose"
DEPTH_FOLDER = "depth"
LENS_FILE = "intrinsic/intrinsic_color.txt"
RESULTS_FOLDER = "results"
TRAJECTORY = "traj.txt"
CAM_PARAMETERS_FILE = "cam_params.json"
RGBD_ENDINGS = (".jpg", ".jpeg", ".png")
MILLIMETRES = 1e-3
RGBD_ADVICE = "export the recording again"


def has_scannet(path: Path) -> bool:
    """Check whether a folder is a scene that ScanNet's reader exported."""
    return all((path / name).is_dir() for name in (COLOR, POSE)) and (path / LENS_FILE).is_file()


def open_scannet(path: Path) -> Iterator[Photographs]:
    """Open a scene of ScanNet; frames are numbered by the numbers of its photographs."""
    fx, fy, cx, cy = read_numbers(path / LENS_FILE, (4, 4), RGBD_ADVICE)[
        [0, 1, 0, 1], [0, 1, 2, 2]
    ].tolist()
    lens = Intrinsics(None, (fx, fy), (cx, cy))
    listings = FolderListings()
    images = [file for file in (path / COLOR).iterdir() if file.suffix.lower() in RGBD_ENDINGS]
    numbered = {int(file.stem): file for file in images if file.stem.isdecimal()}
    require(
        numbered, f"There are no photographs N.jpg in {quote_value(path / COLOR)}; {RGBD_ADVICE}."
    )
    frames = []
    for number in sorted(numbered):
        pose = find_file([path / POSE], [f"{number}.txt"], listings)
        depth = find_file([path / DEPTH_FOLDER], [f"{number}.png"], listings)
        image = numbered[number]
        name = f"{COLOR}/{image.name}"
        frame = Frame(
            name,
            f"frame {quote_value(name)} of {quote_value(path)}",
            np.full((4, 4), np.nan) if pose is None else read_numbers(pose, (4, 4), RGBD_ADVICE),
            lens,
            image,
            None if depth is None else partial(read_depth, depth, MILLIMETRES),
            lack="it has no pose" if pose is None else None,
        )
        frames.append(frame.with_rigid_pose())
    yield build_photographs(path.resolve().name, quote_value(path), frames)


def has_replica(path: Path) -> bool:
    """Check whether `path` is a scene of Replica that was rendered for SLAM, or its trajectory."""
    folder = _find_replica_folder(path)
    has_results = (folder / RESULTS_FOLDER).is_dir() and (folder / TRAJECTORY).is_file()
    return has_results and _find_parameters(folder) is not None


def _find_replica_folder(path: Path) -> Path:
    is_file = path.name == TRAJECTORY and os.path.isfile(path)
    return path.parent if is_file else path


def _find_parameters(path: Path) -> Path | None:
    files = [folder / CAM_PARAMETERS_FILE for folder in (path, path.resolve().parent)]
    return next((file for file in files if os.path.isfile(file)), None)


def open_replica(path: Path) -> Iterator[Photographs]:
    """Open a scene of Replica; frames are numbered by their order."""
    path = _find_replica_folder(path)
    file = _find_parameters(path)
    assert file is not None
    content = read_json(file, RGBD_ADVICE)
    camera = content.get("camera") if isinstance(content, dict) else None
    title = f"`camera` of {quote_value(file)}"
    lens = get_intrinsics(camera, title)
    cx, cy = lens.center
    assert cx is not None
    assert cy is not None
    # Whole numbers are pixel centres there: those of 1200 pixels have their middle at 599.5.
    lens = Intrinsics(get_size(camera, title, "w", "h"), lens.focal, (cx + 0.5, cy + 0.5))
    unit = 1 / get_number(camera, "scale", title, *DEPTH_RANGE)

    files = sorted((path / RESULTS_FOLDER).iterdir())
    images = [f for f in files if f.name.startswith("frame") and f.suffix.lower() in RGBD_ENDINGS]
    poses = read_numbers(path / TRAJECTORY, (None, 16), RGBD_ADVICE).reshape(-1, 4, 4)
    require(
        len(images) == len(poses),
        f"{quote_value(path / TRAJECTORY)} has {len(poses):,} poses, and {quote_value(path)} "
        f"{len(images):,} photographs; {RGBD_ADVICE}.",
    )
    listings = FolderListings()
    frames = []
    for image, c2w in zip(images, poses, strict=True):
        stem = image.stem.replace("frame", "depth")
        depth = find_file([image.parent], [f"{stem}.png"], listings)
        name = f"{RESULTS_FOLDER}/{image.name}"
        frame = Frame(
            name,
            f"frame {quote_value(name)} of {quote_value(path)}",
            c2w,
            lens,
            image,
            None if depth is None else partial(read_depth, depth, unit),
        )
        frames.append(frame.with_rigid_pose())
    yield build_photographs(path.resolve().name, quote_value(path), frames)
