"""The .sog format of PlayCanvas, a folder or a bundle (a zip of the same files).

`meta.json` names lossless WebP images with one Gaussian per pixel: two images for 16 bits of
position on a logarithmic scale, one for the rotation (2 + 3 x 8 bits), one for scales, one for
colour and opacity. SH of degree 1 and above are rows of a palette. Bytes are entries of a
codebook (version 2) or steps between a minimum and a maximum (version 1). Antialiased Gaussians
are marked by `"model": "antialiased"`, in early files of version 2 by `"antialias": true`. Bundles
of version 2 are written.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped, UInt8
from numpy import ndarray
from PIL import Image, UnidentifiedImageError

from gscompleter.splats.codebooks import fit_codebook, fit_palette
from gscompleter.splats.packing import (
    MAX_LOG_SCALE,
    NUM_SH_REST,
    ZIP_MAGIC,
    UnsupportedError,
    assemble_sh,
    build_gaussians,
    check_count,
    drop_largest,
    restore_largest,
    with_labels,
)
from gscompleter.splats.ply import encode
from gscompleter.splats.provenance import KEY, NOTHING_KNOWN, Provenance
from gscompleter.splats.splat_format import FormatTexts, SplatFormat, list_zip
from gscompleter.system.damage import DamagedError
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_bytes, read_zip_entry
from gscompleter.system.files.writing import replace_file
from gscompleter.types import SH_C0, Gaussians

META = "meta.json"
LOD_META = "lod-meta.json"
"""Index of a streamed scene: one .sog for each level and place."""
LOD_KEY = "lodLevels"
"""Entry of that index: the number of levels."""
LABELS_IMAGE = "generated"
"""Name in `meta.json` of an image of the labels, if anything was generated; ours alone."""
PALETTE_WIDTH = 64
"""Entries of the SH palette in each row of its image."""
MAX_META = 1 << 24
"""Most bytes of `meta.json`."""
FREE_PIXELS = 1 << 20
"""Pixels that any image may have: a palette of 65,536 rows, the most that are numbered, fits."""
PADDING = 4
"""Most pixels for each Gaussian beside these: sides may be rounded up to powers of two."""
MAX_PIXEL_BYTES = 8
"""Most bytes that a lossless image takes for each pixel; four are in it."""

ROTATION_MARK = 252
"""Fourth byte of a rotation, plus the number of the dropped component."""
WIDTH_MULTIPLE = 4
"""Number of pixels of which the width of images is a multiple, as in other writers."""

FileReader = Callable[[str, int], bytes]
"""Function that reads a file of the scene by name and most bytes, from a folder or a bundle."""
Coded = tuple[dict[str, Any], dict[str, bytes]]
"""A property as numbers for `meta.json`, and images by file name."""
READ_PROPERTIES = ("means", "scales", "quats", "sh0", "shN", LABELS_IMAGE)
"""Entries of `meta.json` that are read; each names the images of a property of Gaussians."""


def read_sog(path: Path) -> Gaussians:
    """Read a bundle, a folder, or the folder of a `meta.json`."""
    if path.is_dir():
        refuse_pngs_of_gsplat(path)
        return _read_folder(path, META)
    data = read_bytes(path)
    if not data.startswith(ZIP_MAGIC):
        return _read_folder(path.parent, path.name)
    with zipfile.ZipFile(io.BytesIO(data)) as bundle:
        return _read_files(partial(_read_bundle_entry, bundle), META, len(data))


def _read_folder(folder: Path, meta: str) -> Gaussians:
    stored = sum(file.stat().st_size for file in folder.iterdir() if file.is_file())
    return _read_files(lambda name, most: read_bytes(folder / name, most), meta, stored)


def read_sog_record(path: Path) -> object:
    """Read the record in `meta.json`, or None if there is none."""
    return _read_meta(path).get(KEY)


def list_sog_names(path: Path) -> list[str]:
    """List the properties of Gaussians, each of them images, that are not read."""
    return [
        name
        for name, stored in _read_meta(path).items()
        if name not in READ_PROPERTIES and isinstance(stored, dict) and "files" in stored
    ]


def _read_meta(path: Path) -> dict[str, Any]:
    if path.is_dir():
        data = read_bytes(path / META, MAX_META)
    else:
        data = read_bytes(path)
        if data.startswith(ZIP_MAGIC):
            with zipfile.ZipFile(io.BytesIO(data)) as bundle:
                data = _read_bundle_entry(bundle, META, MAX_META)
    table: dict[str, Any] = json.loads(data)
    return table


def _read_bundle_entry(bundle: zipfile.ZipFile, name: str, most: int) -> bytes:
    if name not in bundle.NameToInfo:
        raise DamagedError(f"it lacks its file {quote_value(name)}")
    return read_zip_entry(bundle, name, most)


def _read_files(read: FileReader, meta: str, stored: int) -> Gaussians:
    """Read a scene of `stored` bytes."""
    table = json.loads(read(meta, MAX_META))
    version = table.get("version", 1)
    if "means" not in table or not isinstance(version, int) or version < 1:
        raise UnsupportedError(f"has a {meta} that describes no .sog of version 1 or 2")
    if version > 2:
        raise UnsupportedError(
            f"is a .sog of version {version}, and versions 1 and 2 are read; the program that "
            "wrote it, such as splat-transform 3.11, reads it"
        )
    marked = table.get("model") == "antialiased" or table.get("antialias") is True
    return replace(_decode_scene(read, table, stored), is_antialiased=marked)


def _decode_scene(read: FileReader, table: dict[str, Any], stored: int) -> Gaussians:
    """Decode the Gaussians of `stored` bytes; only version 2 has codebooks."""
    is_coded = table.get("version", 1) == 2
    count = int(table["count"] if is_coded else table["means"]["shape"][0])
    (quats,) = table["quats"]["files"]
    # Before the count is believed: an image with fewer pixels shows that it is wrong.
    quats_image = _open_image(read, quats, count)
    check_count(count, stored)
    logs = _decode_values(read, table["scales"], count, 3)
    rgba = _decode_values(read, table["sh0"], count, 4)
    rest = _decode_sh_rest(read, table["shN"], count) if table.get("shN") else None
    gaussians = build_gaussians(
        _decode_means(read, table["means"], count),
        _decode_quats(_decode_pixels(quats_image, quats, count)),
        np.exp(logs),
        rgba[:, 3] if is_coded else 1 / (1 + np.exp(-rgba[:, 3])),
        assemble_sh(0.5 + SH_C0 * rgba[:, :3], rest),
    )
    if LABELS_IMAGE not in table:
        return gaussians
    (labels,) = table[LABELS_IMAGE]["files"]
    return with_labels(gaussians, _read_pixels(read, labels, count)[:, 0])


def _open_image(read: FileReader, name: object, count: int) -> Image.Image:
    """Open an image of a number of Gaussians that lies directly beside `meta.json`.

    It is not decoded yet.
    """
    if not isinstance(name, str) or not name or Path(name).name != name:
        raise DamagedError(f"it names a file '{quote_value(name)}' that is not beside it")
    # The images of a scene have a pixel for each Gaussian, so that the count tells how large they
    # are; of one colour they take any number of pixels in a few bytes.
    most = FREE_PIXELS + PADDING * max(count, 0)
    data = read(name, MAX_PIXEL_BYTES * most)
    try:
        image = Image.open(io.BytesIO(data), formats=["WEBP"])
    except UnidentifiedImageError as error:
        raise DamagedError(f"its {quote_value(name)} is no WebP image") from error
    except OSError as error:
        raise DamagedError(f"its {quote_value(name)} is damaged, or ends too early") from error
    if not 0 <= count <= image.width * image.height:
        raise DamagedError(f"its {quote_value(name)} has fewer pixels than there are Gaussians")
    if image.width * image.height > most:
        raise DamagedError(
            f"its {quote_value(name)} claims to hold {image.width:,} × {image.height:,} pixels, "
            f"and there are {count:,} Gaussians"
        )
    return image


def _read_pixels(read: FileReader, name: object, count: int) -> UInt8[ndarray, "n 4"]:
    """Read the first `count` pixels of an image."""
    return _decode_pixels(_open_image(read, name, count), name, count)


def _decode_pixels(image: Image.Image, name: object, count: int) -> UInt8[ndarray, "n 4"]:
    return _decode_image(image, name).reshape(-1, 4)[:count]


def _decode_image(image: Image.Image, name: object) -> UInt8[ndarray, "h w 4"]:
    try:
        return np.array(image.convert("RGBA"))
    except (OSError, SyntaxError, ValueError) as error:
        raise DamagedError(f"its {quote_value(name)} is damaged, or ends too early") from error


def _decode_means(read: FileReader, table: dict[str, Any], count: int) -> Float[ndarray, "n 3"]:
    # Two images have the lower and the upper bytes.
    low, high = (
        _read_pixels(read, name, count)[:, :3].astype(np.float32) for name in table["files"]
    )
    steps = (low + 256 * high) / 65535
    logs = _interpolate(table["mins"], table["maxs"], steps, 3)
    # The inverse of sign(x) log(1 + |x|), which spends most steps near the origin.
    return np.sign(logs) * np.expm1(np.abs(logs))


def _interpolate(
    low: object, high: object, fractions: Float[ndarray, "n k"], k: int
) -> Float[ndarray, "n k"]:
    lowest = np.asarray(low, np.float32).reshape(k)
    highest = np.asarray(high, np.float32).reshape(k)
    return lowest + (highest - lowest) * fractions


def _decode_quats(packed: UInt8[ndarray, "n 4"]) -> Float[ndarray, "n 4"]:
    # Components in [-sqrt(1/2), sqrt(1/2)]; the fourth byte says which one was dropped.
    smaller = (packed[:, :3].astype(np.float32) / 255 - 0.5) * np.float32(np.sqrt(2))
    quats = restore_largest(packed[:, 3] & 3, smaller)
    quats[packed[:, 3] < ROTATION_MARK] = (1, 0, 0, 0)  # the identity, as in other readers
    return quats


def _decode_values(
    read: FileReader, table: dict[str, Any], count: int, k: int
) -> Float[ndarray, "n k"]:
    """Decode the first `k` channels of an image; beside a codebook the fourth is a fraction."""
    (name,) = table["files"]
    packed = _read_pixels(read, name, count)[:, :k]
    fractions = packed.astype(np.float32) / 255
    if "codebook" not in table:
        return _interpolate(table["mins"], table["maxs"], fractions, k)
    return np.concatenate([_get_codebook(table)[packed[:, :3]], fractions[:, 3:]], axis=1)


def _get_codebook(table: dict[str, Any]) -> Float[ndarray, "256"]:
    return np.asarray(table["codebook"], np.float32).reshape(256)


def _decode_sh_rest(read: FileReader, table: dict[str, Any], count: int) -> Float[ndarray, "n k 3"]:
    """Decode SH of degree 1 and above from the palette."""
    centroids, labels = table["files"]
    # Its rows are numbered by 16 bits, whatever the number of Gaussians.
    palette = _decode_image(_open_image(read, centroids, 0), centroids)[:, :, :3]
    k = palette.shape[1] // PALETTE_WIDTH
    if k not in NUM_SH_REST[1:]:
        raise DamagedError("its palette has no harmonics of degree 1 to 3")
    rows = palette.reshape(-1, k, 3)
    label = _read_pixels(read, labels, count).astype(np.int64)
    number = label[:, 0] + 256 * label[:, 1]
    if "codebook" in table:
        return _get_codebook(table)[rows[number]]
    low = float(table["mins"])
    high = float(table["maxs"])
    return low + (high - low) * rows[number].astype(np.float32) / 255


def write_sog(path: Path, gaussians: Gaussians, made_by: Provenance = NOTHING_KNOWN) -> None:
    """Write a bundle of version 2; the Gaussians should be sorted with `sort_along_morton`."""
    coded = _encode_scene(gaussians)
    model = "antialiased" if gaussians.is_antialiased else "default"
    table = {"version": 2, "count": len(gaussians), "model": model}
    table |= {name: {**values, "files": list(images)} for name, (values, images) in coded.items()}
    if made_by.runs:
        table[KEY] = made_by.to_json()
    files = {META: json.dumps(table).encode()}
    for _, images in coded.values():
        files |= images
    with replace_file(path) as file, zipfile.ZipFile(file, "w") as bundle:
        for name, data in files.items():
            bundle.writestr(zipfile.ZipInfo(name), data)  # without the time of writing


def _encode_scene(gaussians: Gaussians) -> dict[str, Coded]:
    """Encode the properties of Gaussians by their names in `meta.json`."""
    # Those of a .ply stay as they were read, where they still decode to the scales.
    log_scales = encode(gaussians)[:, :3].numpy().clip(-MAX_LOG_SCALE, MAX_LOG_SCALE)
    scale_book, scales = fit_codebook(log_scales)
    color_book, colors = fit_codebook(gaussians.sh[:, 0].numpy())
    rgba = np.column_stack([colors, np.rint(gaussians.opacities.numpy() * 255)])
    largest, smaller = drop_largest(gaussians.quats.numpy())
    quats = np.column_stack([np.rint((smaller / np.sqrt(2) + 0.5) * 255), ROTATION_MARK + largest])
    coded: dict[str, Coded] = {
        "means": _encode_means(gaussians.means.double().numpy()),
        "scales": ({"codebook": scale_book.tolist()}, {"scales.webp": _encode_image(scales)}),
        "quats": ({}, {"quats.webp": _encode_image(quats)}),
        "sh0": ({"codebook": color_book.tolist()}, {"sh0.webp": _encode_image(rgba)}),
    }
    if gaussians.sh_degree:
        coded["shN"] = _encode_sh_rest(gaussians)
    if gaussians.generated.any():
        labels = _encode_image(gaussians.generated[:, None].expand(-1, 3).numpy())
        coded[LABELS_IMAGE] = ({}, {"generated.webp": labels})
    return coded


def _encode_means(means: Float[ndarray, "n 3"]) -> Coded:
    """Encode positions as 16 bits between bounds on the logarithmic scale."""
    logs = np.sign(means) * np.log1p(np.abs(means))
    low = logs.min(0)
    high = logs.max(0)
    # 16 bits, of which each image holds 8.
    steps = np.rint((logs - low) / np.where(high > low, high - low, 1) * 65535).astype(np.int64)
    images = {"means_l.webp": _encode_image(steps & 255), "means_u.webp": _encode_image(steps >> 8)}
    return {"mins": low.tolist(), "maxs": high.tolist()}, images


def _encode_sh_rest(gaussians: Gaussians) -> Coded:
    """Encode SH of degree 1 and above as numbers of rows of a palette."""
    # Rows of all higher coefficients become a palette, and its numbers a codebook of 256.
    rest = gaussians.sh[:, 1:].flatten(1).numpy()
    palette, labels = fit_palette(rest)
    book, codes = fit_codebook(palette)
    width = PALETTE_WIDTH * rest.shape[1] // 3
    images = {
        "shN_centroids.webp": _encode_image(codes.reshape(-1, 3), width),
        "shN_labels.webp": _encode_image(np.stack([labels & 255, labels >> 8, 0 * labels], axis=1)),
    }
    sizes = {"count": len(palette), "bands": gaussians.sh_degree}
    return {**sizes, "codebook": book.tolist()}, images


def _encode_image(values: Shaped[ndarray, "n k"], width: int = 0) -> bytes:
    """Encode rows of 3 or 4 bytes as a lossless image, by default about square."""
    n, k = values.shape
    width = width or WIDTH_MULTIPLE * math.ceil(math.sqrt(n) / WIDTH_MULTIPLE)
    # Pixels beyond the last Gaussian are white and opaque.
    pixels = np.full((math.ceil(n / width), width, 4), 255, np.uint8)
    pixels.reshape(-1, 4)[:n, :k] = values
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


def is_bundle(path: Path, head: bytes) -> bool:
    """Check that a .zip is a bundle of one scene, and none of its levels of detail."""
    names = list_zip(path)
    if not names:
        # The reader says what is wrong with a damaged one.
        return path.suffix.lower() == ".sog"
    return META in names and not any(Path(name).name == LOD_META for name in names)


def is_meta(path: Path, head: bytes) -> bool:
    """Check that a file of JSON is the `meta.json` of a scene, under whatever name."""
    if path.name.lower() == META:
        return True
    table = _read_json_or_none(path)
    return isinstance(table, dict) and "means" in table and LOD_KEY not in table


def is_meta_of_others(path: Path) -> bool:
    """Check that a `meta.json` is whole, and describes something else than Gaussians."""
    table = _read_json_or_none(path)
    return isinstance(table, (dict, list)) and "means" not in table


def _read_json_or_none(path: Path) -> object:
    """Read a JSON file, or return None for one that is damaged or too large."""
    with suppress(InputError, ValueError, RecursionError):
        table: object = json.loads(read_bytes(path, MAX_META))
        return table
    return None


def refuse_pngs_of_gsplat(folder: Path) -> None:
    """Raise InputError for a folder of PNGs of gsplat, whose `meta.json` is none of a .sog."""
    table = _read_json_or_none(folder / META)
    properties = list(table.values()) if isinstance(table, dict) else []
    are_described = [isinstance(entry, dict) and "dtype" in entry for entry in properties]
    if are_described and all(are_described) and not any("files" in entry for entry in properties):
        raise InputError(
            f"{quote_value(folder)} is a splat that gsplat compressed to PNGs (PngCompression); "
            "decompress it with gsplat, export a .ply, and name that."
        )


SOG_TEXTS = FormatTexts(
    title="PlayCanvas",
    read="versions 1 and 2, bundle, folder or `meta.json`",
    written="bundle of version 2, along a Morton curve",
    precision="position 16 bits on a logarithmic scale; rotation 8 bits a component; opacity 8 "
    "bits; log-scales, colours and harmonics from codebooks of 256 numbers; harmonics of four "
    "Gaussians share a row of a palette (of more from 262,144 on, of one up to 4,096)",
    places={
        "holds_labels": "image `generated.webp`, which `generated.files` in `meta.json` names",
        "read_record": "`provenance` in `meta.json`",
        "marks_antialiased": '`"model": "antialiased"` or `"antialias": true`',
        "list_names": "those of Gaussians",
    },
)
SOG = SplatFormat(
    name="sog",
    endings=(".sog",),
    texts=SOG_TEXTS,
    read=read_sog,
    starts=(ZIP_MAGIC,),
    recognize=is_bundle,
    write=write_sog,
    read_record=read_sog_record,
    list_names=list_sog_names,
    holds_labels=True,
    marks_antialiased=True,
    is_sorted=True,
    rounds_geometry=True,
    has_json=True,
)
SOG_FOLDER = SplatFormat(
    name="sog-folder",
    endings=(META,),
    texts=SOG_TEXTS,
    read=read_sog,
    starts=(b"{",),
    recognize=is_meta,
    read_record=read_sog_record,
    list_names=list_sog_names,
    holds_labels=True,
    marks_antialiased=True,
    has_json=True,
)
