"""Exports of Polycam, 3d Scanner App and Record3D.

* Polycam's raw data and all data of 3d Scanner App have a JSON file for each photograph. Polycam's
  corrected photographs have no distortion and their poses less drift. Depth was recorded with the
  original ones, and serves both, as in nerfstudio: there is no other.
* A recording of Record3D is a zip archive. Its `metadata` has the size `w` and `h` of photographs,
  `K` column by column or fx, fy, cx and cy of each, and `poses`: a quaternion with the real part
  last, and the centre. `rgbd/N.depth` and `rgbd/N.conf` are compressed with LZFSE.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from jaxtyping import Shaped

from gscompleter.data.cameras import Intrinsics, compute_rotation
from gscompleter.data.frame import capitalize
from gscompleter.data.json_fields import get_array, get_intrinsics, get_number, get_part, get_size
from gscompleter.data.limits import require
from gscompleter.data.phones.export import (
    PHONE_EXPORT_ADVICE,
    Files,
    PoseAndLens,
    build_recording,
    find_files,
    find_matches,
)
from gscompleter.data.phones.lzfse import measure_unpacked
from gscompleter.data.photographs import Photographs
from gscompleter.system.damage import DamagedError, describe_damage
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import parse_json
from gscompleter.types import MAX_COORDINATE

HOME = "keyframes"
"""Folder of all frames in an export of Polycam."""
RECORDED = "rgbd/*.jpg"
"""Pattern of the photographs in a recording of Record3D."""
METADATA = "metadata"
"""File of the cameras in a recording of Record3D."""
LENSES = "perFrameIntrinsicCoeffs"
"""Entry of that file with fx, fy, cx and cy of each photograph."""
UNREAD_DEPTH_NOTE = "Depth is left out; `pip install 'gscompleter[phones]'` makes it readable."


@dataclass(frozen=True)
class KeyframeFormat:
    """Names of the files of frames, and how their cameras are read."""

    mark: bytes
    """Part of each camera's JSON file."""
    parse: Callable[[Any, str], PoseAndLens]
    """Function from the content of such a file, and its title, to the camera."""
    patterns: tuple[tuple[str, str, str, str], ...]
    """Patterns of cameras, photographs, depth maps and confidences, in order of preference."""

    def find_frames(self, path: Path) -> list[Files]:
        """Find the files of the first patterns that have photographs and cameras; or none.

        Raises InputError for several recordings of this app.
        """
        root = path.parent if path.name == HOME else path
        for group in self.patterns:
            cameras, photographs = (find_matches(root, pattern) for pattern in group[:2])
            if not photographs or not cameras:
                continue
            # Other exports have JSON files of these names, too.
            read_first_camera = next(iter(cameras.values()))
            if self.mark in read_first_camera():
                return [find_files(root, pattern) for pattern in group]
        return []

    def open(self, path: Path) -> Iterator[Photographs]:
        """Open a folder or an archive; frames are numbered by their sorted names."""
        cameras, photographs, *maps = self.find_frames(path)
        parsed = {}
        for name in sorted(cameras.keys() & photographs.keys()):
            title = f"frame {quote_value(name)} of {quote_value(path)}"
            content = parse_json(cameras[name](), title, PHONE_EXPORT_ADVICE)
            parsed[name] = self.parse(content, title)
        yield build_recording(path, parsed, [photographs, *maps])


def parse_polycam(entry: Any, title: str) -> PoseAndLens:
    """Parse a camera of Polycam."""
    c2w = np.eye(4)
    bound = MAX_COORDINATE
    for row, column in np.ndindex(3, 4):
        c2w[row, column] = get_number(entry, f"t_{row}{column}", title, -bound, bound)
    return c2w, replace(get_intrinsics(entry, title), size=get_size(entry, title))


def parse_scanner_app(entry: Any, title: str) -> PoseAndLens:
    """Parse a camera of 3d Scanner App: lists of rows, with whole numbers at pixel centres."""
    fx, _, cx, _, fy, cy = get_array(entry, "intrinsics", title, (9,))[:6].tolist()
    c2w = get_array(entry, "cameraPoseARFrame", title, (16,)).reshape(4, 4)
    return c2w, Intrinsics(None, (fx, fy), (cx + 0.5, cy + 0.5))


