"""Clips in folders: nerfstudio and DL3DV scenes, RealEstate10K camera files, our own cases."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cases import Case, read_cases
from gscompleter.data.chunks import STAGES, open_chunks
from gscompleter.data.clips import (
    Clip,
    StoredCamera,
    cameras_to_skip,
    check_frame,
    size_to_skip,
    view_of,
)
from gscompleter.data.framing import check_resolution
from gscompleter.data.scene import load_cameras, load_views
from gscompleter.data.transforms import read_index
from gscompleter.errors import InputError
from gscompleter.io.image import image_size, read_pixels
from gscompleter.io.json_file import read_json
from gscompleter.types import View

ACCEPTED = (
    "a folder with a transforms.json or of such folders, a cases.json, chunks (a .torch file, a "
    "folder of them, or one with an index.json in it or in its folder test), or RealEstate10K "
    "camera files (.txt, with the frames of each in the folder of its name)"
)
"""What `open_clips` can open."""

_ENDINGS = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class SceneClip:
    """The frames of a `transforms.json`, in the order of their sorted `file_path`."""

    name: str
    path: Path
    """The folder of the scene, or the JSON file."""
    num_frames: int
    near: float | None = None
    far: float | None = None

    def __len__(self) -> int:
        return self.num_frames

    def views(self, frames: Sequence[int], resolution: tuple[int, int] | None = None) -> list[View]:
        """The photographs of `frames`, as `load_views` has them.

        Raises:
            InputError: as `load_views` does.
        """
        return load_views(self.path, list(frames), resolution, self.near, self.far)

    def reason_to_skip(self, size: tuple[int, int] | None = None) -> str | None:
        """Why benchmarks leave the clip out; None where they keep it.

        Args:
            size: Height and width that every photograph must have; any if left out.

        Raises:
            InputError: where the scene is no longer what it was.
        """
        if size is not None:
            for number, frame in enumerate(read_index(self.path).frames):
                reason = _photograph_to_skip(number, frame.photograph, size)
                if reason is not None:
                    return reason
        return cameras_to_skip([StoredCamera.of_camera(c) for c in load_cameras(self.path)])


@dataclass(frozen=True, eq=False)
class RealEstateClip:
    """The frames of a RealEstate10K camera file, in its order.

    The photograph of a frame is named for its timestamp and lies in a folder beside the file
    that has its name, or beside the file itself.
    """

    name: str
    path: Path
    """The camera file."""
    timestamps: tuple[str, ...]
    cameras: Float[np.ndarray, "n 18"]

    def __len__(self) -> int:
        return len(self.timestamps)

    def views(self, frames: Sequence[int], resolution: tuple[int, int] | None = None) -> list[View]:
        """The photographs of `frames`, resized to cover `resolution` (height, width), cropped.

        Raises:
            InputError: where a frame does not exist, has no photograph or a damaged one, or an
                impossible camera.
        """
        check_resolution(resolution)
        for number in frames:
            check_frame(number, len(self), str(self.path))
        return [self._view(number, resolution) for number in frames]

    def reason_to_skip(self, size: tuple[int, int] | None = None) -> str | None:
        """Why benchmarks leave the clip out; None where they keep it.

        Args:
            size: Height and width that every photograph must have; any if left out.
        """
        reason = cameras_to_skip([StoredCamera.of_numbers(row) for row in self.cameras])
        if reason is not None or size is None:
            return reason
        for number in range(len(self)):
            reason = _photograph_to_skip(number, self._photograph(number), size)
            if reason is not None:
                return reason
        return None

    def _view(self, number: int, resolution: tuple[int, int] | None) -> View:
        photograph = self._photograph(number)
        if photograph is None:
            folder = self.path.with_suffix("")
            raise InputError(
                f"The image of frame {number} of {self.path} is missing; put it at "
                f"{folder / self.timestamps[number]}.png or .jpg."
            )
        stored = StoredCamera.of_numbers(self.cameras[number])
        name = f"Frame {number} of {self.path}"
        return view_of(read_pixels(photograph), stored, number, name, resolution)

    def _photograph(self, number: int) -> Path | None:
        candidates = (
            folder / f"{self.timestamps[number]}{ending}"
            for folder in (self.path.with_suffix(""), self.path.parent)
            for ending in _ENDINGS
        )
        return next((candidate for candidate in candidates if os.path.isfile(candidate)), None)


def open_clips(path: Path | str) -> Iterator[Clip]:
    """The clips in a file or folder of any of the formats in `ACCEPTED`.

    What it is, is found out at once; the clips are read one at a time.

    Raises:
        InputError: where it is none of these, and while iterating, where a clip is damaged.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"There is no {path}; name {ACCEPTED}.")
    clips = _clips_of_folder(path) if path.is_dir() else _clips_of_file(path)
    if clips is None:
        raise InputError(f"There are no clips in {path}; name {ACCEPTED}.")
    return clips


