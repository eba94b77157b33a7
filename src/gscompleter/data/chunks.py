"""Data sets in the chunk format of pixelSplat, which MVSplat, DepthSplat and VolSplat share.

A folder holds `000000.torch`, `000001.torch`, … and an `index.json` that maps the key of each
scene to its chunk. A chunk is a list of scenes: `key`, `cameras` [n, 18] and `images`, a list of
n tensors with the bytes of JPEG or PNG files. One chunk is in memory at a time, however many clips
are held, and an image is decoded only when its frame is asked for.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.data.clips import (
    StoredCamera,
    cameras_to_skip,
    check_frame,
    size_to_skip,
    view_of,
)
from gscompleter.data.framing import check_resolution
from gscompleter.errors import InputError
from gscompleter.io.image import decode_pixels, decoded_size
from gscompleter.io.json_file import read_json
from gscompleter.types import View

STAGES = ("test", "train")
"""Halves of a data set, each in a folder of its own."""

_KEYS = ("key", "cameras", "images")


@dataclass(frozen=True, eq=False)
class ChunkClip:
    """One scene of a chunk: its cameras, and where its images are, which it does not hold."""

    name: str
    path: Path
    """The chunk."""
    position: int
    """Which of the chunk's scenes it is."""
    cameras: Float[Tensor, "n 18"]

    def __len__(self) -> int:
        return len(self.cameras)

    def views(self, frames: Sequence[int], resolution: tuple[int, int] | None = None) -> list[View]:
        """The photographs of `frames`, resized to cover `resolution` (height, width), cropped.

        Raises:
            InputError: where a frame does not exist, is damaged or has an impossible camera.
        """
        check_resolution(resolution)
        for number in frames:
            check_frame(number, len(self), f"the scene {self.name} of {self.path}")
        return [self._view(number, resolution) for number in frames]

    def reason_to_skip(self, size: tuple[int, int] | None = None) -> str | None:
        """Why benchmarks leave the clip out; None where they keep it.

        Args:
            size: Height and width that every stored image must have, as (360, 640) for
                RealEstate10K and ACID; any if left out.

        Raises:
            InputError: where `size` is given and an image is none.
        """
        reason = cameras_to_skip([self._camera(number) for number in range(len(self))])
        if reason is not None or size is None:
            return reason
        for number in range(len(self)):
            found = decoded_size(self._image(number), self._name_of(number))
            reason = size_to_skip(number, found, size)
            if reason is not None:
                return reason
        return None

    def _view(self, number: int, resolution: tuple[int, int] | None) -> View:
        name = self._name_of(number)
        pixels = decode_pixels(self._image(number), name)
        return view_of(pixels, self._camera(number), number, name, resolution)

    def _image(self, number: int) -> bytes:
        """The image file of a frame."""
        example = _load_chunk(self.path)[self.position]
        return example["images"][number].numpy().tobytes()

    def _camera(self, number: int) -> StoredCamera:
        return StoredCamera.of_numbers(self.cameras[number].double().numpy())

    def _name_of(self, number: int) -> str:
        return f"Frame {number} of the scene {self.name} of {self.path}"


@dataclass(frozen=True)
class Chunks:
    """The scenes of a data set: iterate over all of them, or take one by its key."""

    paths: tuple[Path, ...]
    """The chunks in the order of their names."""
    index: Mapping[str, Path] | None = None
    """The chunk of each scene; None where there is no index."""
    index_path: Path | None = None

    def __iter__(self) -> Iterator[ChunkClip]:
        """All scenes, chunk by chunk.

        Raises:
            InputError: where a chunk is missing, damaged, holds pickled objects, or disagrees
                with the index.
        """
        for path in self.paths:
            yield from self._clips_of(path)

    def clip(self, name: str) -> ChunkClip:
        """The scene with that key.

        Raises:
            InputError: where there is none, and as iteration does.
        """
        if self.index is None:
            paths = self.paths
        elif name in self.index:
            paths = (self.index[name],)
        else:
            raise InputError(
                f"There is no scene {name} in {self.index_path}, which lists {len(self.index)}; "
                "correct its key, or download the part of the data set that has it."
            )
        for path in paths:
            for clip in self._clips_of(path):
                if clip.name == name:
                    return clip
        raise InputError(
            f"There is no scene {name} in the {len(paths)} chunks beside {paths[0]}; correct its "
            "key, or download the part of the data set that has it."
        )

    def _clips_of(self, path: Path) -> Iterator[ChunkClip]:
        """The scenes of one chunk."""
        examples = _load_chunk(path)
        names = [_key_of(example, i, path) for i, example in enumerate(examples)]
        if self.index is not None:
            self._check_index(set(names), path)
        for position, (example, name) in enumerate(zip(examples, names, strict=True)):
            yield _clip(example, name, path, position)

    def _check_index(self, names: set[str], path: Path) -> None:
        assert self.index is not None
        listed = {name for name, chunk in self.index.items() if chunk == path}
        for name in sorted(listed - names):
            raise InputError(
                f"{self.index_path} says that the scene {name} is in {path}, which does not hold "
                "it; write the index again, or download the chunk again."
            )
        for name in sorted(names - listed):
            raise InputError(
                f"{path} holds the scene {name}, which is absent from {self.index_path}; write "
                "the index again, or name the chunk itself."
            )


