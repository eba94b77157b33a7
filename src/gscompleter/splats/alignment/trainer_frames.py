"""Frames that splat trainers leave behind or normalise a scene to.

Trainers store their cameras or the transform of the scene beside a splat. Without these files the
known normalisations are computed from poses (OpenCV axes) and points.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from gscompleter.data.camera_files import has_camera_list, read_camera_list
from gscompleter.data.cameras import Poses, find_pose_defect
from gscompleter.data.file_names import list_homes_of
from gscompleter.data.local_origin import compute_frame_from_photographs
from gscompleter.data.photographs import Photographs
from gscompleter.data.transforms import DATAPARSER_FILE, read_dataparser_transforms
from gscompleter.splats.alignment.similarity import (
    Matrix,
    fit_pose_similarity,
    has_baseline,
    make_similarity,
    transform_pose,
)
from gscompleter.system.files.result_names import COMPLETED_FILES, CONTEXT_FILE
from gscompleter.types import Gaussians

CAMERA_LIST_PREFIX = "cameras"
"""Prefix of camera lists; the rest may match the splat: `cameras_2.json` for `splat_2.ply`."""
TRAINER_FOLDER = "trainer"
"""Folder beside a result with copies of what lay beside the splat that it was made of."""
ITERATION_PREFIX = "iteration_"
"""Prefix of the folders of Inria's trainer, two levels below its cameras.json."""
MAX_COMPARED_PHOTOGRAPHS = 200
"""Photographs by which two camera lists are compared."""

Points = Float[np.ndarray, "p 3"]

NERFSTUDIO_WORLDS = (
    np.eye(3),
    np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]),
)
"""Rotations from COLMAP's world that nerfstudio applies first: none, today's, the former."""


@dataclass(frozen=True)
class InputSplat:
    """An input splat, and the folders where its trainer may have left files."""

    path: Path
    scene: Gaussians
    origin: Float[np.ndarray, "3"]
    """Origin of `scene`, in the frame of its file."""
    photographs: Path
    """Folder of the photographs, or a file in it."""


def list_trainer_folders(splat: Path, photographs: Path) -> list[Path]:
    """List the folders where trainers leave files, the nearest to the splat first."""
    scene = photographs if photographs.is_dir() else photographs.parent
    return list(dict.fromkeys([*list_model_folders(splat), scene.resolve()]))


def list_model_folders(splat: Path) -> list[Path]:
    """List the folders of the model that a splat belongs to, the nearest to the splat first."""
    near = list_homes_of(splat)
    model = [home.parent.parent for home in near if home.name.startswith(ITERATION_PREFIX)]
    # What `convert` writes there may be moved, and is in another frame.
    is_result = splat.name in (*COMPLETED_FILES, CONTEXT_FILE)
    kept = [home / TRAINER_FOLDER for home in near if is_result]
    return [*near, *model, *kept]


def read_trainer_frames(
    splat: InputSplat, photographs: Photographs
) -> Iterator[tuple[Literal["cameras", "dataparser"], Matrix]]:
    """Yield transforms from the photographs' frame to the splat's, as found in trainers' files.

    Both frames are relative to their origins. The transform of nerfstudio starts from the world of
    the reconstruction, which one of the `NERFSTUDIO_WORLDS` turns into that of its transforms.json.
    """
    to_photographs = np.linalg.inv(compute_frame_from_photographs(photographs.origin))
    to_splat = compute_frame_from_photographs(splat.origin)
    ours = dict(collect_poses(photographs))
    folders = list_trainer_folders(splat.path, splat.photographs)
    for file in find_camera_lists(splat.path, folders):
        theirs = {frame.name: to_splat @ frame.c2w for frame in read_camera_list(file)}
        transform = fit_named_cameras(ours, theirs)
        if transform is not None:
            yield "cameras", transform
    for folder in folders:
        if (folder / DATAPARSER_FILE).is_file():
            transform = read_dataparser_transforms(folder / DATAPARSER_FILE)
            # Right to left: local photographs, their world, COLMAP's world, nerfstudio's, local
            # splat.
            for world in NERFSTUDIO_WORLDS:
                original = make_similarity(1.0, world.T, np.zeros(3))
                yield "dataparser", to_splat @ transform @ original @ to_photographs


def collect_poses(photographs: Photographs) -> list[tuple[str, Matrix]]:
    """Collect names and valid poses of the photographs, relative to their origin."""
    localize = compute_frame_from_photographs(photographs.origin)
    return [
        (frame.name, localize @ frame.c2w)
        for frame in photographs.frames
        if find_pose_defect(frame.c2w) is None
    ]


def find_camera_lists(splat: Path, folders: Sequence[Path]) -> list[Path]:
    """Find the camera lists in folders whose name matches the splat, the best match first.

    Those of the first folder come before those of the next one.
    """
    pattern = f"{CAMERA_LIST_PREFIX}*.json"
    return [
        file
        for folder in folders
        for file in sorted(folder.glob(pattern), key=lambda file: (-len(file.stem), file))
        if splat.stem.endswith(file.stem.removeprefix(CAMERA_LIST_PREFIX)) and has_camera_list(file)
    ]


def find_cameras_beside(splat: Path) -> Path | None:
    """Find the list of cameras beside a splat, or in the folder of its trainer; None without one.

    Of several it is the one whose name matches the splat, as `find_camera_lists` tells.
    """
    return next(iter(find_camera_lists(splat, list_model_folders(splat))), None)


