"""Scenes in DGP format, as DDAD publishes them: JSON files of sensors and calibrations.

Every image has the pose of its camera, camera-to-world in OpenCV axes. A sample names the
calibration that its images share, with intrinsics by camera name, whose distortion is OpenCV's. The
point cloud of the sample gives sparse depth. See dgp/proto in https://github.com/TRI-ML/dgp.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import PANORAMA_ADVICE, Distortion, Intrinsics
from gscompleter.data.driving.vehicle import transform_points
from gscompleter.data.frame import Frame
from gscompleter.data.json_fields import (
    get_intrinsics,
    get_optional_number,
    get_part,
    get_pose,
    get_size,
    get_text,
)
from gscompleter.data.limits import MAX_COEFFICIENT, require
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_head, read_json

DGP_ADVICE = "download the scene again"
MAX_SNIFFED = 1 << 26
"""Bytes read from a file to detect a scene."""
OTHER_LENSES = (
    "fisheye", "equirectangular", "skew", "s1", "s2", "s3", "s4", "taux", "tauy", "alpha", "beta",
    "w", "xi",
)  # fmt: skip
"""Parameters of lenses that are not read, which are 0 or absent for OpenCV's usual distortion."""
NO_SAMPLE = ""
"""Key of a datum that no sample lists; a datum has a digest for its key."""