def open_chunks(path: Path | str, stage: str = "test") -> Chunks:
    """The scenes of a data set, with nothing read but its index.

    Args:
        path: A folder with an `index.json` and chunks, a folder that holds such folders named
            `test` and `train`, a folder of chunks without index, or one chunk.
        stage: Which of the two it should be, where `path` has both.

    Raises:
        InputError: where there are no chunks, or the index is damaged.
    """
    path = Path(path)
    if path.is_file():
        return Chunks((path,))
    folder = next((f for f in (path, path / stage) if _holds_chunks(f)), None)
    if folder is None:
        raise InputError(
            f"There are no chunks in {path}; name a folder with an index.json or .torch files, a "
            f"folder with such a folder {stage}, or a single .torch file."
        )
    if (folder / "index.json").is_file():
        return _read_index(folder / "index.json")
    return Chunks(tuple(sorted(folder.glob("*.torch"))))


def _holds_chunks(folder: Path) -> bool:
    return (folder / "index.json").is_file() or any(folder.glob("*.torch"))


def _read_index(path: Path) -> Chunks:
    content = read_json(path, "download it again")
    if (
        not isinstance(content, dict)
        or not content
        or not all(isinstance(chunk, str) for chunk in content.values())
    ):
        raise InputError(
            f"{path} is no index of chunks: it has to map the key of each scene to the name of "
            "its .torch file."
        )
    index = {name: path.parent / chunk for name, chunk in content.items()}
    return Chunks(tuple(sorted(set(index.values()))), index, path)


def _load_chunk(path: Path) -> list[Any]:
    """The scenes of a chunk, not checked one by one."""
    try:
        written = path.stat().st_mtime_ns
    except OSError:
        written = 0  # what is wrong with it is found out by reading it
    return _read_chunk(path, written)


@lru_cache(maxsize=1)
def _read_chunk(path: Path, _written: int) -> list[Any]:
    """The last one stays in memory, for the frames that are asked for one after the other."""
    if not os.path.isfile(path):
        raise InputError(f"There is no chunk {path}; download it, or take it out of the index.")
    try:
        with warnings.catch_warnings():
            # About pickle protocols, in the moment before the file is refused.
            warnings.simplefilter("ignore")
            content = torch.load(path, map_location="cpu", weights_only=True)
    except MemoryError:
        raise
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
    with path.open("rb") as file:
        if file.read(40).startswith(b"version https://git-lfs"):
            return (
                f"{path} is a git-lfs pointer, not the chunk itself; run `git lfs pull` in its "
                "repository."
            )
    return f"{path} is truncated or no file of torch.save; download it again."


def _key_of(example: Any, position: int, path: Path) -> str:
    if not isinstance(example, dict):
        raise InputError(
            f"Scene {position} of {path} is no dict but {type(example).__name__}; write the chunk "
            f"again with {', '.join(_KEYS)}."
        )
    name = example.get("key")
    if not isinstance(name, str) or not name:
        raise InputError(f"Scene {position} of {path} has no `key`; write the chunk again with it.")
    return name


def _clip(example: dict[str, Any], name: str, path: Path, position: int) -> ChunkClip:
    """A scene, checked as far as that goes without decoding its images."""
    called = f"scene {name} of {path}"
    for key in _KEYS:
        if key not in example:
            raise InputError(f"The {called} has no `{key}`; write the chunk again with it.")
    cameras, images = example["cameras"], example["images"]
    if (
        not isinstance(cameras, Tensor)
        or not cameras.is_floating_point()
        or cameras.ndim != 2
        or cameras.shape[1] != 18
    ):
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
        if not isinstance(image, Tensor) or image.dtype != torch.uint8 or image.ndim != 1:
            raise InputError(
                f"Image {number} of the {called} is {_described(image)}; the bytes of a JPEG or "
                "PNG file are needed, uint8 of one dimension."
            )
    # A copy, so that a clip keeps nothing of its chunk in memory.
    return ChunkClip(name, path, position, cameras.detach().clone())


def _described(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')} of shape {list(value.shape)}"
    return f"of type {type(value).__name__}"