def scene_clip(path: Path | str, near: float | None = None, far: float | None = None) -> SceneClip:
    """The clip of a `transforms.json`, called by the name of its folder.

    Args:
        path: A folder with a `transforms.json`, or the path of such a file.
        near: Smallest z-depth of the scene, in scene units, where known.
        far: Largest z-depth of the scene, in scene units, where known.

    Raises:
        InputError: where it is missing or impossible.
    """
    path = Path(path)
    whole = path.resolve()
    named = whole if whole.is_dir() else whole.parent
    name = named.name if whole.is_dir() or whole.name == "transforms.json" else whole.stem
    return SceneClip(name, path, len(read_index(path)), near, far)


def real_estate_clip(path: Path | str) -> RealEstateClip:
    """The clip of a RealEstate10K camera file, called by the name of the file.

    Its first line is the address of the video. Each of the others is a frame: timestamp, fx,
    fy, cx, cy in image widths and heights, two unused numbers, and the upper three rows of the
    world-to-camera transform.

    Raises:
        InputError: where it is missing or no such file.
    """
    path = Path(path)
    lines = [line for line in _read_text(path).splitlines()[1:] if line.strip()]
    if not lines:
        raise InputError(
            f"{path} lists no frames; below the line with the address, one line a frame is needed."
        )
    rows = [_numbers(line, number, path) for number, line in enumerate(lines)]
    timestamps = tuple(line.split()[0] for line in lines)
    return RealEstateClip(path.stem, path, timestamps, np.stack(rows))


def case_clips(cases: Sequence[Case]) -> Iterator[SceneClip]:
    """The scenes of cases, each once and in their order.

    The near and far planes of a scene enclose those of all its cases, where all have them.
    """
    scenes = list(dict.fromkeys(case.scene for case in cases))
    for scene in scenes:
        ours = [case for case in cases if case.scene == scene]
        near = [math.nan if case.near is None else case.near for case in ours]
        far = [math.nan if case.far is None else case.far for case in ours]
        yield scene_clip(scene, _known(float(np.min(near))), _known(float(np.max(far))))


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _clips_of_folder(folder: Path) -> Iterator[Clip] | None:
    """None where there is nothing that can be read."""
    if (folder / "cases.json").is_file():
        return case_clips(read_cases(folder / "cases.json"))
    if (folder / "transforms.json").is_file():
        return iter([scene_clip(folder)])
    for chunks in (folder, folder / STAGES[0]):
        if (chunks / "index.json").is_file() or any(chunks.glob("*.torch")):
            return iter(open_chunks(folder))
    scenes = sorted(child.parent for child in folder.glob("*/transforms.json"))
    if scenes:
        return (scene_clip(scene) for scene in scenes)
    files = sorted(file for file in folder.glob("*.txt") if _is_camera_file(file))
    return (real_estate_clip(file) for file in files) if files else None


def _clips_of_file(path: Path) -> Iterator[Clip] | None:
    """None where its ending or its content is of no format that can be read."""
    if path.suffix == ".torch":
        return iter(open_chunks(path))
    if path.suffix == ".txt":
        return iter([real_estate_clip(path)])
    if path.suffix != ".json":
        return None
    if path.name == "index.json":
        return iter(open_chunks(path.parent))
    content = _peek(path)
    if isinstance(content, dict) and "cases" in content:
        return case_clips(read_cases(path))
    if isinstance(content, dict) and "frames" in content:
        return iter([scene_clip(path)])
    return None


def _peek(path: Path) -> Any:
    return read_json(path, f"name {ACCEPTED}")


def _is_camera_file(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(4) == b"http"
    except OSError:
        return False


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}; correct the path.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text file; name {ACCEPTED}.") from error


def _numbers(line: str, number: int, path: Path) -> Float[np.ndarray, "18"]:
    """The 18 numbers of a frame, after its timestamp."""
    timestamp, *words = line.split()
    try:
        if not (timestamp.isascii() and timestamp.isdigit()):
            raise ValueError
        row = np.array([float(word) for word in words])
    except ValueError:
        row = np.zeros(0)
    if row.shape != (18,):
        raise InputError(
            f"Frame {number} of {path} is not a line of RealEstate10K, which has 19 numbers: "
            "timestamp, fx fy cx cy, 0 0, and 3 × 4 of world-to-camera; download it again."
        )
    return row


def _photograph_to_skip(number: int, path: Path | None, size: tuple[int, int]) -> str | None:
    if path is None:
        return f"frame {number}: its image is missing"
    return size_to_skip(number, image_size(path), size)
