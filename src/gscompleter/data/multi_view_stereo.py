"""Cameras of data sets for multi-view stereo and for surfaces.

* MVSNet, BlendedMVS and their successors have `cams/N_cam.txt`: after the word `extrinsic`
  world-to-camera, after `intrinsic` the matrix of the lens in pixels, then the smallest depth and
  what else a sweep needs. Photographs are `images/N.jpg` or `blended_images/N.jpg`, and
  `rendered_depth_maps/N.pfm` their z-depth.
* IDR, NeuS and what builds on them have `cameras_sphere.npz` or `cameras.npz`: `world_mat_I` is the
  projection of image I, in the order of the names in `image`. `scale_mat_I` normalises the scene
  for training, and is not applied. `mask/NAME.png` is white on the object.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from zipfile import ZipFile

import cv2
import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics, invert_viewmat
from gscompleter.data.file_names import FolderListings
from gscompleter.data.frame import Frame, find_file
from gscompleter.data.limits import MAX_NUMBER, require
from gscompleter.data.number_files import parse_numbers
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import list_entries, read_bytes, read_zip_entry
from gscompleter.types import MAX_IMAGE_SIDE

CAMS = "cams"
ENDING = "_cam.txt"
MVS_FOLDERS = ("images", "blended_images", "image")
RENDERED_DEPTH_FOLDER = "rendered_depth_maps"
IDR_FILES = ("cameras_sphere.npz", "cameras.npz")
IDR_FOLDERS = ("image", "images", "rgb")
MVS_ENDINGS = (".jpg", ".jpeg", ".png")
MVS_ADVICE = "fetch the scene again"
MAX_MATRICES = 1 << 26
"""Largest file of matrices, in bytes."""
MAX_MATRIX = 1 << 12
"""Largest matrix with its header, in bytes."""
MAX_LENS_SKEW = 1e-3
"""Largest skew of a lens relative to its focal length."""


def has_mvsnet(path: Path) -> bool:
    """Check whether a folder has cameras of MVSNet."""
    return (path / CAMS).is_dir() and bool(list_entries(path / CAMS, f"*{ENDING}"))


def open_mvsnet(path: Path) -> Iterator[Photographs]:
    """Open a scene of MVSNet; frames are numbered by the sorted names of its cameras."""
    listings = FolderListings()
    folders = [path / name for name in MVS_FOLDERS]
    frames = []
    for file in list_entries(path / CAMS, f"*{ENDING}"):
        stem = file.name.removesuffix(ENDING)
        image = find_file(folders, [f"{stem}{ending}" for ending in MVS_ENDINGS], listings)
        depth = find_file([path / RENDERED_DEPTH_FOLDER], [f"{stem}.pfm"], listings)
        c2w, lens = read_cam(file)
        name = stem if image is None else f"{image.parent.name}/{image.name}"
        frame = Frame(
            name,
            f"frame {quote_value(name)} of {quote_value(path)}",
            c2w,
            lens,
            image or path / MVS_FOLDERS[0] / f"{stem}{MVS_ENDINGS[0]}",
            None if depth is None else partial(read_pfm, depth),
        )
        frames.append(frame.with_rigid_pose())
    require(
        any(frame.has_photograph() for frame in frames),
        f"None of the photographs of {quote_value(path / CAMS)} is there; put them into "
        f"`{MVS_FOLDERS[0]}` under the numbers of the cameras.",
    )
    yield build_photographs(path.resolve().name, quote_value(path), frames)


def read_cam(path: Path) -> tuple[Float[np.ndarray, "4 4"], Intrinsics]:
    """Read camera-to-world and the lens of a camera of MVSNet."""
    title = quote_value(path)
    parts = re.split(rb"extrinsic|intrinsic", read_bytes(path, MAX_MATRICES))
    require(
        len(parts) == 3,
        f"{title} has no `extrinsic` before its `intrinsic`; {MVS_ADVICE}.",
    )
    viewmat = parse_numbers(parts[1], f"The `extrinsic` of {title}", (4, 4), MVS_ADVICE)
    # After the matrix of the lens come the depths of a sweep.
    lens = b" ".join(parts[2].split()[:9])
    matrix = parse_numbers(lens, f"The `intrinsic` of {title}", (3, 3), MVS_ADVICE)
    return invert_viewmat(viewmat), build_lens(matrix, title)


def build_lens(matrix: Float[np.ndarray, "3 3"], title: str) -> Intrinsics:
    """Build intrinsics of the photograph's size from the matrix of a lens."""
    (fx, skew, cx), (_, fy, cy), _ = matrix.tolist()
    is_lens = fx > 0 and fy > 0 and abs(skew) <= MAX_LENS_SKEW * fx and max(fx, fy) <= MAX_NUMBER
    require(is_lens, f"The lens of {title} has skew, or no focal length; {MVS_ADVICE}.")
    return Intrinsics(None, (fx, fy), (cx, cy))


