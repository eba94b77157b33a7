"""Images between files and tensors."""

from __future__ import annotations

import io
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.io.files import replacing

_DAMAGED = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)
"""What Pillow raises for files that are no images, or are damaged ones."""

_ORIENTATION = 0x0112
"""The EXIF tag of how a photograph is to be turned; 1 for not at all."""


def read_image(path: Path | str) -> Float[Tensor, "h w 3"]:
    """The image in a file, in [0, 1]; transparent parts are composited over black.

    Raises:
        InputError: where it is missing, truncated or not an image.
    """
    return as_image(read_pixels(path))


def write_image(
    path: Path | str,
    image: Float[Tensor, "h w 3"] | Float[Tensor, "h w"] | Bool[Tensor, "h w"],
) -> None:
    """Write colours, or a grey image or mask, as an 8-bit PNG.

    Values are clamped to [0, 1] and rounded to the nearest of the 256 steps; NaN is black.

    Raises:
        InputError: where the file cannot be written.
    """
    values = image.detach().cpu().double().nan_to_num(nan=0.0).clamp(0, 1)
    pixels = (values * 255 + 0.5).floor().to(torch.uint8).numpy()
    with replacing(path) as file:
        Image.fromarray(pixels).save(file, format="PNG")


def as_image(pixels: UInt8[np.ndarray, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """8-bit pixels as colours in [0, 1]."""
    return torch.from_numpy(pixels.astype(np.float32) / 255)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the first bytes of the file.

    Raises:
        InputError: where it is missing or not an image.
    """
    with _opened(path) as image:
        return image.size


def is_turned(path: Path) -> bool:
    """Whether the EXIF data of a photograph tell viewers to turn it; False where it has none."""
    try:
        with _opened(path) as image:
            return image.getexif().get(_ORIENTATION, 1) != 1
    except (InputError, *_DAMAGED):
        return False


def read_pixels(path: Path | str) -> UInt8[np.ndarray, "h w 3"]:
    """The image in a file in 8-bit colours, over black.

    16-bit images are reduced to 8 bits. Orientation tags are not obeyed, because poses and
    intrinsics belong to the pixels as they are stored.

    Raises:
        InputError: where it is missing, truncated or not an image.
    """
    with _opened(path) as image:
        try:
            return _over_black(image)
        except _DAMAGED as error:
            raise InputError(f"The image {path} is damaged ({error}); copy it again.") from error


def decode_pixels(data: bytes, name: str) -> UInt8[np.ndarray, "h w 3"]:
    """The image that the bytes of a PNG or JPEG file hold, as `read_pixels` has it.

    Args:
        data: The bytes.
        name: What error messages call the image.

    Raises:
        InputError: where they are truncated or no image.
    """
    with _decoded(data, name) as image:
        try:
            return _over_black(image)
        except _DAMAGED as error:
            raise InputError(f"{name} is damaged ({error}); copy its file again.") from error


def decoded_size(data: bytes, name: str) -> tuple[int, int]:
    """Width and height of an image in memory, from the first of its bytes.

    Raises:
        InputError: where they are no image.
    """
    with _decoded(data, name) as image:
        return image.size


def read_depth(path: Path, unit: float) -> Float[np.ndarray, "h w"]:
    """The z-depth in a 16-bit PNG or a `.npy` file, times `unit`; 0 where unknown.

    Raises:
        InputError: where the file is missing, damaged or not a depth map.
    """
    if not os.path.isfile(path):
        raise InputError(
            f"There is no depth map {path}; restore it, or remove its `depth_file_path`."
        )
    try:
        if path.suffix == ".npy":
            values = np.load(path, allow_pickle=False)
        else:
            with Image.open(path) as image:
                values = np.array(image)
    except _DAMAGED as error:
        raise InputError(
            f"The depth map {path} cannot be read ({error}); copy it again."
        ) from error
    values = values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values
    if values.ndim != 2 or values.dtype.kind not in "uif" or values.dtype == np.uint8:
        raise InputError(
            f"{path} is no depth map: a 16-bit grey PNG or an array [h, w] of numbers is needed, "
            f"and it holds {values.dtype} of shape {list(values.shape)}."
        )
    depth = (values.astype(np.float64) * unit).astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _opened(path: Path | str) -> Image.Image:
    if not os.path.isfile(path):
        raise InputError(f"There is no image {path}; restore it or correct its path.")
    try:
        return Image.open(path)
    except _DAMAGED as error:
        raise InputError(
            f"{path} is not an image that can be read; a PNG or JPEG file is needed."
        ) from error


def _decoded(data: bytes, name: str) -> Image.Image:
    try:
        return Image.open(io.BytesIO(data))
    except _DAMAGED as error:
        raise InputError(
            f"{name} is not an image that can be read; the bytes of a PNG or JPEG file are needed."
        ) from error


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
