"""The .sog format of PlayCanvas, a folder or a bundle (a zip of the same files), read only.

`meta.json` names lossless WebP images with one Gaussian per pixel: two images for 16 bits of
position on a logarithmic scale, one for the rotation (2 + 3 x 8 bits), one for scales, one for
colour and opacity. SH of degree 1 and above are rows of a palette. Bytes are entries of a
codebook (version 2) or steps between a minimum and a maximum (version 1). Antialiased Gaussians
are marked by `"model": "antialiased"`, in early files of version 2 by `"antialias": true`.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from PIL import Image

from gscompleter.errors import InputError, quote_value
from gscompleter.io.reading import read_bytes
from gscompleter.splats.packing import (
    NUM_SH_REST,
    assemble_sh,
    build_gaussians,
    check_growth,
    make_damage_error,
    refuse_invalid,
    restore_largest,
)
from gscompleter.types import SH_C0, Gaussians

META = "meta.json"
ZIP_MAGIC = b"PK\x03\x04"
PALETTE_WIDTH = 64
"""Entries of the SH palette in each row of its image."""
MAX_ENTRY_GROWTH = 8
"""Largest ratio of unpacked to packed size of a zip entry; images do not shrink."""
ZIP_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    RuntimeError,
    ValueError,
)
"""Exceptions that Python raises for a damaged or encrypted bundle."""


@dataclass(frozen=True)
class SogFiles:
    """The files of a scene, in a folder or a bundle."""

    path: Path
    read: Callable[[str], bytes]

    def load_pixels(self, name: object, needed: int) -> UInt8[ndarray, "h w 4"]:
        """Read an image of at least `needed` pixels."""
        data = self.read(_check_file_name(self.path, name))
        width, height = _parse_webp_size(self.path, data)
        check_growth(self.path, 4 * width * height, len(data))
        if width * height < needed:
            raise make_damage_error(
                self.path, f"{quote_value(name)} has fewer pixels than there are Gaussians"
            )
        try:
            return np.array(Image.open(io.BytesIO(data), formats=["WEBP"]).convert("RGBA"))
        except (OSError, ValueError, SyntaxError, MemoryError) as error:
            raise make_damage_error(self.path, f"{quote_value(name)} is no image") from error


def is_sog(head: bytes) -> bool:
    """Return True if a file with the first bytes `head` is a bundle or a `meta.json`."""
    return head.startswith(ZIP_MAGIC) or head.lstrip()[:1] == b"{"


def read_sog(path: Path) -> Gaussians:
    """Read a bundle, a folder, or the folder of a `meta.json`."""
    if path.is_dir():
        return _read_files(SogFiles(path, lambda name: read_bytes(path / name)))
    data = read_bytes(path)
    if not data.startswith(ZIP_MAGIC):
        return _read_files(SogFiles(path, lambda name: read_bytes(path.parent / name)), path.name)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as bundle:
            if META not in bundle.namelist():
                raise InputError(
                    f"{quote_value(path)} is no .sog: this archive has no {META} in it."
                )
            return _read_files(SogFiles(path, lambda name: _read_entry(path, bundle, name)))
    except InputError:
        raise
    except ZIP_ERRORS as error:
        raise make_damage_error(path, "its bundle cannot be opened") from error


def _read_entry(path: Path, bundle: zipfile.ZipFile, name: str) -> bytes:
    try:
        entry = bundle.getinfo(name)
    except KeyError as error:
        raise make_damage_error(path, f"it has no {quote_value(name)}") from error
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise make_damage_error(path, f"its {quote_value(name)} has an unsupported compression")
    check_growth(path, entry.file_size, entry.compress_size, MAX_ENTRY_GROWTH)
    with bundle.open(entry) as file:
        return file.read(entry.file_size)


def _check_file_name(path: Path, name: object) -> str:
    """Check that `name` is a file directly beside `meta.json`."""
    if not isinstance(name, str) or not name or Path(name).name != name or not name.isprintable():
        raise make_damage_error(
            path, f"it names a file '{quote_value(name)}' that is not beside it"
        )
    return name


def _parse_webp_size(path: Path, data: bytes) -> tuple[int, int]:
    """Parse width and height of a lossless WebP without decoding it."""
    if data[:4] == b"RIFF" and data[8:15] == b"WEBPVP8" and len(data) >= 30:
        if data[15:16] == b"L":
            (bits,) = struct.unpack_from("<I", data, 21)
            return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
        if data[15:16] == b"X":
            width, height = (int.from_bytes(data[at : at + 3], "little") for at in (24, 27))
            return width + 1, height + 1
    raise make_damage_error(path, "one of its images is no lossless WebP")


def _read_files(parts: SogFiles, meta: str = META) -> Gaussians:
    with refuse_invalid(parts.path, meta):
        table = json.loads(parts.read(meta))
        if not isinstance(table, dict) or "means" not in table:
            raise InputError(f"{parts.path} is no .sog: its {meta} describes something else.")
        version = table.get("version", 1)
        if version not in (1, 2):
            raise InputError(
                f"{parts.path} is .sog version {quote_value(version)}; 1 and 2 are known."
            )
        marked = table.get("model") == "antialiased" or table.get("antialias") is True
        return replace(_decode_scene(parts, table, version), is_antialiased=marked)


def _decode_scene(parts: SogFiles, table: dict[str, Any], version: int) -> Gaussians:
    count = int(table["count"] if version == 2 else table["means"]["shape"][0])
    if count < 0:
        raise make_damage_error(parts.path, f"it counts {count} Gaussians")
    means = _decode_means(parts, table["means"], count)
    (name,) = table["quats"]["files"]
    packed = parts.load_pixels(name, count).reshape(-1, 4)[:count]
    logs = _decode_values(parts, table["scales"], count, version, 3)
    rgba = _decode_values(parts, table["sh0"], count, version, 4)
    opacities = rgba[:, 3] if version == 2 else 1 / (1 + np.exp(-rgba[:, 3]))
    rest = _decode_sh_rest(parts, table["shN"], count, version) if table.get("shN") else None
    sh = assemble_sh(0.5 + SH_C0 * rgba[:, :3], rest)
    return build_gaussians(means, _decode_quats(packed), np.exp(logs), opacities, sh)


def _decode_means(parts: SogFiles, table: dict[str, Any], count: int) -> Float[ndarray, "n 3"]:
    low, high = (
        parts.load_pixels(name, count).reshape(-1, 4)[:count, :3].astype(np.float32)
        for name in table["files"]
    )
    steps = (low + 256 * high) / 65535
    logs = _interpolate(table["mins"], table["maxs"], steps, 3)
    return np.sign(logs) * np.expm1(np.abs(logs))


def _interpolate(
    low: object, high: object, fractions: Float[ndarray, "n k"], k: int
) -> Float[ndarray, "n k"]:
    lowest, highest = (np.asarray(bound, np.float32).reshape(k) for bound in (low, high))
    return lowest + (highest - lowest) * fractions


def _decode_quats(packed: UInt8[ndarray, "n 4"]) -> Float[ndarray, "n 4"]:
    smaller = (packed[:, :3].astype(np.float32) / 255 - 0.5) * np.float32(np.sqrt(2))
    quats = restore_largest(packed[:, 3] & 3, smaller)
    quats[packed[:, 3] < 252] = (1, 0, 0, 0)  # the identity, as in other readers
    return quats


def _decode_values(
    parts: SogFiles, table: dict[str, Any], count: int, version: int, k: int
) -> Float[ndarray, "n k"]:
    """Decode the first `k` channels of an image; in version 2 the fourth is a fraction."""
    (name,) = table["files"]
    packed = parts.load_pixels(name, count).reshape(-1, 4)[:count, :k]
    if version == 1:
        return _interpolate(table["mins"], table["maxs"], packed.astype(np.float32) / 255, k)
    codes = _get_codebook(table)[packed[:, :3]]
    return np.concatenate([codes, packed[:, 3:].astype(np.float32) / 255], axis=1)


def _get_codebook(table: dict[str, Any]) -> Float[ndarray, "256"]:
    return np.asarray(table["codebook"], np.float32).reshape(256)


def _decode_sh_rest(
    parts: SogFiles, table: dict[str, Any], count: int, version: int
) -> Float[ndarray, "n k 3"] | None:
    """Decode SH of degree 1 and above from the palette."""
    centroids, labels = table["files"]
    palette = parts.load_pixels(centroids, 1)
    k = palette.shape[1] // PALETTE_WIDTH
    if k not in NUM_SH_REST[1:] or palette.shape[1] % PALETTE_WIDTH:
        raise make_damage_error(
            parts.path, f"{quote_value(centroids)} is no palette of harmonics of degree 1 to 3"
        )
    rows = palette[:, :, :3].reshape(-1, k, 3)
    label = parts.load_pixels(labels, count).reshape(-1, 4)[:count].astype(np.int64)
    number = label[:, 0] + 256 * label[:, 1]
    if count and number.max() >= len(rows):
        raise make_damage_error(
            parts.path, f"{quote_value(labels)} names harmonics that are not in the palette"
        )
    if version == 2:
        return _get_codebook(table)[rows][number]
    low, high = float(table["mins"]), float(table["maxs"])
    return (low + (high - low) * rows.astype(np.float32) / 255)[number]
