"""Photographs with a COLMAP model, in common folder layouts."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.data.colmap.model_files import read_cameras, read_images, read_points
from gscompleter.data.frame import Frame
from gscompleter.data.image_folders import FOLDERS, ORIGINALS, ImageFinder, find_path, keep_existing
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.data.points import read_point_cloud
from gscompleter.errors import InputError, quote_value
from gscompleter.io.image import has_orientation_tag

DISTORTED = "distorted"
"""Folder of the model with distortion, beside undistorted photographs (3DGS's scripts)."""
HOMES = ("sparse", "colmap/sparse", f"{DISTORTED}/sparse", "")
"""Folders that are models or hold numbered ones, in search order."""

ENDINGS = (".bin", ".txt")
"""Endings of the files of a model, the preferred one first."""


def has_colmap(path: Path) -> bool:
    """Check whether `path` is a scene with a COLMAP model, a model, or its images file."""
    return bool(_find_models(path))


def open_colmap(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a scene, model or images file; the folder names it.

    The model with most images is used. Frames are numbered by the sorted names of the photographs
    that exist.
    """
    yield _build_scene(path.parent if is_image_file(path) else path, *_select_largest(path))


def read_scene_cameras(path: Path) -> list[Frame]:
    """Read the cameras of a scene's largest model in its order, with existing photographs."""
    model, frames, _ = _select_largest(path)
    finder = _make_finder(_list_roots(path, model))
    return [finder.locate(frame) for frame in frames]


def _select_largest(path: Path) -> tuple[Path, list[Frame], tuple[str, ...]]:
    """Find the largest model of a scene: its folder, frames, and notes on others."""
    found = [(images.parent, read_image_file(images)) for images in _find_models(path)]
    if not found:
        raise InputError(
            f"There is no COLMAP model in {quote_value(path)}; a folder sparse/0 with its cameras "
            "and images, as .bin or .txt, is needed."
        )
    model, frames = max(found, key=lambda one: len(one[1]))
    if len(found) == 1:
        return model, frames, ()
    note = (
        f"{len(found)} models lie in {model.parent}: {model.name} with {len(frames)} images is "
        "used; the others are ignored."
    )
    return model, frames, (note,)


def is_image_file(path: Path) -> bool:
    """Check whether `path` is the images file of a COLMAP model."""
    name = path.name.casefold()
    return name in {f"images{ending}" for ending in ENDINGS} and os.path.isfile(path)


def _find_models(path: Path) -> list[Path]:
    """List the images files of a scene's models, all from the first matching home."""
    if is_image_file(path):
        return [path]
    if not os.path.isdir(path):
        return []
    homes = (find_path(path, home) for home in HOMES)
    found = (_list_home(home) for home in homes if home and os.path.isdir(home))
    return next((models for models in found if models), [])


def _list_home(home: Path) -> list[Path]:
    """List the images files of the models in a folder, which may be one itself."""
    numbered = sorted(name for name in os.listdir(home) if name.isdecimal())
    found = [_find_model_file(folder, "images") for folder in (home, *map(home.joinpath, numbered))]
    return [images for images in found if images and _find_model_file(images.parent, "cameras")]


def _find_model_file(folder: Path, name: str) -> Path | None:
    """Find a file of a model, preferring binary; None if there is none."""
    found = (find_path(folder, name + ending) for ending in ENDINGS)
    return next((path for path in found if path is not None and os.path.isfile(path)), None)


def read_image_file(path: Path) -> list[Frame]:
    """Read the cameras of an images.txt or images.bin in its order, without photographs.

    `rigs` and `frames` (COLMAP 3.12) beside it add nothing to the poses.
    """
    cameras_file = _find_model_file(path.parent, "cameras")
    if cameras_file is None:
        raise InputError(
            f"There is no cameras.txt or cameras.bin beside {quote_value(path)}, and it holds "
            "poses only; copy it there from the same model."
        )
    cameras = read_cameras(cameras_file)
    images = read_images(path)
    if not images:
        raise InputError(f"{quote_value(path)} lists no images; export the model again.")
    if len({image.name for image in images}) < len(images):
        raise InputError(f"{quote_value(path)} lists an image twice; export the model again.")
    lacking = {image.camera for image in images} - cameras.keys()
    if lacking:
        raise InputError(
            f"Images in {quote_value(path)} were taken by camera {min(lacking)}, which is not in "
            "the cameras file beside it; export the model again."
        )
    return [
        Frame(name, f"image {quote_value(name)} of {quote_value(path)}", c2w, cameras[camera], None)
        for name, camera, c2w in images
    ]


def _build_scene(
    scene: Path, model: Path, frames: Sequence[Frame], notes: tuple[str, ...]
) -> Photographs:
    roots = _list_roots(scene, model)
    finder = _make_finder(roots)
    there, missing = keep_existing([finder.locate(frame) for frame in frames], str(model))
    notes, first = notes + missing, there[0]
    if isinstance(first.image, Path) and has_orientation_tag(first.image):
        notes += (
            f"The EXIF rotation of the photographs, such as {quote_value(first.name)}, is ignored: "
            "they are used as they are stored, like in COLMAP.",
        )
    photographs = build_photographs(roots[-1].name, str(model), there)
    return replace(photographs, notes=notes, sparse=_make_point_reader(model))


def _make_finder(roots: Sequence[Path]) -> ImageFinder:
    # Beside a model with distortion, `images` may hold undistorted photographs.
    lens = any(root.name.casefold() == DISTORTED for root in roots)
    return ImageFinder(roots, (ORIGINALS, *FOLDERS) if lens else FOLDERS)


def _list_roots(scene: Path, model: Path) -> list[Path]:
    """List the folders from the model up to the scene; names decide if a model itself is given."""
    top, roots = Path(os.path.abspath(scene)), [Path(os.path.abspath(model))]
    parts = {part for home in HOMES if home for part in home.split("/")}
    while True:
        folder = roots[-1]
        home = folder.parent if folder.name.isdecimal() else folder
        if top not in folder.parents and home.name.casefold() not in parts:
            return roots
        roots.append(folder.parent)


def _make_point_reader(model: Path) -> partial[Float[np.ndarray, "n 3"]] | None:
    """Return a reader of the model's points; None if it has no file of points."""
    path = _find_model_file(model, "points3D")
    if path is not None:
        return partial(read_points, path)
    # The script of 3DGS writes them as PLY.
    cloud = find_path(model, "points3D.ply")
    return None if cloud is None else partial(read_point_cloud, cloud)
