"""Conversion between image files and tensors: colours, alpha, brightness and masks.

Pixels are read as they are stored. Who wants them upright turns them (`turn_upright`), since poses
and intrinsics usually belong to the stored ones.
"""

from __future__ import annotations

import io
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from PIL import Image
from torch import Tensor

from gscompleter.system.damage import DamagedError
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.image_opening import open_image
from gscompleter.system.files.mask_labels import refuse_labels
from gscompleter.system.files.writing import replace_file

SHOWN_JPEG_QUALITY = 85
"""JPEG quality of pictures to look at, in a page or a notebook."""
PNG_COMPRESSION = 3
"""zlib level of written PNGs: 6 % more bytes than level 6, in a third of its time."""

ORIENTATION = 0x0112
"""EXIF tag of the orientation; 1 is upright."""
QUARTER_TURNS = (5, 6, 7, 8)
"""Orientations that swap width and height."""

HALF_OPAQUE = 128
"""Smallest alpha, of 255, of a pixel that counts as opaque."""
ALPHA_MODES = ("RGBA", "LA", "PA", "RGBa", "La")
"""Modes of Pillow with an alpha channel; small letters stand for multiplied colours."""
FEW_BIT_STEPS = {"L;2": 85, "L;4": 17}
"""Steps by which Pillow spreads grey of 2 and of 4 bits over 0 to 255, by its name for them."""


def read_image(path: Path | str) -> Float[Tensor, "h w 3"]:
    """Read an image in [0, 1]; transparent parts are composited over black."""
    return convert_to_image(read_pixels(path))


def write_image(
    path: Path | str, image: Float[Tensor, "h w 3"] | Float[Tensor, "h w"] | Bool[Tensor, "h w"]
) -> None:
    """Write colours, or a grey image or mask, as an 8-bit PNG."""
    write_pixels(path, convert_to_pixels(image))


def write_pixels(
    path: Path | str, pixels: UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"]
) -> None:
    """Write 8-bit colours or grey as a PNG."""
    with replace_file(path) as file:
        Image.fromarray(pixels).save(file, format="PNG", compress_level=PNG_COMPRESSION)


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


def read_orientation(stored: Path | bytes) -> int:
    """Read the EXIF orientation of a photograph; 1, which is upright, without one."""
    with suppress(InputError), open_image(stored) as image:
        orientation = image.getexif().get(ORIENTATION, 1)
        return orientation if orientation in range(1, 9) else 1
    return 1  # reading the photograph reports the error


def turn_upright(
    pixels: Shaped[np.ndarray, "h w *c"], orientation: int
) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """Turn and mirror stored pixels as their EXIF orientation asks."""
    if orientation in QUARTER_TURNS:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def has_alpha(path: Path) -> bool:
    """Return True if an image file has an alpha channel or a transparent colour."""
    with suppress(InputError), open_image(path) as image:
        return _has_alpha(image)
    return False  # reading the photograph reports the error


