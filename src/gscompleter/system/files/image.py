"""Conversion between image files and tensors."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from PIL import Image, features
from torch import Tensor

from gscompleter.system.damage import DamagedError, describe_damage
from gscompleter.system.errors import InputError, quote_value, refuse_pointer
from gscompleter.system.files.mask_labels import refuse_labels
from gscompleter.system.files.reading import check_file, make_read_error, read_head
from gscompleter.system.files.writing import replace_file

IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM", "GIF", "JPEG2000")
"""Image formats that are read. Others in Pillow run programs or are no photographs."""
HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
AVIF_BRANDS = (b"avif", b"avis")
"""Brands in the first box of a file, by which HEIC of phones and AVIF are known. `mif1` and `msf1`
are the general container, which either may name first."""

SHOWN_JPEG_QUALITY = 85
"""JPEG quality of pictures to look at, in a page or a notebook."""
MAX_IMAGE_PIXELS = 178_956_970
"""Largest number of pixels of an image, as in Pillow."""

PNG_COMPRESSION = 3
"""zlib level of written PNGs: 6 % more bytes than level 6, in a third of its time."""

HEIC_TO_JPEG = "sips -s format jpeg *.HEIC --out jpeg"
"""Command of macOS that exports the photographs of a folder."""

ORIENTATION = 0x0112
"""EXIF tag of the orientation; 1 is upright."""
QUARTER_TURNS = (5, 6, 7, 8)
"""Orientations that swap width and height."""

HALF_OPAQUE = 128
"""Smallest alpha, of 255, of a pixel that counts as opaque."""
ALPHA_MODES = ("RGBA", "LA", "PA", "RGBa", "La")


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
    the alpha channel is the mask, whatever colours it has. A map of labels raises an InputError.
    `name` is for errors of bytes.
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


def read_depth(path: Path, unit: float) -> Float[np.ndarray, "h w"]:
    """Read z-depth from a 16-bit PNG or a `.npy` file, times `unit`; 0 where unknown."""
    if path.suffix == ".npy":
        values = _read_npy(path)
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


@contextmanager
def open_image(stored: Path | str | bytes, name: str = "") -> Iterator[Image.Image]:
    """Open an image file, or its bytes; any failure in the `with` block becomes an InputError.

    `name` stands for bytes in errors.
    """
    file = io.BytesIO(stored) if isinstance(stored, bytes) else Path(stored)
    shown = quote_value(name) if isinstance(file, io.BytesIO) else f"The image {quote_value(file)}"
    if isinstance(file, Path):
        check_file(file)
        refuse_pointer(file)
    head = stored[:64] if isinstance(stored, bytes) else read_head(Path(stored), 64)
    formats = _choose_formats(head, shown)
    # The usual formats; Pillow loads those of all plugins as soon as it misses one of them.
    Image.preinit()
    try:
        with Image.open(file, formats=formats) as image:
            yield image
    except PermissionError as error:
        raise make_read_error(Path(str(file)), error) from error
    except Exception as error:  # damaged files raise any kind
        raise InputError(
            f"{shown} is not an image that can be read ({quote_value(describe_damage(error), 120)})"
            "; copy it again."
        ) from error


def _choose_formats(head: bytes, shown: str) -> tuple[str, ...]:
    """Choose the formats to try by the first bytes; refuse HEIC and AVIF that cannot be decoded.

    Pillow reads AVIF where it was built with it, and HEIC with pillow-heif.
    """
    # The first box names a main brand, a version, and further brands.
    brands = [head[start : start + 4] for start in (8, *range(16, len(head), 4))]
    if head[4:8] != b"ftyp":
        return IMAGE_FORMATS
    if any(brand in AVIF_BRANDS for brand in brands):
        if features.check("avif"):
            return ("AVIF",)
        raise InputError(
            f"{shown} is AVIF, which this Pillow does not read; run pip install -U pillow, or "
            "export JPEG."
        )
    if any(brand in HEIF_BRANDS for brand in brands):
        if find_spec("pillow_heif") is None:
            raise InputError(
                f"{shown} is HEIC, which is read with pillow-heif; run pip install "
                f"'gscompleter[heic]', or export JPEG (on a Mac: {HEIC_TO_JPEG})."
            )
        import pillow_heif

        pillow_heif.register_heif_opener()
        return ("HEIF",)
    return IMAGE_FORMATS


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
    if image.mode == "RGB" and any(tile[3] == "RGB;16B" for tile in getattr(image, "tile", ())):
        # Pillow reads the upper 8 of 16 bits, and leaves the transparent colour as it is.
        image.info["transparency"] = tuple(value >> 8 for value in transparent)
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