def open_dgp(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a DGP scene; its folder names it.

    Frames of all cameras are numbered by their sorted names, which are paths below the folder. The
    first camera by name, in DDAD CAMERA_01, is the front camera. Several scene files in one folder
    are scenes of their own, which their files name.
    """
    files = list_scene_files(path)
    for file in files:
        name = file.parent.resolve().name if len(files) == 1 else file.stem
        yield _open_scene_file(file, name)


def _open_scene_file(file: Path, name: str) -> Photographs:
    content = read_json(file, DGP_ADVICE)
    calibrations = _locate_calibrations(file, content)
    lenses = {path: _read_calibration(path) for path in dict.fromkeys(calibrations.values())}
    sweeps = _map_sweeps(content)
    # A datum is a reading of one sensor: an image, or a point cloud.
    images = [d for d in get_part(content, "data", list) if "image" in get_part(d, "datum", dict)]
    frames = []
    for datum in images:
        key = str(datum.get("key"))
        cameras = lenses[calibrations.get(key, calibrations[NO_SAMPLE])]
        frames.append(_parse_datum(datum, cameras, sweeps.get(key), file))
    frames.sort(key=lambda frame: frame.name)
    require(frames, f"{quote_value(file)} lists no images; name a scene with cameras.")
    front = min(frame.sensor or "" for frame in frames)
    return build_photographs(name, quote_value(file), frames, front=front)


def _parse_datum(datum: Any, cameras: Mapping[str, Any], sweep: Any, file: Path) -> Frame:
    """Parse an image with the cameras of its calibration and the point cloud of its sample."""
    image = datum["datum"]["image"]
    sensor = get_part(datum, "id", dict).get("name")
    camera = "" if sensor is None else str(sensor)
    name = get_text(image, "filename", quote_value(file)) or ""
    title = f"image {quote_value(name)} of {quote_value(file)}"
    require(name, f"The {title} has no `filename`; {DGP_ADVICE}.")
    require(camera, f"The {title} does not say which camera took it (`id.name`); {DGP_ADVICE}.")
    require(
        camera in cameras,
        f"The camera {quote_value(camera)} of {title} is not in the calibration; {DGP_ADVICE}.",
    )
    lens = _parse_lens(cameras[camera], f"camera {quote_value(camera)} of {quote_value(file)}")
    intrinsics = replace(lens, size=get_size(image, title))

    # Sparse depth is optional: the point cloud may be missing on disk.
    read_points = None
    points = get_text(sweep, "filename", quote_value(file))
    if points is not None and os.path.isfile(file.parent / points):
        read_points = partial(
            _read_sweep_points, file.parent / points, _get_pose(sweep, quote_value(file))
        )
    c2w = _get_pose(image, title)
    place = file.parent / name
    return Frame(name, title, c2w, intrinsics, place, sensor=camera, laser_points=read_points)


def _get_pose(entry: Any, title: str) -> Float[np.ndarray, "4 4"]:
    pose = get_part(entry, "pose", dict)
    quaternion = ("qw", "qx", "qy", "qz")
    return get_pose(pose, "translation", "rotation", quaternion, title)


def _map_sweeps(content: Any) -> dict[str, Any]:
    """Map the key of each datum to the point cloud of its sample."""
    data = [datum for datum in get_part(content, "data", list) if isinstance(datum, dict)]
    entries = {str(datum.get("key")): get_part(datum, "datum", dict) for datum in data}
    sweeps: dict[str, Any] = {}
    for sample in get_part(content, "samples", list):
        keys = [str(key) for key in get_part(sample, "datum_keys", list)]
        # All images of a sample share its only point cloud, in whatever order they are listed.
        clouds = (get_part(entries.get(key), "point_cloud", dict) for key in keys)
        sweeps |= dict.fromkeys(keys, next(filter(None, clouds), None))
    return sweeps


def _read_sweep_points(
    path: Path, world_from_laser: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "n 3"]:
    """Read the points of a sweep in the world frame: the first three columns of `data`."""
    try:
        points = np.load(path)["data"][:, :3].astype(np.float64, casting="same_kind")
        return transform_points(points, world_from_laser)
    except Exception as error:  # damaged archives and arrays raise anything
        raise InputError(f"{quote_value(path)} is no point cloud of DGP; {DGP_ADVICE}.") from error


def _locate_calibrations(scene: Path, content: Any) -> dict[str, Path]:
    """Locate the calibration that the sample of each datum names, by the key of the datum.

    A sample that names none has that of the first one, and so has a datum of no sample, under
    `NO_SAMPLE`.
    """
    samples = get_part(content, "samples", list)
    keys = [get_text(sample, "calibration_key", quote_value(scene)) for sample in samples]
    first = _locate_calibration(scene, keys[0] if keys else None)
    files = {NO_SAMPLE: first}
    for sample, key in zip(samples, keys, strict=True):
        file = first if key is None else _locate_calibration(scene, key)
        files |= {str(datum): file for datum in get_part(sample, "datum_keys", list)}
    return files


def _locate_calibration(scene: Path, key: str | None) -> Path:
    """Locate the calibration of a key in its folder, or else a single one for the scene."""
    single = scene.with_name("calibration.json")
    keyed = single if key is None else scene.parent / "calibration" / f"{key}.json"
    file = next((path for path in (keyed, single) if os.path.isfile(path)), None)
    if file is None and key is None:
        raise InputError(
            f"{quote_value(scene)} does not name its calibration (`calibration_key` of its first "
            f"sample); {DGP_ADVICE}."
        )
    if file is None:
        raise InputError(
            f"The calibration of {quote_value(scene)} is missing; put it at {quote_value(keyed)}."
        )
    return file


def _read_calibration(file: Path) -> dict[str, Any]:
    """Read the entries of cameras by their names."""
    calibration = read_json(file, DGP_ADVICE)
    names = get_part(calibration, "names", list)
    entries = get_part(calibration, "intrinsics", list)
    # Entries of other sensors are zeros.
    return {
        str(name): entry
        for name, entry in zip(names, entries, strict=False)
        if isinstance(entry, dict) and entry.get("fx")
    }


def _parse_lens(entry: Any, title: str) -> Intrinsics:
    """Parse the intrinsics of a camera, without an image size, and OpenCV's distortion."""

    def get_coefficients(*keys: str) -> tuple[float, ...]:
        bounds = (-MAX_COEFFICIENT, MAX_COEFFICIENT)
        return tuple(get_optional_number(entry, key, title, *bounds) or 0.0 for key in keys)

    other = next((key for key in OTHER_LENSES if entry.get(key)), None)
    advice = PANORAMA_ADVICE if other == "equirectangular" else "undistort the images first"
    require(other is None, f"The lens of {title} has `{other}`, which is not read; {advice}.")
    p1, p2 = get_coefficients("p1", "p2")
    distortion = Distortion(
        radial=get_coefficients("k1", "k2", "k3"),
        tangential=(p1, p2),
        denominator=get_coefficients("k4", "k5", "k6"),
    )
    return replace(get_intrinsics(entry, title), distortion=distortion)


def list_scene_files(path: Path) -> list[Path]:
    """List the DGP scene file at `path`, or those in a folder."""
    files = sorted(path.glob("scene*.json")) if os.path.isdir(path) else [path]
    files = [file for file in files if file.suffix == ".json" and os.path.isfile(file)]
    return [file for file in files if b'"datum"' in read_head(file, MAX_SNIFFED)]
