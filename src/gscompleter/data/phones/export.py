"""Files of a phone's export, in a folder or a zip archive, and the photographs that they make.

Poses are ARKit's: camera-to-world in metres, x right, y up and z back in the stored photograph.
Confidence is ARKit's as well: 0 where depth is unreliable.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path, PurePath, PurePosixPath
from typing import NoReturn
from zipfile import ZipFile

import numpy as np
from jaxtyping import Float, Shaped

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.frame import MAX_MISSING_PHOTOGRAPHS, Frame, capitalize
from gscompleter.data.limits import require
from gscompleter.data.photograph import StoredPhotograph
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.data.transforms import OPENCV_FROM_OPENGL
from gscompleter.system.damage import describe_damage
from gscompleter.system.errors import InputError, join_names, quote_value
from gscompleter.system.files.image_opening import open_image
from gscompleter.system.files.names import is_hidden_name
from gscompleter.system.files.reading import check_file, read_bytes, read_zip_entry

PHONE_EXPORT_ADVICE = "export the recording again"
MAX_ENTRY = 1 << 28
"""Largest file in an archive, in bytes."""

Reader = Callable[[], bytes]
Files = dict[str, Reader]
"""Functions that read files, by the names of frames."""
Decoder = Callable[[bytes, str], Shaped[np.ndarray, "..."]]
"""Function from the bytes of a map of depth or confidence, and its title, to its values.

