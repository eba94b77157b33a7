"""What trainers leave beside a splat about its frame: their cameras, or the transform itself."""

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
"""What a nerfstudio run writes about the frame that it trains in."""
CAMERAS = "cameras"
"""How the names of lists of cameras begin. The rest may name the splat, as in `splat_small.ply`
and `cameras_small.json`."""
ITERATION = "iteration_"
"""Folders in which Inria's trainer keeps splats, two below that of its cameras.json."""
MAX_PAIRS = 200
"""Photographs by which two lists of cameras are compared."""


@dataclass(frozen=True)
class GivenSplat:
    """A user's splat, and where word of its frame may lie."""

    path: Path
    scene: Gaussians
    origin: Float[np.ndarray, "3"]
    """Where the coordinates of `scene` are counted from, in those of its file."""
    photographs: Path
    """The folder of the photographs, or a file in it."""

    def folders(self) -> list[Path]:
        """In which trainers leave files, the nearest to the splat first."""
        near = self.path.resolve().parent
        model = [near.parent.parent] if near.name.startswith(ITERATION) else []
        scene = self.photographs if self.photographs.is_dir() else self.photographs.parent
        return list(dict.fromkeys([near, *model, scene.resolve()]))


def frames_left(
    splat: GivenSplat, photographs: Photographs
) -> Iterator[tuple[Literal["cameras", "dataparser"], Matrix]]:
    """Transforms from the photographs' frame to the splat's that trainers' files tell.

    Both frames are told from their origins. What nerfstudio writes leads from the world of the
    reconstruction, out of which its transforms.json has been turned in one of two ways.

    Raises:
        InputError: where one of the files is damaged.
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
    """Whether its pose is one."""
    return pose_defect(frame.c2w) is None


def to_local(frame: Frame, origin: Float[np.ndarray, "3"]) -> Matrix:
    """The pose of a frame told from `origin`."""
    return frame_from_photographs(origin) @ frame.c2w


def camera_lists(splat: GivenSplat) -> list[Path]:
    """The lists of cameras whose name belongs to the splat's, the closest name first."""
    found = []
    for folder in splat.folders():
        files = sorted(folder.glob(f"{CAMERAS}*.json"), key=lambda file: (-len(file.stem), file))
        tails = [file.stem.removeprefix(CAMERAS) for file in files]
        found += [f for f, tail in zip(files, tails, strict=True) if splat.path.stem.endswith(tail)]
    return [file for file in found if holds_camera_list(file)]


def between_cameras(ours: Mapping[str, Matrix], theirs: Mapping[str, Matrix]) -> Matrix | None:
    """The similarity from the poses of `ours` to those of the same names in `theirs`.

    None where fewer than two have their name in common, or they do not stand apart.
    """
    pairs = in_common(list(ours), list(theirs))
    pairs = pairs[:: max(1, len(pairs) // MAX_PAIRS)]
    before, after = [ours[a] for a, _ in pairs], [theirs[b] for _, b in pairs]
    return similarity_between(before, after) if stand_apart(before) and stand_apart(after) else None


def in_common(ours: Sequence[str], theirs: Sequence[str]) -> list[tuple[str, str]]:
    """The names of both lists that are the same but for endings, and for folders.

    Folders count where the names in them repeat, as do those of the cameras of a rig.
    """
    for spelled in (without_ending, stem):
        a, b = once(ours, spelled), once(theirs, spelled)
        if len(a.keys() & b.keys()) >= 2:
            return [(a[name], b[name]) for name in a if name in b]
    return []


def once(names: Sequence[str], spelled: Callable[[str], str]) -> dict[str, str]:
    """The names by another spelling, without those that share theirs."""
    count = Counter(map(spelled, names))
    return {spelled(name): name for name in names if count[spelled(name)] == 1}


def without_ending(name: str) -> str:
    """`images/0001` of `images/0001.jpg`."""
    path = PurePosixPath(name)
    return str(path.with_name(path.stem)) if path.name else name


def stem(name: str) -> str:
    """`0001` of `images/0001.jpg`."""
    return PurePosixPath(name).stem
