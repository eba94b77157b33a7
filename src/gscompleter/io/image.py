"""Images between files and tensors."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from gscompleter.errors import InputError, quoted, refuse_pointer
from gscompleter.io.files import replacing

FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM", "GIF", "JPEG2000")
"""Formats of images that are read. Others that Pillow knows run programs, or are no photographs."""

MAX_PIXELS = 178_956_970
"""Of an image: where Pillow too takes a small file for a bomb."""

COMPRESSION = 3
"""Of the PNGs that are written: of a photograph 6 % more bytes than zlib's own 6, in a third of its
time."""

_ORIENTATION = 0x0112
"""The EXIF tag of how a photograph is to be turned; 1 for not at all."""


def read_image(path: Path | str) -> Float[Tensor, "h w 3"]:
    """The image in a file, in [0, 1]; transparent parts are composited over black.

    Raises:
        InputError: where it is missing, truncated or not an image.
    """
    return as_image(read_pixels(path))


def write_image(
    path: Path | str, image: Float[Tensor, "h w 3"] | Float[Tensor, "h w"] | Bool[Tensor, "h w"]
) -> None:
    """Write colours, or a grey image or mask, as an 8-bit PNG.

    Values are clamped to [0, 1] and rounded to the nearest of the 256 steps; NaN is black.

    Raises:
        InputError: where the file cannot be written.
    """
    with replacing(path) as file:
        Image.fromarray(as_pixels(image)).save(file, format="PNG", compress_level=COMPRESSION)


def as_pixels(
    image: Float[Tensor, "h w 3"] | Float[Tensor, "h w"] | Bool[Tensor, "h w"],
) -> UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"]:
    """Values in [0, 1] as 8-bit pixels: clamped, rounded to the nearest, and NaN as black."""
    values = image.detach().cpu().double().nan_to_num(nan=0.0).clamp(0, 1)
    return (values * 255 + 0.5).floor().to(torch.uint8).numpy()


def as_image(pixels: UInt8[np.ndarray, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """8-bit pixels as colours in [0, 1]."""
    return torch.from_numpy(pixels.astype(np.float32) / 255)


def image_size(stored: Path | bytes, name: str = "") -> tuple[int, int]:
    """Width and height in pixels, from the first bytes of an image file.

    Args:
        stored: The file, or its bytes.
        name: What error messages call the latter.

    Raises:
        InputError: where it is missing or not an image.
    """
    with _decoded(stored, name) if isinstance(stored, bytes) else _opened(stored) as image:
        return image.size


def is_turned(path: Path) -> bool:
    """Whether the EXIF data of a photograph tell viewers to turn it; False where it has none."""
    try:
        with _opened(path) as image:
            return bool(image.getexif().get(_ORIENTATION, 1) != 1)
    except Exception:  # whatever a damaged file does to Pillow; who reads the photograph is told
        return False


def read_pixels(path: Path | str) -> UInt8[np.ndarray, "h w 3"]:
    """The image in a file in 8-bit colours, over black.

    16-bit images are reduced to 8 bits. Orientation tags are not obeyed, because poses and
    intrinsics belong to the pixels as they are stored.

    Raises:
        InputError: where it is missing, truncated or not an image.
    """
    with _opened(path) as image:
        told = f"The image {quoted(Path(path))} is damaged"
        return _checked(lambda: _over_black(image), told, "copy it again")


def decode_pixels(data: bytes, name: str) -> UInt8[np.ndarray, "h w 3"]:
    """The image that the bytes of a PNG or JPEG file hold, as `read_pixels` has it.

    Raises:
        InputError: where they are truncated or no image; `name` is what it calls them.
    """
    with _decoded(data, name) as image:
        told = f"{quoted(name)} is damaged"
        return _checked(lambda: _over_black(image), told, "copy its file again")


def read_brightness(stored: Path | bytes, side: int, name: str = "") -> Float[np.ndarray, "h w"]:
    """Read the brightness, from 0 to 255, of an image shrunk to `side` pixels on its longer side.

    A JPEG file is decoded no larger than necessary.

    Args:
        stored: The file, or its bytes.
        side: Longer side, in pixels.
        name: Name of the bytes in error messages.

    Raises:
        InputError: where it is missing, truncated or not an image.
    """
    with _decoded(stored, name) if isinstance(stored, bytes) else _opened(stored) as image:
        scale = min(1.0, side / max(image.size))
        size = max(round(image.width * scale), 1), max(round(image.height * scale), 1)
        image.draft("L", size)
        what = f"The image {quoted(name or str(stored))} is damaged"
        return _checked(lambda: _shrunk(image, size), what, "copy it again")


def _shrunk(image: Image.Image, size: tuple[int, int]) -> Float[np.ndarray, "h w"]:
    grey = Image.fromarray(_over_black(image)).convert("L")
    return np.array(grey.resize(size, Image.Resampling.BOX), np.float32)


def read_depth(path: Path, unit: float) -> Float[np.ndarray, "h w"]:
    """The z-depth in a 16-bit PNG or a `.npy` file, times `unit`; 0 where unknown.

    Raises:
        InputError: where the file is missing, damaged or not a depth map.
    """
    if not os.path.isfile(path):
        raise InputError(
            f"There is no depth map {quoted(path)}; restore it, or remove its `depth_file_path`."
        )
    told = f"The depth map {quoted(path)} cannot be read"
    values = _checked(lambda: _depth_values(path), told, "copy it again")
    values = values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values
    if values.ndim != 2 or values.dtype.kind not in "uif" or values.dtype == np.uint8:
        raise InputError(
            f"{quoted(path)} is no depth map: a 16-bit grey PNG or an array [h, w] of numbers is "
            f"needed, and it holds {values.dtype} of shape {quoted(list(values.shape))}."
        )
    with np.errstate(over="ignore", invalid="ignore"):
        depth = (values.astype(np.float64) * unit).astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _depth_values(path: Path) -> np.ndarray:
    if path.suffix != ".npy":
        with Image.open(path, formats=FORMATS) as image:
            return np.array(image)
    # A map of the file holds no more than the file does, whatever its header claims.
    values = np.lib.format.open_memmap(path, mode="r")
    if not 0 < values.size <= MAX_PIXELS:
        raise ValueError(f"it claims {values.size:,} values")
    return values


def _checked(decode: Callable[[], np.ndarray], told: str, advice: str) -> np.ndarray:
    """What `decode` gives; a damaged file can fail in any way."""
    try:
        return decode()
    except Exception as error:
        raise InputError(f"{told} ({quoted(str(error))}); {advice}.") from error


def _opened(path: Path | str) -> Image.Image:
    path = Path(path)
    if not os.path.isfile(path):
        raise InputError(f"There is no image {quoted(path)}; restore it or correct its path.")
    refuse_pointer(path)
    return _open(path, quoted(path), "a PNG or JPEG file is")


def _decoded(data: bytes, name: str) -> Image.Image:
    return _open(io.BytesIO(data), quoted(name), "the bytes of a PNG or JPEG file are")


def _open(file: Path | io.BytesIO, name: str, needed: str) -> Image.Image:
    Image.preinit()  # the usual formats; otherwise Pillow loads all that it knows to open the first
    try:
        return Image.open(file, formats=FORMATS)
    except Image.DecompressionBombError as error:
        raise InputError(
            f"{name} claims more than {MAX_PIXELS:,} pixels; make it smaller."
        ) from error
    except Exception as error:  # whatever a damaged file does to Pillow
        raise InputError(f"{name} is not an image that can be read; {needed} needed.") from error


def _over_black(image: Image.Image) -> UInt8[np.ndarray, "h w 3"]:
    if image.mode == "F":
        raise ValueError("it holds floating-point values, not colours")
    if image.mode == "I" or image.mode.startswith("I;16"):
        grey = np.array(image).astype(np.float64) / 257
        return np.repeat((grey + 0.5).clip(0, 255).astype(np.uint8)[..., None], 3, axis=-1)
    if image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info:
        rgba = np.array(image.convert("RGBA")).astype(np.uint16)
        return ((rgba[..., :3] * rgba[..., 3:] + 127) // 255).astype(np.uint8)
    return np.array(image.convert("RGB"))


def jpeg_of(image: Image.Image, quality: int) -> bytes:
    """`image` as a JPEG file, of a quality from 1 to 95."""
    file = io.BytesIO()
    image.save(file, format="JPEG", quality=quality)
    return file.getvalue()
