"""Files of a phone's export, in a folder or a zip archive, and the depth maps among them.

Archives are read without unpacking. Confidence is ARKit's, 0 where depth is unreliable.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any
from zipfile import ZipFile

import numpy as np
from jaxtyping import Float, Shaped

from gscompleter.data.limits import require
from gscompleter.errors import InputError, quote_value
from gscompleter.io.image import open_image, read_depth
from gscompleter.io.reading import open_file, read_bytes

ADVICE = "export the recording again"
MAX_ENTRY = 1 << 28
"""Largest file in an archive, in bytes."""
MILLIMETRE = 1e-3
"""Unit of depth in PNG files, in metres."""

Reader = Callable[[], bytes]
"""Function that reads a file of the export."""


def find_files(export: Path, pattern: str) -> dict[str, Reader]:
    """Map frame names to readers of the files that match a pattern, sorted by path.

    The name of a frame is what follows the last underscore of the file's name. In an archive the
    export may lie in a folder of its own.
    """
    paths: list[Any] = list(export.glob(pattern))
    read: Callable[[Any], bytes] = read_bytes
    if os.path.isfile(export) and export.suffix.lower() in (".zip", ".r3d"):
        with _open_archive(export) as archive:
            paths = [p for p in map(PurePosixPath, archive.namelist()) if p.match(pattern)]
        read = partial(_read_entry, export)
    paths = sorted(path for path in paths if not path.name.startswith("."))
    require(
        len({path.parent for path in paths}) <= 1,
        f"{quote_value(export)} holds several recordings; unpack it, and name one of them.",
    )
    return {path.stem.rpartition("_")[2]: partial(read, path) for path in paths}


def _read_entry(export: Path, path: PurePosixPath) -> bytes:
    with _open_archive(export) as archive:
        if archive.getinfo(str(path)).file_size > MAX_ENTRY:
            raise ValueError(f"its {path} is too large")
        return archive.read(str(path))


@contextmanager
def _open_archive(path: Path) -> Iterator[ZipFile]:
    with open_file(path) as file:
        try:
            with ZipFile(file) as archive:
                yield archive
        except Exception as error:  # damaged archives raise anything
            raise InputError(
                f"{quote_value(path)} cannot be read ({quote_value(str(error), 120)}); {ADVICE}."
            ) from error


def read_png_depth(
    depth: Reader, confidence: Reader | None, title: str
) -> Float[np.ndarray, "h w"]:
    """Read z-depth in metres, 0 where it is unknown or unreliable."""
    values = read_depth(depth(), MILLIMETRE, title)
    if confidence is None:
        return values
    with open_image(confidence(), title) as image:
        return drop_unreliable(values, np.array(image), title)


def drop_unreliable(
    depth: Float[np.ndarray, "h w"], confidence: Shaped[np.ndarray, "..."], title: str
) -> Float[np.ndarray, "h w"]:
    """Return z-depth with 0 where the confidence is 0."""
    require(
        depth.shape == confidence.shape,
        f"The depth of {title} has the shape {list(depth.shape)}, and its confidence "
        f"{list(confidence.shape)}; {ADVICE}.",
    )
    return np.where(confidence > 0, depth, np.float32(0))