def fit_named_cameras(ours: Mapping[str, Matrix], theirs: Mapping[str, Matrix]) -> Matrix | None:
    """Fit the similarity from `ours` to `theirs` by name; None without two matched positions."""
    pairs = match_names(list(ours), list(theirs))
    pairs = pairs[:: max(1, len(pairs) // MAX_COMPARED_PHOTOGRAPHS)]
    before = [ours[a] for a, _ in pairs]
    after = [theirs[b] for _, b in pairs]
    if not has_baseline(before) or not has_baseline(after):
        return None
    return fit_pose_similarity(before, after)


def match_names(ours: Sequence[str], theirs: Sequence[str]) -> list[tuple[str, str]]:
    """Match names that differ only in extension, or in folder if base names are unique."""
    for with_folder in (True, False):
        our_names = index_unique(ours, with_folder)
        their_names = index_unique(theirs, with_folder)
        if len(our_names.keys() & their_names.keys()) >= 2:
            return [(our_names[key], their_names[key]) for key in our_names if key in their_names]
    return []


def index_unique(names: Sequence[str], with_folder: bool) -> dict[str, str]:
    """Index names without extension and, if wanted, folder; ambiguous ones are dropped."""
    places = [name if with_folder else os.path.basename(name) for name in names]
    keys = [os.path.splitext(place)[0] for place in places]
    count = Counter(keys)
    return {key: name for key, name in zip(keys, names, strict=True) if count[key] == 1}


def compute_trainer_frames(poses: Poses, points: Points | None = None) -> Iterator[Matrix]:
    """Yield the transforms of known normalisations; trainers started from the sparse `points`."""
    yield normalize_opensplat(poses)
    for world in NERFSTUDIO_WORLDS:
        yield normalize_nerfstudio(poses, world)
    yield normalize_gsplat_cameras(poses)
    if points is not None and len(points) > 3:
        yield from align_gsplat_axes(normalize_gsplat_cameras(poses), points)


def normalize_opensplat(poses: Poses) -> Matrix:
    """Centre on the mean camera and scale the largest camera coordinate to 1."""
    centers = poses[:, :3, 3]
    offsets = centers - centers.mean(axis=0)
    scale = 1 / max(np.abs(offsets).max(), 1e-12)
    return make_similarity(scale, np.eye(3), -scale * centers.mean(axis=0))


def normalize_nerfstudio(poses: Poses, world: Float[np.ndarray, "3 3"]) -> Matrix:
    """Rotate the mean up direction to z after the rotation `world`, then scale like OpenSplat."""
    up = -(poses[:, :3, 1] @ world.T).mean(axis=0)
    turn = align_directions(up, np.array([0.0, 0.0, 1.0])) @ world
    upright = make_similarity(1.0, turn, np.zeros(3))
    turned = np.stack([transform_pose(pose, upright) for pose in poses])
    return normalize_opensplat(turned) @ upright


def normalize_gsplat_cameras(poses: Poses) -> Matrix:
    """Compute the camera half of gsplat's normalisation.

    Up becomes -y, the point that the cameras face the origin, and their median distance from it 1.
    """
    turn = align_directions(-poses[:, :3, 1].mean(axis=0), np.array([0.0, -1.0, 0.0]))
    centers = poses[:, :3, 3] @ turn.T
    forward = poses[:, :3, 2] @ turn.T
    # The point of each viewing ray that is nearest to the origin; the cameras face their median.
    nearest = centers - (forward * centers).sum(axis=1, keepdims=True) * forward
    shift = -np.median(nearest, axis=0)
    scale = 1 / max(float(np.median(np.linalg.norm(centers + shift, axis=1))), 1e-12)
    return make_similarity(scale, turn, scale * shift)


def align_gsplat_axes(cameras: Matrix, points: Points) -> Iterator[Matrix]:
    """Yield the point half: principal axes become x, y and z, the largest first.

    Signs depend on the library and its version: all four right-handed choices are yielded.
    """
    moved = points @ cameras[:3, :3].T + cameras[:3, 3]
    center = np.median(moved, axis=0)
    _, vectors = np.linalg.eigh(np.cov(moved - center, rowvar=False))
    axes = vectors[:, ::-1].T
    # Eigenvalues ascend. A mirrored set of axes is negated, which makes it a rotation.
    axes = axes * np.sign(np.linalg.det(axes))
    for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
        turn = np.diag(np.array(signs, dtype=np.float64)) @ axes
        yield make_similarity(1.0, turn, -turn @ center) @ cameras


def align_directions(
    start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Compute the smallest rotation from one direction to a unit vector."""
    start = start / max(float(np.linalg.norm(start)), 1e-12)
    x, y, z = np.cross(start, end)
    cosine = float(start @ end)
    # Opposite directions have no unique rotation: half a turn about y, or about z for those near y.
    if cosine < -1 + 1e-8:
        return np.diag([-1.0, 1.0, -1.0]) if abs(end[1]) < 0.5 else np.diag([-1.0, -1.0, 1.0])
    # Rodrigues' formula with sine |start x end|: I + [v] + [v]² / (1 + cos).
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + skew + skew @ skew / (1 + cosine)
