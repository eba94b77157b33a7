"""Files that trainers leave with a splat: their cameras, or the transform of the scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from jaxtyping import Float

from gscompleter.data.camera_list import holds_camera_list, read_camera_list
from gscompleter.data.dataparser import read_dataparser_transforms
from gscompleter.data.frame import Frame
from gscompleter.data.origin import frame_from_photographs
from gscompleter.data.photographs import Photographs
from gscompleter.data.poses import pose_defect
from gscompleter.frames.similarity import Matrix, similarity, similarity_between, stand_apart
from gscompleter.frames.trainers import WORLDS
from gscompleter.types import Gaussians

DATAPARSER = "dataparser_transforms.json"
"""File of a nerfstudio run with the transform that it applied to the scene."""
CAMERAS = "cameras"
"""Prefix of camera lists; the rest may match the splat: `cameras_2.json` for `splat_2.ply`."""
ITERATION = "iteration_"
"""Prefix of the folders of Inria's trainer, two levels below its cameras.json."""
MAX_PAIRS = 200
"""Photographs by which two camera lists are compared."""


@dataclass(frozen=True)
class GivenSplat:
    """An input splat, and the folders where its trainer may have left files."""

    path: Path
    scene: Gaussians
    origin: Float[np.ndarray, "3"]
    """Origin of the coordinates of `scene`, in the frame of its file."""
    photographs: Path
    """Folder of the photographs, or a file in it."""

    def folders(self) -> list[Path]:
        """List the folders where trainers leave files, the nearest to the splat first."""
        near = self.path.resolve().parent
        model = [near.parent.parent] if near.name.startswith(ITERATION) else []
        scene = self.photographs if self.photographs.is_dir() else self.photographs.parent
        return list(dict.fromkeys([near, *model, scene.resolve()]))


def frames_left(
    splat: GivenSplat, photographs: Photographs
) -> Iterator[tuple[Literal["cameras", "dataparser"], Matrix]]:
    """Yield transforms from the photographs' frame to the splat's, as found in trainers' files.

    Both frames are relative to their origins. The transform of nerfstudio starts from the world of
    the reconstruction, which one of the `WORLDS` turns into that of its transforms.json.
    """
    to_photographs = np.linalg.inv(frame_from_photographs(photographs.origin))
    to_splat = frame_from_photographs(splat.origin)
    ours = {f.name: to_local(f, photographs.origin) for f in photographs.frames if usable(f)}
    for file in camera_lists(splat):
        theirs = {f.name: to_local(f, splat.origin) for f in read_camera_list(file)}
        transform = between_cameras(ours, theirs)
        if transform is not None:
            yield "cameras", transform
    for folder in splat.folders():
        if (folder / DATAPARSER).is_file():
            transform = read_dataparser_transforms(folder / DATAPARSER)
            for world in WORLDS:
                original = similarity(1.0, world.T, np.zeros(3))
                yield "dataparser", to_splat @ transform @ original @ to_photographs


def usable(frame: Frame) -> bool:
    """Return True if the pose of a frame is valid."""
    return pose_defect(frame.c2w) is None


def to_local(frame: Frame, origin: Float[np.ndarray, "3"]) -> Matrix:
    """Compute the pose of a frame relative to `origin`."""
    return frame_from_photographs(origin) @ frame.c2w


def camera_lists(splat: GivenSplat) -> list[Path]:
    """Find the camera lists whose name matches the splat, the best match first."""
    found = []
    for folder in splat.folders():
        files = sorted(folder.glob(f"{CAMERAS}*.json"), key=lambda file: (-len(file.stem), file))
        tails = [file.stem.removeprefix(CAMERAS) for file in files]
        found += [f for f, tail in zip(files, tails, strict=True) if splat.path.stem.endswith(tail)]
    return [file for file in found if holds_camera_list(file)]


def between_cameras(ours: Mapping[str, Matrix], theirs: Mapping[str, Matrix]) -> Matrix | None:
    """Fit the similarity from the poses `ours` to those of the same names in `theirs`.

    Returns:
        None if fewer than two names match, or all cameras have one position.
    """
    pairs = in_common(list(ours), list(theirs))
    pairs = pairs[:: max(1, len(pairs) // MAX_PAIRS)]
    before, after = [ours[a] for a, _ in pairs], [theirs[b] for _, b in pairs]
    return similarity_between(before, after) if stand_apart(before) and stand_apart(after) else None


def in_common(ours: Sequence[str], theirs: Sequence[str]) -> list[tuple[str, str]]:
    """Match names that differ only in extension, or in folder if base names are unique."""
    for spelled in (without_ending, stem):
        a, b = once(ours, spelled), once(theirs, spelled)
        if len(a.keys() & b.keys()) >= 2:
            return [(a[name], b[name]) for name in a if name in b]
    return []


def once(names: Sequence[str], spelled: Callable[[str], str]) -> dict[str, str]:
    """Index names by their normalized form; ambiguous ones are dropped."""
    count = Counter(map(spelled, names))
    return {spelled(name): name for name in names if count[spelled(name)] == 1}


def without_ending(name: str) -> str:
    """Drop the extension: `images/0001` for `images/0001.jpg`."""
    path = PurePosixPath(name)
    return str(path.with_name(path.stem)) if path.name else name


def stem(name: str) -> str:
    """Get the base name: `0001` for `images/0001.jpg`."""
    return PurePosixPath(name).stem