def read_colors_and_alpha(
    stored: Path | bytes, name: str = ""
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"] | None]:
    """Read the colours of an image as they are below its alpha, and the alpha if it has one."""
    with open_image(stored, name) as image:
        if not _has_alpha(image):
            return _read_over_black(image), None
        rgba = _read_rgba(image)
    return np.ascontiguousarray(rgba[..., :3]), rgba[..., 3]


def read_mask(stored: Path | bytes, name: str = "") -> Bool[np.ndarray, "h w"]:
    """Read a mask as True where it is black or transparent: below half of its largest value.

    So a mask of 0 and 1 means the same as one of 0 and 255, and soft or JPEG edges end halfway. A
    mask without any white is black everywhere. Of something that was cut out, over transparency,
    the alpha channel is the mask, whatever colours it has. An alpha channel that makes nothing
    transparent, or is the same everywhere, leaves the colours to decide. A map of labels raises an
    InputError. `name` is for errors of bytes.
    """
    with open_image(stored, name) as image:
        # 16 bits are not reduced to 8, where 1 would become 0.
        if image.mode == "F" or _has_wide_grey(image):
            values = np.array(image)[..., None]
            if not np.isfinite(values).all():
                raise DamagedError("it holds NaN or infinity")
            alpha = None
        elif _has_alpha(image):
            rgba = _read_rgba(image)
            values = rgba[..., :3]
            alpha = leave_out_constant(rgba[..., 3])
            # Editors leave specks of 254, where nothing was cut out.
            if alpha is not None and alpha.min() >= HALF_OPAQUE:
                alpha = None
        else:
            kind = "L" if image.mode in ("1", "L") else "RGB"
            values = np.array(image.convert(kind)).reshape(image.height, image.width, -1)
            alpha = None
    if alpha is not None:
        return alpha < HALF_OPAQUE
    refuse_labels(values, name if isinstance(stored, bytes) else quote_value(stored))
    levels = values.max(axis=-1).astype(np.float64)
    return ~(levels > levels.max() / 2)


def leave_out_constant(alpha: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"] | None:
    """Return an alpha channel, or None if it is the same everywhere and so marks no part."""
    return None if alpha.min() == alpha.max() else alpha


def read_pixels(stored: Path | str | bytes, name: str = "") -> UInt8[np.ndarray, "h w 3"]:
    """Read an image in 8-bit colours, over black; 16-bit images are reduced.

    Orientation tags are ignored, because poses and intrinsics belong to the stored pixels.
    """
    with open_image(stored, name) as image:
        return _read_over_black(image)


def read_brightness(stored: Path | bytes, side: int) -> Float[np.ndarray, "h w"]:
    """Read the brightness (0 to 255) of an image shrunk to a longer side of `side` pixels."""
    with open_image(stored) as image:
        scale = min(1.0, side / max(image.size))
        size = max(round(image.width * scale), 1), max(round(image.height * scale), 1)
        # A JPEG is decoded at a fraction of its size, which is much faster; others ignore it.
        image.draft("L", size)
        pixels = _read_over_black(image)
    grey = Image.fromarray(pixels).convert("L")
    return np.array(grey.resize(size, Image.Resampling.BOX), np.float32)


def _has_alpha(image: Image.Image) -> bool:
    return image.mode in ALPHA_MODES or "transparency" in image.info


def _has_wide_grey(image: Image.Image) -> bool:
    """Return True for grey of whole numbers of 16 bits, which old versions of Pillow widen."""
    return image.mode == "I" or image.mode.startswith("I;16")


def _read_over_black(image: Image.Image) -> UInt8[np.ndarray, "h w 3"]:
    if _has_alpha(image):
        rgba = _read_rgba(image)
        return composite_over_black(rgba[..., :3], rgba[..., 3])
    return np.array(reduce_to_rgb(image))


def _read_rgba(image: Image.Image) -> UInt8[np.ndarray, "h w 4"]:
    """Read colours of 8 bits and the alpha of an image that has one, or a transparent colour."""
    transparent = image.info.get("transparency", ())
    if _has_wide_grey(image):
        # Pillow would clip the grey, and compare it with the transparent one after that.
        alpha = np.where(np.array(image) == transparent, 0, 255).astype(np.uint8)
        return np.dstack([np.array(reduce_to_rgb(image)), alpha])
    # Pillow brings pixels of 2, 4 and 16 bits to 8, but leaves the transparent colour as stored.
    stored_modes = {tile[3] for tile in getattr(image, "tile", ()) if isinstance(tile[3], str)}
    if image.mode == "RGB" and "RGB;16B" in stored_modes:
        image.info["transparency"] = tuple(value >> 8 for value in transparent)
    for mode in stored_modes & FEW_BIT_STEPS.keys():
        image.info["transparency"] = transparent * FEW_BIT_STEPS[mode]
    return np.array(image.convert("RGBA"))


def reduce_to_rgb(image: Image.Image) -> Image.Image:
    """Reduce an opened image to 8-bit colours, as they are below its alpha.

    Pillow would clip grey of 16 bits to 255 instead of scaling it.
    """
    if image.mode == "F":
        # Inside of `open_image` it becomes the reason in an InputError.
        raise DamagedError("it holds floating-point values, not colours")
    if _has_wide_grey(image):
        # 65535 / 257 is 255.
        grey = np.array(image).astype(np.float64) / 257
        image = Image.fromarray((grey + 0.5).clip(0, 255).astype(np.uint8))
    return image.convert("RGB")


def composite_over_black(
    colors: UInt8[np.ndarray, "h w 3"], alpha: UInt8[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Composite colours over black."""
    weighted = colors.astype(np.uint16) * alpha[..., None]
    # Rounded to the nearest.
    return ((weighted + 127) // 255).astype(np.uint8)


def encode_jpeg(image: Image.Image, quality: int) -> bytes:
    """Encode an image as JPEG, with a quality from 1 to 95."""
    file = io.BytesIO()
    image.save(file, format="JPEG", quality=quality)
    return file.getvalue()