DEPTH_GLOBS = (f"{HOME}/depth/*.png", f"{HOME}/confidence/*.png")
CORRECTED = (f"{HOME}/corrected_cameras/*.json", f"{HOME}/corrected_images/*.*", *DEPTH_GLOBS)
ORIGINAL = (f"{HOME}/cameras/*.json", f"{HOME}/images/*.*", *DEPTH_GLOBS)
"""Patterns of Polycam's files; those of depth serve both kinds of photographs."""
POLYCAM = KeyframeFormat(b'"t_00"', parse_polycam, (CORRECTED, ORIGINAL))
SCANNED = ("frame_*.json", "frame_*.jpg", "depth_*.png", "conf_*.png")
"""Patterns of the files of 3d Scanner App."""
SCANNER_APP = KeyframeFormat(b'"cameraPoseARFrame"', parse_scanner_app, (SCANNED,))


def find_recordings(path: Path) -> Collection[PurePath]:
    """Find the photographs of recordings of Record3D, packed or not; none if there are none."""
    return find_matches(path, RECORDED).keys()


def open_recording(path: Path) -> Iterator[Photographs]:
    """Open a recording of Record3D; frames are numbered by time."""
    title = quote_value(path)
    metadata = find_files(path, METADATA)
    require(metadata, f"There is no `{METADATA}` in {title}; {PHONE_EXPORT_ADVICE}.")
    content = parse_json(metadata[METADATA](), f"`{METADATA}` of {title}", PHONE_EXPORT_ADVICE)
    size = get_size(content, title, "w", "h")
    depths = find_files(path, "rgbd/*.depth")
    confidences = find_files(path, "rgbd/*.conf")
    is_unread = bool(depths) and find_spec("liblzfse") is None
    files = [find_files(path, RECORDED), {} if is_unread else depths, confidences]
    unpack_depth = partial(_unpack_map, "<f4", size)
    unpack_confidence = partial(_unpack_map, "u1", size)
    cameras = _parse_recorded(content, size, title)
    scene = build_recording(path, cameras, files, (unpack_depth, unpack_confidence))
    yield replace(scene, notes=(*scene.notes, UNREAD_DEPTH_NOTE)) if is_unread else scene


def _parse_recorded(content: Any, size: tuple[int, int], title: str) -> dict[str, PoseAndLens]:
    """Parse the cameras of a recording, by the names of its frames: their numbers from 0."""
    count = len(get_part(content, "poses", list))
    require(count, f"{title} has no poses; record with the LiDAR.")
    poses = get_array(content, "poses", title, (count, 7))
    if get_part(content, LENSES, list):
        lenses = get_array(content, LENSES, title, (count, 4))
    else:
        # fx, fy, cx and cy of a matrix that is stored column by column.
        common = get_array(content, "K", title, (9,))[[0, 4, 6, 7]]
        lenses = np.tile(common, (count, 1))
    cameras: dict[str, PoseAndLens] = {}
    for number, (pose, lens) in enumerate(zip(poses, lenses.tolist(), strict=True)):
        x, y, z, w, *center = pose
        fx, fy, cx, cy = lens
        c2w = np.eye(4)
        c2w[:3, :3] = compute_rotation((w, x, y, z))
        c2w[:3, 3] = center
        cameras[str(number)] = c2w, Intrinsics(size, (fx, fy), (cx, cy))
    return cameras


def _unpack_map(
    kind: str, size: tuple[int, int], data: bytes, title: str
) -> Shaped[np.ndarray, "h w"]:
    """Unpack a map with the aspect ratio of the photographs of `size`, width and height.

    `kind` is the type of its numbers. Raises InputError for damaged data, or too many.
    """
    from liblzfse import decompress

    try:
        # A map has a fraction of the pixels, of four bytes or one. Twice four for each pixel is
        # more than any has, and is checked before anything is unpacked.
        limit = 8 * math.prod(size)
        if len(data) > limit or measure_unpacked(data) > limit:
            raise DamagedError("it is larger than the photograph")
        # The map has no header: its height follows from the number of values and the aspect ratio.
        values = np.frombuffer(decompress(data), kind)
        return values.reshape(round(math.sqrt(len(values) * size[1] / size[0])), -1)
    except Exception as error:  # damaged bytes raise anything
        raise InputError(
            f"{capitalize(title)} cannot be read ({describe_damage(error)}); {PHONE_EXPORT_ADVICE}."
        ) from error
