"""Raw data of Polycam and all data of 3d Scanner App: a JSON file for each photograph.

Poses are ARKit's: camera-to-world in metres, x right, y up and z back in the stored photograph.
3d Scanner App stores more poses than photographs. Polycam's corrected photographs have no
distortion and their poses less drift; depth belongs to the others, which hardly differ.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.frame import Frame
from gscompleter.data.json_fields import get_array, get_intrinsics, get_number, get_size
from gscompleter.data.limits import MAX_COORDINATE, require
from gscompleter.data.phones.export import ADVICE, Reader, find_files, read_png_depth
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.data.transforms import OPENCV_FROM_OPENGL
from gscompleter.errors import quote_value
from gscompleter.io.reading import parse_json

HOME = "keyframes"
"""Folder in Polycam's raw data."""
CameraParser = Callable[[Any, str], tuple[Float[np.ndarray, "4 4"], Intrinsics]]
"""Function from the content of a JSON file and its title to camera-to-world and intrinsics."""


@dataclass(frozen=True)
class KeyframeFormat:
    """Patterns of the files of frames, in order of preference, and the parser of cameras."""

    patterns: tuple[tuple[str, str, str, str], ...]
    """Patterns of cameras, photographs, depth maps and confidences."""
    parse: CameraParser

    def find_frames(self, path: Path) -> list[dict[str, Reader]]:
        """Find the files of the first pattern with photographs; none if there are none."""
        path = _find_root(path)
        found = ([find_files(path, pattern) for pattern in group] for group in self.patterns)
        return next((files for files in found if files[0] and files[1]), [])

    def open(self, path: Path) -> Iterator[Photographs]:
        """Open an export: a folder or an archive; frames are numbered by their sorted names."""
        cameras, images, depths, confidences = self.find_frames(path)
        frames = []
        for name in sorted(cameras.keys() & images):
            title, depth = f"frame {name} of {quote_value(path)}", None
            c2w, intrinsics = self.parse(parse_json(cameras[name](), title, ADVICE), title)
            if name in depths:
                depth = partial(read_png_depth, depths[name], confidences.get(name), title)
            frame = Frame(name, title, c2w @ OPENCV_FROM_OPENGL, intrinsics, images[name], depth)
            frames.append(frame.with_rigid_pose())
        require(frames, f"No photograph of {quote_value(path)} has a camera; {ADVICE}.")
        yield build_photographs(_find_root(path.resolve()).stem, str(path), frames)


def _find_root(path: Path) -> Path:
    return path.parent if path.name == HOME else path


def parse_polycam(entry: Any, title: str) -> tuple[Float[np.ndarray, "4 4"], Intrinsics]:
    """Parse a camera of Polycam."""
    c2w, bound = np.eye(4), MAX_COORDINATE
    for row, column in np.ndindex(3, 4):
        c2w[row, column] = get_number(entry, f"t_{row}{column}", title, -bound, bound)
    return c2w, replace(get_intrinsics(entry, title), size=get_size(entry, title))


def parse_scanner_app(entry: Any, title: str) -> tuple[Float[np.ndarray, "4 4"], Intrinsics]:
    """Parse a camera of 3d Scanner App: lists of rows, with whole numbers at pixel centres."""
    fx, _, cx, _, fy, cy = get_array(entry, "intrinsics", title, (9,))[:6].tolist()
    c2w = get_array(entry, "cameraPoseARFrame", title, (16,)).reshape(4, 4)
    return c2w, Intrinsics(None, (fx, fy), (cx + 0.5, cy + 0.5))


DEPTH = (f"{HOME}/depth/*.png", f"{HOME}/confidence/*.png")
CORRECTED = (f"{HOME}/corrected_cameras/*.json", f"{HOME}/corrected_images/*.*", *DEPTH)
ORIGINAL = (f"{HOME}/cameras/*.json", f"{HOME}/images/*.*", *DEPTH)
POLYCAM = KeyframeFormat((CORRECTED, ORIGINAL), parse_polycam)
SCANNED = ("frame_*.json", "frame_*.jpg", "depth_*.png", "conf_*.png")
SCANNER_APP = KeyframeFormat((SCANNED,), parse_scanner_app)
