"""Recordings of Record3D: a zip archive `NAME.r3d` of photographs, depth maps and a JSON file.

`metadata` has the size `w` and `h` of the photographs, `K` column by column, or fx, fy, cx and cy
of each of them, and `poses`: a quaternion with the real part last and the centre of the camera in
metres, camera-to-world in OpenGL axes of the stored photograph. `rgbd/N.depth` holds float32 metres
and `rgbd/N.conf` bytes, both compressed with LZFSE (`pip install 'gscompleter[phones]'`).
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from gscompleter.data.cameras import Intrinsics, compute_rotation
from gscompleter.data.frame import Frame
from gscompleter.data.json_fields import get_array, get_part, get_size
from gscompleter.data.limits import require
from gscompleter.data.phones.export import ADVICE, Reader, drop_unreliable, find_files
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.data.transforms import OPENCV_FROM_OPENGL
from gscompleter.errors import InputError, quote_value
from gscompleter.io.image import convert_to_depth
from gscompleter.io.reading import parse_json

NAME = "metadata"
ENDINGS = ("jpg", "depth", "conf")
LENSES = "perFrameIntrinsicCoeffs"
NOTE = (
    "The depth maps are left out, because pyliblzfse is not installed; run "
    "`pip install 'gscompleter[phones]'`."
)


def has_record3d(path: Path) -> bool:
    """Check whether `path` is a recording, or the folder of an unpacked one."""
    return path.suffix.lower() == ".r3d" or os.path.isdir(path / "rgbd")


def open_record3d(path: Path) -> Iterator[Photographs]:
    """Open a recording; frames are numbered by time."""
    metadata = find_files(path, NAME).get(NAME)
    if metadata is None:
        raise InputError(f"There is no `{NAME}` in {quote_value(path)}; {ADVICE}.")
    content = parse_json(metadata(), f"`{NAME}` of {path}", ADVICE)
    images, depths, confidences = (find_files(path, f"rgbd/*.{end}") for end in ENDINGS)
    notes = (NOTE,) if depths and find_spec("liblzfse") is None else ()
    frames = []
    for number, (c2w, intrinsics) in enumerate(_parse_cameras(content, str(path))):
        name = str(number)
        title, depth = f"frame {name} of {quote_value(path)}", None
        if name in depths and not notes:
            depth = partial(_read_depth, depths[name], confidences.get(name), intrinsics, title)
        frame = Frame(name, title, c2w, intrinsics, images.get(name), depth)
        frames.append(frame.with_rigid_pose())
    frames = [frame for frame in frames if frame.image is not None]
    require(frames, f"No photograph of {quote_value(path)} has a pose; {ADVICE}.")
    yield replace(build_photographs(path.resolve().stem, str(path), frames), notes=notes)


def _parse_cameras(
    content: Any, title: str
) -> Iterator[tuple[Float[np.ndarray, "4 4"], Intrinsics]]:
    size, count = get_size(content, title, "w", "h"), len(get_part(content, "poses", list))
    require(count, f"{title} has no poses; record it with the LiDAR.")
    poses = get_array(content, "poses", title, (count, 7))
    lenses = np.tile(get_array(content, "K", title, (9,))[[0, 4, 6, 7]], (count, 1))
    if get_part(content, LENSES, list):
        lenses = get_array(content, LENSES, title, (count, 4))
    for (x, y, z, w, *center), (fx, fy, cx, cy) in zip(poses, lenses.tolist(), strict=True):
        c2w = np.eye(4)
        c2w[:3, :3], c2w[:3, 3] = compute_rotation((w, x, y, z)), center
        yield c2w @ OPENCV_FROM_OPENGL, Intrinsics(size, (fx, fy), (cx, cy))


def _read_depth(
    depth: Reader, confidence: Reader | None, intrinsics: Intrinsics, title: str
) -> Float[np.ndarray, "h w"]:
    values = convert_to_depth(_unpack(depth(), "<f4", intrinsics, title), 1.0)
    if confidence is None:
        return values
    return drop_unreliable(values, _unpack(confidence(), "u1", intrinsics, title), title)


def _unpack(
    packed: bytes, kind: str, intrinsics: Intrinsics, title: str
) -> Shaped[np.ndarray, "h w"]:
    """Unpack a map with the aspect ratio of the photograph, and at most as many pixels."""
    from liblzfse import decompress

    width, height = intrinsics.size or (1, 1)
    try:
        if len(packed) > 8 * width * height:
            raise ValueError("it is larger than the photograph")
        values = np.frombuffer(decompress(packed), kind)
        return values.reshape(round(math.sqrt(len(values) * height / width)), -1)
    except Exception as error:  # damaged bytes raise anything
        raise InputError(
            f"The depth of {title} cannot be read ({quote_value(str(error))}); {ADVICE}."
        ) from error
