"""Files that trainers leave with a splat: their cameras, or the transform of the scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from jaxtyping import Float

from gscompleter.data.camera_files import has_camera_list, read_camera_list
from gscompleter.data.cameras import find_pose_defect
from gscompleter.data.frame import Frame
from gscompleter.data.local_origin import compute_frame_from_photographs, read_dataparser_transforms
from gscompleter.data.photographs import Photographs
from gscompleter.splat_alignment.similarity import (
    Matrix,
    fit_pose_similarity,
    has_baseline,
    make_similarity,
)
from gscompleter.splat_alignment.trainer_frames import NERFSTUDIO_WORLDS
from gscompleter.types import Gaussians

DATAPARSER_FILE = "dataparser_transforms.json"
"""File of a nerfstudio run with the transform that it applied to the scene."""
CAMERA_LIST_PREFIX = "cameras"
"""Prefix of camera lists; the rest may match the splat: `cameras_2.json` for `splat_2.ply`."""
ITERATION_PREFIX = "iteration_"
"""Prefix of the folders of Inria's trainer, two levels below its cameras.json."""
MAX_PAIRS = 200
"""Photographs by which two camera lists are compared."""


@dataclass(frozen=True)
class InputSplat:
    """An input splat, and the folders where its trainer may have left files."""

    path: Path
    scene: Gaussians
    origin: Float[np.ndarray, "3"]
    """Origin of the coordinates of `scene`, in the frame of its file."""
    photographs: Path
    """Folder of the photographs, or a file in it."""

    def list_folders(self) -> list[Path]:
        """List the folders where trainers leave files, the nearest to the splat first."""
        near = self.path.resolve().parent
        model = [near.parent.parent] if near.name.startswith(ITERATION_PREFIX) else []
        scene = self.photographs if self.photographs.is_dir() else self.photographs.parent
        return list(dict.fromkeys([near, *model, scene.resolve()]))


def read_trainer_frames(
    splat: InputSplat, photographs: Photographs
) -> Iterator[tuple[Literal["cameras", "dataparser"], Matrix]]:
    """Yield transforms from the photographs' frame to the splat's, as found in trainers' files.

    Both frames are relative to their origins. The transform of nerfstudio starts from the world of
    the reconstruction, which one of the `NERFSTUDIO_WORLDS` turns into that of its transforms.json.
    """
    to_photographs = np.linalg.inv(compute_frame_from_photographs(photographs.origin))
    to_splat = compute_frame_from_photographs(splat.origin)
    ours = {
        f.name: localize_pose(f, photographs.origin)
        for f in photographs.frames
        if has_valid_pose(f)
    }
    for file in find_camera_lists(splat):
        theirs = {f.name: localize_pose(f, splat.origin) for f in read_camera_list(file)}
        transform = fit_named_cameras(ours, theirs)
        if transform is not None:
            yield "cameras", transform
    for folder in splat.list_folders():
        if (folder / DATAPARSER_FILE).is_file():
            transform = read_dataparser_transforms(folder / DATAPARSER_FILE)
            for world in NERFSTUDIO_WORLDS:
                original = make_similarity(1.0, world.T, np.zeros(3))
                yield "dataparser", to_splat @ transform @ original @ to_photographs


def has_valid_pose(frame: Frame) -> bool:
    """Return True if the pose of a frame is valid."""
    return find_pose_defect(frame.c2w) is None


def localize_pose(frame: Frame, origin: Float[np.ndarray, "3"]) -> Matrix:
    """Compute the pose of a frame relative to `origin`."""
    return compute_frame_from_photographs(origin) @ frame.c2w


def find_camera_lists(splat: InputSplat) -> list[Path]:
    """Find the camera lists whose name matches the splat, the best match first."""
    found = []
    for folder in splat.list_folders():
        files = sorted(
            folder.glob(f"{CAMERA_LIST_PREFIX}*.json"), key=lambda file: (-len(file.stem), file)
        )
        tails = [file.stem.removeprefix(CAMERA_LIST_PREFIX) for file in files]
        found += [f for f, tail in zip(files, tails, strict=True) if splat.path.stem.endswith(tail)]
    return [file for file in found if has_camera_list(file)]


def fit_named_cameras(ours: Mapping[str, Matrix], theirs: Mapping[str, Matrix]) -> Matrix | None:
    """Fit the similarity from the poses `ours` to those of the same names in `theirs`.

    Returns:
        None if fewer than two names match, or all cameras have one position.
    """
    pairs = match_names(list(ours), list(theirs))
    pairs = pairs[:: max(1, len(pairs) // MAX_PAIRS)]
    before, after = [ours[a] for a, _ in pairs], [theirs[b] for _, b in pairs]
    return (
        fit_pose_similarity(before, after) if has_baseline(before) and has_baseline(after) else None
    )


def match_names(ours: Sequence[str], theirs: Sequence[str]) -> list[tuple[str, str]]:
    """Match names that differ only in extension, or in folder if base names are unique."""
    for spelled in (drop_extension, get_base_name):
        a, b = index_unique(ours, spelled), index_unique(theirs, spelled)
        if len(a.keys() & b.keys()) >= 2:
            return [(a[name], b[name]) for name in a if name in b]
    return []


def index_unique(names: Sequence[str], normalize: Callable[[str], str]) -> dict[str, str]:
    """Index names by their normalized form; ambiguous ones are dropped."""
    count = Counter(map(normalize, names))
    return {normalize(name): name for name in names if count[normalize(name)] == 1}


def drop_extension(name: str) -> str:
    """Drop the extension: `images/0001` for `images/0001.jpg`."""
    path = PurePosixPath(name)
    return str(path.with_name(path.stem)) if path.name else name


def get_base_name(name: str) -> str:
    """Get the base name: `0001` for `images/0001.jpg`."""
    return PurePosixPath(name).stem
