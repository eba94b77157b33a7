"""Data sets in the chunk format of pixelSplat, which MVSplat, DepthSplat and VolSplat share.

A folder holds `000000.torch`, `000001.torch`, … and an `index.json` that maps the key of each
scene to its chunk. A chunk is a list of scenes: `key`, `cameras` [n, 18] and `images`, a list of
n tensors with the bytes of JPEG or PNG files. One chunk is in memory at a time, however many clips
are held, and an image is decoded only when its frame is asked for.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeGuard

import torch
from torch import Tensor

from gscompleter.data.frame import Frame
from gscompleter.data.photographs import Photographs, photographs_of
from gscompleter.data.real_estate import intrinsics_and_pose
from gscompleter.errors import InputError, quoted, refuse_pointer
from gscompleter.io.json_file import read_json
from gscompleter.reading import check_file

TEST = "test"
"""The half of a data set that is evaluated on, in a folder of its own."""
INDEX = "index.json"


def holds_chunks(path: Path) -> bool:
    """Whether `path` is a chunk or an index of them, or a folder that has some."""
    if os.path.isfile(path):
        return path.suffix == ".torch" or path.name == INDEX
    return _folder_of(path) is not None


def open_chunks(path: Path) -> Iterator[Photographs]:
    """The scenes of a data set, chunk by chunk.

    Args:
        path: A folder with an `index.json` and chunks, a folder with such a folder `test`, a
            folder of chunks without index, an index, or one chunk.

    Raises:
        InputError: where there are no chunks, or the index is damaged; while iterating, where a
            chunk is missing, damaged, holds pickled objects, or disagrees with the index.
    """
    if path.suffix == ".torch":
        return _scenes_of(path)
    folder = path.parent if path.name == INDEX else _folder_of(path)
    if folder is None:
        raise InputError(
            f"There are no chunks in {path}; name a folder with an {INDEX} or .torch files, a "
            f"folder with such a folder {TEST}, or a single .torch file."
        )
    if os.path.isfile(folder / INDEX):
        return _indexed(folder / INDEX)
    return (scene for chunk in sorted(folder.glob("*.torch")) for scene in _scenes_of(chunk))


def _folder_of(path: Path) -> Path | None:
    """The folder with the chunks: `path`, or the half of the data set in it."""
    folders = (path, path / TEST)
    return next((f for f in folders if os.path.isfile(f / INDEX) or any(f.glob("*.torch"))), None)


def _indexed(index: Path) -> Iterator[Photographs]:
    """The scenes of the chunks that an index lists."""
    content = read_json(index, "download it again")
    if (
        not isinstance(content, dict)
        or not content
        or not all(isinstance(chunk, str) for chunk in content.values())
    ):
        raise InputError(
            f"{index} is no index of chunks: it has to map the key of each scene to the name of "
            "its .torch file."
        )
    return (
        scene
        for chunk in sorted(set(content.values()))
        for scene in _checked(index.parent / chunk, content, index)
    )


def _checked(path: Path, content: Mapping[str, str], index: Path) -> list[Photographs]:
    """The scenes of a chunk, which are those that the index has for it."""
    scenes = list(_scenes_of(path))
    names = {scene.name for scene in scenes}
    listed = {name for name, chunk in content.items() if index.parent / chunk == path}
    for name in sorted(listed - names):
        raise InputError(
            f"{index} says that the scene {quoted(name)} is in {path}, which does not hold it; "
            "write the index again, or download the chunk again."
        )
    for name in sorted(names - listed):
        raise InputError(
            f"{path} holds the scene {quoted(name)}, which is absent from {index}; write the "
            "index again, or name the chunk itself."
        )
    return scenes


def _scenes_of(path: Path) -> Iterator[Photographs]:
    """The scenes of one chunk."""
    return (
        _photographs(example, path, position) for position, example in enumerate(_load_chunk(path))
    )


def _load_chunk(path: Path) -> list[Any]:
    """The scenes of a chunk, not checked one by one."""
    check_file(path)
    return _read_chunk(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _read_chunk(path: Path, _written: int) -> list[Any]:
    """The last one stays in memory, for the frames that are asked for one after the other."""
    refuse_pointer(path)
    try:
        with warnings.catch_warnings():
            # About pickle protocols, in the moment before the file is refused.
            warnings.simplefilter("ignore")
            content = torch.load(path, map_location="cpu", weights_only=True)
    except PermissionError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}; make it readable.") from error
    # On damaged bytes the unpickler raises whatever the next instruction leads to.
    except Exception as error:
        raise InputError(_cannot_load(path, error)) from error
    if not isinstance(content, list) or not content:
        raise InputError(
            f"{path} is no chunk: a list of scenes is needed, and it holds "
            f"{'none' if content == [] else type(content).__name__}."
        )
    return content


def _cannot_load(path: Path, error: Exception) -> str:
    if "GLOBAL" in str(error):
        return (
            f"{path} holds pickled Python objects, which are refused because loading them can "
            "run any code; save it again with tensors, strings, lists and dicts only."
        )
    if isinstance(error, MemoryError) or "allocate memory" in str(error):
        return f"{path} asks for more memory than there is; divide it, or download it again."
    return f"{path} is truncated or no file of torch.save; download it again."


def _photographs(example: Any, path: Path, position: int) -> Photographs:
    """A scene, checked as far as that goes without decoding its images."""
    entries = example if isinstance(example, dict) else {}
    name, cameras, images = (entries.get(key) for key in ("key", "cameras", "images"))
    if not isinstance(name, str) or not name:
        raise InputError(f"Scene {position} of {path} has no `key`; write the chunk again with it.")
    called = f"scene {quoted(name)} of {path}"
    if not (_is_dense(cameras, ndim=2) and cameras.is_floating_point() and cameras.shape[1] == 18):
        raise InputError(
            f"The `cameras` of the {called} are {_described(cameras)}; floats of shape [n, 18] "
            "are needed."
        )
    if not isinstance(images, list) or len(images) == 0:
        raise InputError(f"The `images` of the {called} are no list with images in it.")
    if len(images) != len(cameras):
        raise InputError(
            f"The {called} has {len(images)} images and {len(cameras)} cameras; one camera for "
            "each image is needed, so download the chunk again."
        )
    for number, image in enumerate(images):
        if not _is_dense(image, ndim=1) or image.dtype != torch.uint8:
            raise InputError(
                f"Image {number} of the {called} is {_described(image)}; the bytes of a JPEG or "
                "PNG file are needed, uint8 of one dimension."
            )
    frames = []
    for number, row in enumerate(cameras.detach().double().numpy()):
        intrinsics, c2w = intrinsics_and_pose(row)
        image = partial(_image_bytes, path, position, number)
        title = f"frame {number} of the {called}"
        frames.append(Frame(str(number), title, c2w, intrinsics, image))
    return photographs_of(name, f"the {called}", frames)


def _image_bytes(path: Path, position: int, number: int) -> bytes:
    """An image file of a chunk, of which nothing else stays in memory."""
    data: bytes = _load_chunk(path)[position]["images"][number].detach().numpy().tobytes()
    return data


def _is_dense(value: Any, ndim: int) -> TypeGuard[Tensor]:
    """Whether it is a tensor of `ndim` dimensions that holds a number for each of its entries."""
    if not isinstance(value, Tensor) or value.is_nested or value.ndim != ndim:
        return False
    if value.layout != torch.strided or value.is_meta or value.is_quantized:
        return False
    return value.untyped_storage().nbytes() >= value.numel() * value.element_size()


def _described(value: Any) -> str:
    if isinstance(value, Tensor):
        if value.is_nested:
            return "a nested tensor"
        kind = "" if _is_dense(value, value.ndim) else "sparse or empty "
        shape = quoted(list(value.shape))
        return f"{kind}{str(value.dtype).removeprefix('torch.')} of shape {shape}"
    return f"of type {type(value).__name__}"
