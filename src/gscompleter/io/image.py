"""Conversion between image files and tensors."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from gscompleter.errors import InputError, quote_value, refuse_pointer
from gscompleter.io.files import replace_file
from gscompleter.io.reading import check_file

IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM", "GIF", "JPEG2000")
"""Image formats that are read. Others in Pillow run programs or are no photographs."""

MAX_PIXELS = 178_956_970
"""Largest number of pixels of an image, as in Pillow."""

PNG_COMPRESSION = 3
"""zlib level of written PNGs: 6 % more bytes than level 6, in a third of its time."""

ORIENTATION = 0x0112
"""EXIF tag of the orientation; 1 is upright."""


def read_image(path: Path | str) -> Float[Tensor, "h w 3"]:
    """Read an image in [0, 1]; transparent parts are composited over black."""
    return convert_to_image(read_pixels(path))


def write_image(
    path: Path | str, image: Float[Tensor, "h w 3"] | Float[Tensor, "h w"] | Bool[Tensor, "h w"]
) -> None:
    """Write colours, or a grey image or mask, as an 8-bit PNG."""
    with replace_file(path) as file:
        Image.fromarray(convert_to_pixels(image)).save(
            file, format="PNG", compress_level=PNG_COMPRESSION
        )


def convert_to_pixels(
    image: Float[Tensor, "h w 3"] | Float[Tensor, "h w"] | Bool[Tensor, "h w"],
) -> UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"]:
    """Convert values in [0, 1] to 8 bits: clamped, rounded to the nearest, NaN as 0."""
    values = image.detach().cpu().double().nan_to_num(nan=0.0).clamp(0, 1)
    return (values * 255 + 0.5).floor().to(torch.uint8).numpy()


def convert_to_image(pixels: UInt8[np.ndarray, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Convert 8-bit pixels to colours in [0, 1]."""
    return torch.from_numpy(pixels.astype(np.float32) / 255)


def read_image_size(stored: Path | bytes, name: str = "") -> tuple[int, int]:
    """Read width and height of an image file, or of its bytes; `name` is for errors."""
    with open_image(stored, name) as image:
        return image.size


def has_orientation_tag(path: Path) -> bool:
    """Return True if the EXIF data of a photograph ask viewers to rotate it."""
    with suppress(InputError), open_image(path) as image:
        return bool(image.getexif().get(ORIENTATION, 1) != 1)
    return False  # reading the photograph reports the error


def read_pixels(stored: Path | str | bytes, name: str = "") -> UInt8[np.ndarray, "h w 3"]:
    """Read an image in 8-bit colours, over black; 16-bit images are reduced.

    Orientation tags are ignored, because poses and intrinsics belong to the stored pixels.
    """
    with open_image(stored, name) as image:
        return _composite_over_black(image)


def read_brightness(stored: Path | bytes, side: int) -> Float[np.ndarray, "h w"]:
    """Read the brightness (0 to 255) of an image shrunk to a longer side of `side` pixels."""
    with open_image(stored) as image:
        scale = min(1.0, side / max(image.size))
        size = max(round(image.width * scale), 1), max(round(image.height * scale), 1)
        image.draft("L", size)
        pixels = _composite_over_black(image)
    grey = Image.fromarray(pixels).convert("L")
    return np.array(grey.resize(size, Image.Resampling.BOX), np.float32)


def read_depth(path: Path, unit: float) -> Float[np.ndarray, "h w"]:
    """Read z-depth from a 16-bit PNG or a `.npy` file, times `unit`; 0 where unknown."""
    if path.suffix == ".npy":
        values = _read_array(path)
    else:
        with open_image(path) as image:
            values = np.array(image)
    values = values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values
    if values.ndim != 2 or values.dtype.kind not in "uif" or values.dtype == np.uint8:
        raise InputError(
            f"{quote_value(path)} is no depth map: a 16-bit grey PNG or an array [h, w] of numbers "
            f"is needed, and it holds {values.dtype} of shape {quote_value(list(values.shape))}."
        )
    with np.errstate(over="ignore", invalid="ignore"):
        depth = (values.astype(np.float64) * unit).astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _read_array(path: Path) -> np.ndarray:
    check_file(path)
    try:
        # A memory map cannot exceed the file, whatever size its header claims.
        values = np.lib.format.open_memmap(path, mode="r")
        if not 0 < values.size <= MAX_PIXELS:
            raise ValueError(f"it claims {values.size:,} values")
    except Exception as error:  # damaged files raise any kind
        raise InputError(
            f"The depth map {quote_value(path)} cannot be read ({quote_value(str(error))}); copy "
            "it again."
        ) from error
    return values


@contextmanager
def open_image(stored: Path | str | bytes, name: str = "") -> Iterator[Image.Image]:
    """Open an image file, or its bytes; any failure while it is read becomes an InputError."""
    file = io.BytesIO(stored) if isinstance(stored, bytes) else Path(stored)
    shown = quote_value(name) if isinstance(file, io.BytesIO) else f"The image {quote_value(file)}"
    if isinstance(file, Path):
        check_file(file)
        refuse_pointer(file)
    Image.preinit()  # usual formats only; Pillow would load all of them
    try:
        with Image.open(file, formats=IMAGE_FORMATS) as image:
            yield image
    except Exception as error:  # damaged files raise any kind
        raise InputError(
            f"{shown} is not an image that can be read ({quote_value(str(error), 120)}); copy it "
            "again."
        ) from error


def _composite_over_black(image: Image.Image) -> UInt8[np.ndarray, "h w 3"]:
    if image.mode == "F":
        raise ValueError("it holds floating-point values, not colours")
    if image.mode == "I" or image.mode.startswith("I;16"):
        grey = np.array(image).astype(np.float64) / 257
        return np.repeat((grey + 0.5).clip(0, 255).astype(np.uint8)[..., None], 3, axis=-1)
    if image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info:
        rgba = np.array(image.convert("RGBA")).astype(np.uint16)
        return ((rgba[..., :3] * rgba[..., 3:] + 127) // 255).astype(np.uint8)
    return np.array(image.convert("RGB"))


def encode_jpeg(image: Image.Image, quality: int) -> bytes:
    """Encode an image as JPEG, with a quality from 1 to 95."""
    file = io.BytesIO()
    image.save(file, format="JPEG", quality=quality)
    return file.getvalue()
