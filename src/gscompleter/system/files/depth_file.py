"""Depth maps in image files and arrays: z-depth per pixel, in scene units, 0 where unknown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from gscompleter.system.damage import DamagedError, describe_damage
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.image import PNG_COMPRESSION
from gscompleter.system.files.image_opening import open_image
from gscompleter.system.files.reading import check_file
from gscompleter.system.files.writing import replace_file

MAX_IMAGE_PIXELS = 178_956_970
"""Largest number of pixels of an image, as in Pillow."""


def write_depth(path: Path | str, depth: Float[Tensor, "h w"], unit: float) -> None:
    """Write z-depth as a 16-bit PNG in multiples of `unit`, 0 where it is unknown.

    `read_depth` reads it back. Depths beyond 65535 units are clamped, and so are those below one,
    which are known.
    """
    steps = (depth.detach().cpu().double() / unit + 0.5).floor().clamp(1, 65535)
    values = steps.where(depth.detach().cpu() > 0, 0.0)
    with replace_file(path) as file:
        Image.fromarray(values.numpy().astype(np.uint16)).save(
            file, format="PNG", compress_level=PNG_COMPRESSION
        )


def read_depth(path: Path, unit: float) -> Float[np.ndarray, "h w"]:
    """Read z-depth from a 16-bit image or a `.npy` file, times `unit`; 0 where unknown.

    The image is a grey PNG, usually, or a TIFF or PGM; a TIFF may hold floating-point values.
    """
    if path.suffix.lower() == ".npy":
        values = _read_npy(path)
    else:
        with open_image(path) as image:
            values = _read_levels(image)
    values = values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values
    if values.ndim != 2 or values.dtype.kind not in "uif" or values.dtype == np.uint8:
        raise InputError(
            f"{quote_value(path)} is no depth map: a 16-bit grey PNG or an array [h, w] of numbers "
            f"is needed, and it holds {values.dtype} of shape {quote_value(list(values.shape))}."
        )
    with np.errstate(over="ignore", invalid="ignore"):
        depth = (values.astype(np.float64) * unit).astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _read_levels(image: Image.Image) -> np.ndarray:
    """Read the levels of a grey image as they are stored."""
    # Pillow spreads those of a PGM, from 0 to the largest that its header names, over 16 bits. They
    # are known until the image is loaded.
    spread = [tile[3] for tile in getattr(image, "tile", ()) if tile[0] in ("ppm", "ppm_plain")]
    values = np.array(image)
    if not spread or image.mode != "I":
        return values
    _, largest = spread[0]
    return np.rint(values * (largest / 65535))


def _read_npy(path: Path) -> np.ndarray:
    check_file(path)
    try:
        # A memory map cannot exceed the file, whatever size its header claims.
        values = np.lib.format.open_memmap(path, mode="r")
        if not 0 < values.size <= MAX_IMAGE_PIXELS:
            raise DamagedError(f"it claims {values.size:,} values")
    except Exception as error:  # damaged files raise any kind
        raise InputError(
            f"The depth map {quote_value(path)} cannot be read ({describe_damage(error)}); copy it "
            "again."
        ) from error
    return values
