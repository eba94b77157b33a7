"""Scenes in DGP format, as DDAD publishes them: JSON files of sensors and calibrations.

Every image has the pose of its camera, camera-to-world in OpenCV axes. A sample names the
calibration that its images share, with intrinsics by camera name. The point cloud of the sample
gives sparse depth.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.driving.lidar import MAX_SWEEP, transform_finite
from gscompleter.data.frame import Frame
from gscompleter.data.json_fields import (
    get_intrinsics,
    get_list,
    get_object,
    get_pose,
    get_size,
    get_text,
)
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.errors import InputError, quote_value
from gscompleter.io.json_file import read_json
from gscompleter.io.reading import open_file, read_head

CALIBRATIONS = "calibration"
ADVICE = "download the scene again"
MAX_SNIFFED = 1 << 26
"""Bytes read from a file to detect a scene."""


def has_dgp(path: Path) -> bool:
    """Check whether `path` is a DGP scene file, or a folder with one."""
    return _find_scene_file(path) is not None


def open_dgp(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a DGP scene; its folder names it.

    Frames of all cameras are numbered by their sorted names, which are paths below the folder. The
    first camera by name, in DDAD CAMERA_01, is the front camera.
    """
    file = _find_scene_file(path)
    if file is None:
        raise InputError(f"There is no scene of DGP in {quote_value(path)}; name its scene.json.")
    content = read_json(file, ADVICE)
    cameras = _read_calibrations(file, content)
    images = [d for d in get_list(content, "data") if "image" in get_object(d, "datum")]
    sweeps = _map_sweeps(content)
    frames = sorted((_parse_frame(d, cameras, sweeps, file) for d in images), key=lambda f: f.name)
    if not frames:
        raise InputError(f"{quote_value(file)} lists no images; name a scene with cameras.")
    front = min(frame.sensor or "" for frame in frames)
    yield build_photographs(file.resolve().parent.name, str(file), frames, front=front)


def _parse_frame(
    datum: Any, cameras: Mapping[str, Intrinsics], sweeps: Mapping[str, Any], file: Path
) -> Frame:
    image, camera = get_object(datum["datum"], "image"), get_object(datum, "id").get("name")
    name = get_text(image, "filename", str(file))
    title = f"image {quote_value(name)} of {quote_value(file)}"
    if name is None or not isinstance(camera, str) or camera not in cameras:
        raise InputError(
            f"The {title} has no file name, or its camera {quote_value(camera)} is not in the "
            f"calibration; {ADVICE}."
        )
    intrinsics = replace(cameras[camera], size=get_size(image, title))
    sweep = get_object(get_object(sweeps.get(str(datum.get("key"))), "datum"), "point_cloud")
    points, read = get_text(sweep, "filename", str(file)), None
    if points is not None:
        pose = _get_pose(sweep, str(file))
        exists = os.path.isfile(file.parent / points)
        read = partial(_read_points, file.parent / points, pose) if exists else None
    c2w, place = _get_pose(image, title), file.parent / name
    return Frame(name, title, c2w, intrinsics, place, sensor=camera, laser_points=read)


def _get_pose(entry: Mapping[str, Any], title: str) -> Float[np.ndarray, "4 4"]:
    quaternion = ("qw", "qx", "qy", "qz")
    return get_pose(entry.get("pose"), "translation", "rotation", quaternion, title)


def _map_sweeps(content: Any) -> dict[str, Any]:
    """Map the key of each datum to the point cloud of its sample."""
    data = {str(d.get("key")): d for d in get_list(content, "data") if isinstance(d, dict)}
    found: dict[str, Any] = {}
    for sample in get_list(content, "samples"):
        keys = [str(key) for key in get_list(sample, "datum_keys")]
        clouds = [k for k in keys if "point_cloud" in get_object(data.get(k), "datum")]
        found |= {key: data[clouds[0]] for key in keys if clouds}
    return found


def _read_points(
    path: Path, world_from_laser: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "n 3"]:
    """Read the points of a sweep in the world frame: the first three columns of `data`."""
    try:
        with open_file(path) as file, zipfile.ZipFile(file) as archive:
            if archive.getinfo("data.npy").file_size > MAX_SWEEP:
                raise ValueError
            with archive.open("data.npy") as member:
                table = np.lib.format.read_array(member, allow_pickle=False)
        if table.ndim != 2 or table.shape[1] < 3 or table.dtype.kind not in "fiu":
            raise ValueError
        return transform_finite(table[:, :3].astype(np.float64), world_from_laser)
    except InputError:
        raise
    except Exception as error:  # damaged archives and arrays raise anything
        raise InputError(f"{quote_value(path)} is no point cloud of DGP; {ADVICE}.") from error


def _read_calibrations(scene: Path, content: Any) -> dict[str, Intrinsics]:
    """Read the intrinsics by camera name, without image sizes."""
    file = _find_calibration_file(scene, content)
    calibration = read_json(file, ADVICE)
    names, entries = get_list(calibration, "names"), get_list(calibration, "intrinsics")
    # Entries of other sensors are zeros.
    return {
        name: get_intrinsics(entry, f"camera {quote_value(name)} of {quote_value(file)}")
        for name, entry in zip(names, entries, strict=False)
        if isinstance(name, str) and isinstance(entry, dict) and entry.get("fx") not in (None, 0)
    }


def _find_calibration_file(scene: Path, content: Any) -> Path:
    """Find the calibration of the first sample: `calibration/KEY.json` or calibration.json."""
    samples = get_list(content, "samples")
    key = samples[0].get("calibration_key") if samples and isinstance(samples[0], dict) else None
    folder = scene.parent / CALIBRATIONS
    candidates = [folder / f"{key}.json", scene.with_name(f"{CALIBRATIONS}.json")]
    found = next((path for path in candidates if os.path.isfile(path)), None)
    if found is None:
        raise InputError(
            f"The calibration of {quote_value(scene)} is missing; put it at "
            f"{quote_value(candidates[0])}."
        )
    return found


def _find_scene_file(path: Path) -> Path | None:
    files = sorted(path.glob("scene*.json")) if os.path.isdir(path) else [path]
    files = [file for file in files if file.suffix == ".json" and os.path.isfile(file)]
    return next((file for file in files if b'"datum"' in read_head(file, MAX_SNIFFED)), None)