def read_pfm(path: Path) -> Float[np.ndarray, "h w"]:
    """Read z-depth of a grey .pfm, whose rows begin at the bottom; 0 where unknown."""
    data = read_bytes(path)
    try:
        kind, width, height, scale, values = _split_pfm(data)
        if kind != b"Pf" or not (1 <= width <= MAX_IMAGE_SIDE and 1 <= height <= MAX_IMAGE_SIDE):
            raise ValueError("it is no grey map")
        # A negative scale stands for little endian.
        order = "<f4" if scale < 0 else ">f4"
        depth = np.frombuffer(values, order, width * height).reshape(height, width)[::-1]
    except ValueError as error:
        raise InputError(
            f"{quote_value(path)} is no depth map (.pfm of grey values), or ends too early; "
            f"{MVS_ADVICE}, or move it away."
        ) from error
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0.0).astype(np.float32)


def _split_pfm(data: bytes) -> tuple[bytes, int, int, float, bytes]:
    kind, width, height, scale, values = re.split(rb"\s", data, maxsplit=4)
    return kind, int(width), int(height), float(scale), values


def _find_matrices(path: Path) -> Path | None:
    """Find the file of cameras in a folder, or return the path if it is one by its name."""
    files = [path] if path.name in IDR_FILES else []
    files += [path / name for name in IDR_FILES]
    return next((file for file in files if os.path.isfile(file)), None)


def has_idr(path: Path) -> bool:
    """Check whether `path` is a folder with cameras of IDR or NeuS, or their file."""
    file = _find_matrices(path)
    return file is not None and any((file.parent / name).is_dir() for name in IDR_FOLDERS)


def open_idr(path: Path) -> Iterator[Photographs]:
    """Open a scene of IDR or NeuS; frames are numbered by the sorted names of its photographs."""
    file = _find_matrices(path)
    assert file is not None
    path = file.parent
    home = next(path / name for name in IDR_FOLDERS if (path / name).is_dir())
    images = [one for one in list_entries(home) if one.suffix.lower() in MVS_ENDINGS]
    matrices = read_matrices(file)
    count = sum(name.startswith("world_mat_") and name[10:].isdecimal() for name in matrices)
    require(
        len(images) == count and count > 0,
        f"{quote_value(file)} has {count:,} cameras, and {quote_value(home)} {len(images):,} "
        f"photographs, which belong to them in order of their names; {MVS_ADVICE}.",
    )
    listings = FolderListings()
    frames = []
    for number, image in enumerate(images):
        title = f"frame {quote_value(image.name)} of {quote_value(path)}"
        key = f"world_mat_{number}"
        matrix = matrices.get(key)
        require(
            matrix is not None and matrix.shape in ((4, 4), (3, 4)),
            f"The `{key}` of {quote_value(file)} is no matrix of 4 × 4 numbers; {MVS_ADVICE}.",
        )
        assert matrix is not None
        c2w, lens = decompose_projection(matrix[:3], title)
        names = [f"{image.stem}{ending}" for ending in MVS_ENDINGS]
        mask = find_file([path / "mask"], names, listings)
        frame = Frame(f"{home.name}/{image.name}", title, c2w, lens, image, mask=mask)
        frames.append(frame.with_rigid_pose())
    yield build_photographs(path.resolve().name, quote_value(path), frames)


def read_matrices(path: Path) -> dict[str, Float[np.ndarray, "n m"]]:
    """Read the matrices of a .npz; nothing else is read from it."""
    try:
        with ZipFile(io.BytesIO(read_bytes(path, MAX_MATRICES))) as archive:
            names = [name for name in archive.namelist() if name.startswith("world_mat_")]
            tables = {name: _load_matrix(archive, name) for name in names}
    except InputError:
        raise
    except Exception as error:  # damaged archives raise anything
        raise InputError(f"{quote_value(path)} is no archive of matrices; {MVS_ADVICE}.") from error
    return {name.removesuffix(".npy"): table for name, table in tables.items() if table.ndim == 2}


def _load_matrix(archive: ZipFile, name: str) -> Float[np.ndarray, "..."]:
    """Load an array of an archive, of no more bytes than a matrix has."""
    data = read_zip_entry(archive, name, MAX_MATRIX)
    return np.asarray(np.load(io.BytesIO(data), allow_pickle=False), dtype=np.float64)


def decompose_projection(
    projection: Float[np.ndarray, "3 4"], title: str
) -> tuple[Float[np.ndarray, "4 4"], Intrinsics]:
    """Decompose a projection to pixels into camera-to-world and the lens."""
    require(
        bool(np.isfinite(projection).all()) and abs(np.linalg.det(projection[:, :3])) > 0,
        f"The projection of {title} has no inverse; {MVS_ADVICE}.",
    )
    # A projection may have any factor; with a positive one, what is seen lies in front.
    signed = projection * np.sign(np.linalg.det(projection[:, :3]))
    matrix, rotation, center = cv2.decomposeProjectionMatrix(signed)[:3]
    c2w = np.eye(4)
    c2w[:3, :3] = rotation.T
    c2w[:3, 3] = (center[:3] / center[3]).ravel()
    return c2w, build_lens(matrix / matrix[2, 2], title)
