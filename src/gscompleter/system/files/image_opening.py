"""Opening of image files in the formats that are read; every failure is one sentence."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from PIL import Image, features

from gscompleter.system.damage import describe_damage
from gscompleter.system.errors import MAX_PATH_LENGTH, InputError, quote_value, refuse_pointer
from gscompleter.system.files.reading import check_file, make_read_error, read_head

IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM", "GIF", "JPEG2000")
"""Image formats that are read. Others in Pillow run programs or are no photographs."""
HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
AVIF_BRANDS = (b"avif", b"avis")
"""Brands in the first box of a file, by which HEIC of phones and AVIF are known. `mif1` and `msf1`
are the general container, which either may name first."""

HEIC_TO_JPEG = "sips -s format jpeg *.HEIC --out jpeg"
"""Command of macOS that exports the photographs of a folder."""


@contextmanager
def open_image(stored: Path | str | bytes, name: str = "") -> Iterator[Image.Image]:
    """Open an image file, or its bytes; any failure in the `with` block becomes an InputError.

    `name` stands for bytes in errors.
    """
    file = io.BytesIO(stored) if isinstance(stored, bytes) else Path(stored)
    # A name may hold the path of a container.
    shown = quote_value(name, MAX_PATH_LENGTH)
    if isinstance(file, Path):
        shown = f"The image {quote_value(file)}"
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