The title is for errors, such as "the depth of frame 3 of room.zip".
"""
PoseAndLens = tuple[Float[np.ndarray, "4 4"], Intrinsics]


def find_matches(export: Path, pattern: str) -> dict[PurePath, Reader]:
    """Map the paths of the files that match a pattern to their readers, sorted, of any recording.

    In an archive the export may lie in a folder of its own.
    """
    readers: dict[PurePath, Reader] = {
        path: partial(read_bytes, path) for path in export.glob(pattern)
    }
    if os.path.isfile(export) and export.suffix.lower() in (".zip", ".r3d"):
        with _open_archive(export) as archive:
            names = archive.namelist()
        # Programs write "./" in front of names, and Windows PowerShell separates folders by a
        # backslash. An entry is still read by its name as it is written.
        entries = {PurePosixPath(name.replace("\\", "/")): name for name in names}
        # `match` compares from the right, so that a folder around the export does not matter.
        readers = {
            path: partial(_read_archive_entry, export, name)
            for path, name in entries.items()
            if path.match(pattern)
        }
    return {path: readers[path] for path in sorted(readers) if not is_hidden_name(path.name)}


def find_files(export: Path, pattern: str) -> Files:
    """Map frame names to readers of the files that match a pattern, sorted by path.

    The name of a frame is that of the file without its ending and without what the pattern has
    before its asterisk, such as `frame_`. Where two files have one, it is refused when it is read.
    Raises InputError for several recordings, so that formats are detected by `find_matches`.
    """
    readers = find_matches(export, pattern)
    require(
        len({path.parent for path in readers}) <= 1,
        f"{quote_value(export)} holds several recordings; unpack it, and name one of them.",
    )
    prefix, asterisk, _ = PurePosixPath(pattern).name.partition("*")
    found: dict[str, list[PurePath]] = {}
    for path in readers:
        name = path.stem.removeprefix(prefix) if asterisk else path.stem
        found.setdefault(name, []).append(path)
    return {
        name: readers[same[0]] if len(same) == 1 else partial(_refuse_files, export, name, same)
        for name, same in found.items()
    }


def _refuse_files(export: Path, name: str, paths: Sequence[PurePath]) -> NoReturn:
    """Refuse several files of one frame."""
    names = join_names([path.name for path in paths], MAX_MISSING_PHOTOGRAPHS)
    raise InputError(
        f"Frame {quote_value(name)} of {quote_value(export)} has several files, {names}; keep one "
        "of them."
    )


def _read_archive_entry(export: Path, name: str) -> bytes:
    with _open_archive(export) as archive:
        return read_zip_entry(archive, name, MAX_ENTRY)


@contextmanager
def _open_archive(path: Path) -> Iterator[ZipFile]:
    check_file(path)
    try:
        yield _keep_open(path, path.stat().st_mtime_ns)
    except Exception as error:  # damaged archives raise anything
        raise InputError(
            f"{quote_value(path)} cannot be read ({describe_damage(error)}); {PHONE_EXPORT_ADVICE}."
        ) from error


@lru_cache(maxsize=1)
def _keep_open(path: Path, _written: int) -> ZipFile:
    """Open an archive; the last one stays open, because its list of files is long.

    One that was `_written` since, by its time of modification, is opened anew.
    """
    return ZipFile(path)


def decode_png(data: bytes, title: str) -> Shaped[np.ndarray, "..."]:
    """Decode the values of a PNG file."""
    with open_image(data, capitalize(title)) as image:
        return np.array(image)


def build_recording(
    path: Path,
    cameras: Mapping[str, PoseAndLens],
    files: Sequence[Files],
    decoders: tuple[Decoder, Decoder] = (decode_png, decode_png),
) -> Photographs:
    """Build photographs from cameras by frame name, and the files of images, depth and confidence.

    `decoders` are those of depth and of confidence, either of which a frame may lack. Cameras
    without a photograph are usual, and are left out; photographs without a camera are left out with
    a note.
    """
    frames = []
    images, depths, confidences = files
    for name, (c2w, lens) in cameras.items():
        if name not in images:
            continue
        title = f"frame {quote_value(name)} of {quote_value(path)}"
        depth = None
        if name in depths:
            depth = partial(_read_depth, depths[name], confidences.get(name), decoders, title)
        stored = StoredPhotograph(images[name], capitalize(title))
        frame = Frame(name, title, c2w @ OPENCV_FROM_OPENGL, lens, stored, depth)
        frames.append(frame.with_rigid_pose())
    require(frames, f"No photograph of {quote_value(path)} has a camera; {PHONE_EXPORT_ADVICE}.")
    place = path.resolve()
    # A dot in the name of a folder begins no ending.
    scene = place.stem if os.path.isfile(place) else place.name
    photographs = build_photographs(scene, quote_value(path), frames)
    lost = sorted(images.keys() - cameras.keys())
    if not lost:
        return photographs
    noun = "photograph" if len(lost) == 1 else "photographs"
    names = join_names(lost, MAX_MISSING_PHOTOGRAPHS)
    note = f"Left out of {quote_value(path)}: {len(lost):,} {noun} without a camera ({names})."
    return replace(photographs, notes=(note,))


def _read_depth(
    depth: Reader, confidence: Reader | None, decoders: tuple[Decoder, Decoder], title: str
) -> Float[np.ndarray, "h w"]:
    """Read z-depth in metres, 0 where it is unknown or unreliable."""
    stored = decoders[0](depth(), f"the depth of {title}")
    # Values of one byte are a picture of depth, and no distances.
    require(
        stored.ndim == 2 and stored.dtype.itemsize > 1,
        f"The depth of {title} is {stored.dtype} of shape {stored.shape}; one channel is needed, "
        f"of whole millimetres in 16 bits, or of metres; {PHONE_EXPORT_ADVICE}.",
    )
    # Confidence is optional; depth without it is taken as it is.
    sure = stored
    if confidence is not None:
        sure = decoders[1](confidence(), f"the confidence of {title}")
        require(
            sure.shape == stored.shape,
            f"The depth of {title} has the shape {stored.shape}, and its confidence {sure.shape}; "
            f"{PHONE_EXPORT_ADVICE}.",
        )
    known = (sure > 0) & (stored > 0) & np.isfinite(stored)
    unit = 1.0 if stored.dtype.kind == "f" else 1e-3  # whole numbers are millimetres
    return np.where(known, stored * unit, 0).astype(np.float32)
