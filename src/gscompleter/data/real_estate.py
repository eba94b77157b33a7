"""RealEstate10K camera files, and the chunks of pixelSplat, MVSplat, DepthSplat and VolSplat.

A folder of chunks holds `000000.torch`, `000001.torch`, … and an `index.json` that maps the key of
each scene to its chunk. A chunk is a list of scenes: `key`, `cameras` [n, 18] and `images`, a list
of n tensors with the bytes of JPEG or PNG files. Only one chunk is in memory at a time, and an
image is decoded when its frame is read.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.data.cameras import FRACTIONS, Intrinsics, invert_viewmat
from gscompleter.data.frame import Frame, capitalize
from gscompleter.data.limits import require
from gscompleter.data.photograph import StoredPhotograph
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.system.errors import InputError, join_names, quote_value, refuse_pointer
from gscompleter.system.files.reading import (
    check_file,
    list_entries,
    open_file,
    read_head,
    read_json,
    read_lines,
)

INDEX = "index.json"


def open_camera_files(path: Path) -> Iterator[Photographs]:
    """Open the photographs of each camera file that `path` is or holds, sorted by name."""
    return (read_camera_file(file) for file in list_camera_files(path))


def read_camera_file(path: Path) -> Photographs:
    """Read a RealEstate10K camera file; the file names the scene.

    The first line is the address of the video. Each other line is a frame: timestamp, fx, fy, cx,
    cy in image widths and heights, two unused numbers, and the upper 3×4 of world-to-camera. The
    image is named after the timestamp and lies in a folder named after the file, or beside it.
    """
    lines = [line for line in read_lines(path) if line.strip()][1:]
    require(
        lines, f"{quote_value(path)} lists no frames; below the address, each frame needs a line."
    )
    frames = [_parse_line(line, number, path) for number, line in enumerate(lines)]
    return build_photographs(path.stem, quote_value(path), frames)


def parse_camera_row(
    numbers: Float[np.ndarray, "18"],
) -> tuple[Intrinsics, Float[np.ndarray, "4 4"]]:
    """Split a row into intrinsics and camera-to-world; an invalid transform stays as it is."""
    fx, fy, cx, cy = numbers[:4].tolist()
    viewmat = np.vstack([numbers[6:].reshape(3, 4), [0, 0, 0, 1]])
    # Intrinsics are fractions of the image, which may have any size.
    return Intrinsics(FRACTIONS, (fx, fy), (cx, cy)), invert_viewmat(viewmat)


def _parse_line(line: str, number: int, path: Path) -> Frame:
    timestamp, *words = line.split()
    try:
        if not (timestamp.isascii() and timestamp.isdigit() and len(words) == 18):
            raise ValueError
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(
            f"Frame {number} of {quote_value(path)} is not a line of RealEstate10K, which has 19 "
            "numbers: timestamp, fx fy cx cy, 0 0, and 3 × 4 of world-to-camera; download it "
            "again."
        ) from error
    own = path.with_suffix("")
    folder = own if os.path.isdir(own) else path.parent
    intrinsics, c2w = parse_camera_row(numbers)
    title = f"frame {number} of {quote_value(path)}"
    return Frame(timestamp, title, c2w, intrinsics, folder / timestamp)


def list_camera_files(path: Path) -> list[Path]:
    """List the RealEstate10K camera files in a folder, or the given one."""
    files = list_entries(path, "*.txt") if os.path.isdir(path) else [path]
    return [file for file in files if file.suffix == ".txt" and read_head(file, 4) == b"http"]


def has_chunks(path: Path) -> bool:
    """Check whether `path` is a chunk, an index of chunks, or a folder with either."""
    if os.path.isfile(path):
        return path.suffix == ".torch" or path.name == INDEX
    return bool(_list_folders(path))


def open_chunks(path: Path) -> Iterator[Photographs]:
    """Open the scenes of a data set, chunk by chunk.

    `path` is a folder of chunks, with or without an `index.json`, or a folder with such a folder
    `test`, an index, or one chunk. Damage inside a chunk raises an InputError while iterating.
    """
    if path.suffix == ".torch":
        return _open_chunk(path)
    folder = path.parent if path.name == INDEX else _list_folders(path)[0]
    listed = _read_index(folder / INDEX) if os.path.isfile(folder / INDEX) else {}
    # Without an index, all chunks of the folder are opened.
    files = sorted(set(listed.values())) or [file.name for file in list_entries(folder, "*.torch")]
    keys = {file: {key for key, chunk in listed.items() if chunk == file} for file in files}
    return (scene for file in files for scene in _open_chunk(folder / file, keys[file]))


def _list_folders(path: Path) -> list[Path]:
    folders = (path, path / "test")
    return [f for f in folders if os.path.isfile(f / INDEX) or list_entries(f, "*.torch")]


def _read_index(index: Path) -> dict[str, str]:
    """Read the file name of each scene's chunk by the key of the scene."""
    content = read_json(index, "download it again")
    chunks = list(content.values()) if isinstance(content, dict) else []
    require(
        chunks and all(isinstance(chunk, str) for chunk in chunks),
        f"{quote_value(index)} is no index of chunks: it has to map the key of each scene to the "
        "name of its .torch file.",
    )
    return dict(content)


def _open_chunk(path: Path, keys: Collection[str] = ()) -> Iterator[Photographs]:
    """Open the scenes of a chunk, which has to hold those of `keys`."""
    scenes = [_parse_scene(example, path, n) for n, example in enumerate(_load_chunk(path))]
    missing = sorted(set(keys) - {scene.name for scene in scenes})
    require(
        not missing,
        f"{INDEX} lists {join_names(missing, 3)} in {quote_value(path)}, which lacks it; download "
        "it again.",
    )
    yield from scenes


def _load_chunk(path: Path) -> list[Any]:
    check_file(path)
    return _read_chunk(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _read_chunk(path: Path, _written: int) -> list[Any]:
    """Read a chunk; the last one stays cached, because frames are read one after the other."""
    refuse_pointer(path)
    with open_file(path) as file, warnings.catch_warnings():
        # Torch warns about pickle protocols just before the file is refused.
        warnings.simplefilter("ignore")
        try:
            # Nothing is unpickled but tensors and plain values.
            content = torch.load(file, map_location="cpu", weights_only=True)
        except Exception as error:  # damaged bytes raise anything
            defect = "is truncated, no file of torch.save, or too large; download it again"
            if "GLOBAL" in str(error):
                defect = "holds pickled Python objects, which are refused: they can run any code"
            raise InputError(f"{quote_value(path)} {defect}.") from error
    require(
        isinstance(content, list) and content,
        f"{quote_value(path)} is no chunk: a list of scenes is needed, and it holds "
        f"{type(content).__name__}.",
    )
    return content


def _parse_scene(example: Any, path: Path, position: int) -> Photographs:
    """Check a scene without decoding its images."""
    entries = example if isinstance(example, dict) else {}
    name = entries.get("key")
    cameras = entries.get("cameras")
    images = entries.get("images")
    if not isinstance(name, str) or not name:
        raise InputError(
            f"Scene {position} of {quote_value(path)} has no `key`; write the chunk again with it."
        )
    called = f"scene {quote_value(name)} of {quote_value(path)}"
    if not (_is_dense(cameras, ndim=2) and cameras.is_floating_point() and cameras.shape[1] == 18):
        raise InputError(f"The `cameras` of the {called} are no floats of shape [n, 18].")

    files = images if isinstance(images, list) else []
    require(
        len(files) == len(cameras) > 0
        and all(_is_dense(file, ndim=1) and file.dtype == torch.uint8 for file in files),
        f"The `images` of the {called} are no list of uint8 tensors, the bytes of a JPEG or PNG "
        f"file for each of {len(cameras)} cameras.",
    )
    frames = []
    for number, row in enumerate(cameras.detach().double().numpy()):
        intrinsics, c2w = parse_camera_row(row)
        image = partial(_read_image_bytes, path, position, number)
        title = f"frame {number} of the {called}"
        stored = StoredPhotograph(image, capitalize(title))
        frames.append(Frame(str(number), title, c2w, intrinsics, stored))
    return build_photographs(name, f"the {called}", frames)


def _read_image_bytes(path: Path, position: int, number: int) -> bytes:
    """Copy the bytes of one image, so that the chunk can leave memory."""
    data: bytes = _load_chunk(path)[position]["images"][number].detach().numpy().tobytes()
    return data


def _is_dense(value: Any, ndim: int) -> TypeGuard[Tensor]:
    """Check whether a value is a tensor of `ndim` dimensions with storage for every entry."""
    if not isinstance(value, Tensor) or value.is_nested or value.ndim != ndim:
        return False
    if value.layout != torch.strided or value.is_meta or value.is_quantized:
        return False
    # A tensor of a damaged file may claim more entries than it stores.
    return value.untyped_storage().nbytes() >= value.numel() * value.element_size()
