"""Upright copies of photographs, of bounded size, for structure from motion.

COLMAP ignores the EXIF orientation, so the pixels themselves are rotated.
"""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image, ImageOps

from gscompleter.errors import InputError, quote_value, refuse_pointer
from gscompleter.io.image import IMAGE_FORMATS
from gscompleter.io.reading import check_file

MAX_SIDE = 1600
"""Longest side of a copy in pixels; SIFT finds no better features in larger ones."""
QUALITY = 95
"""JPEG quality of rotated or shrunk copies."""
FULL_FRAME_DIAGONAL = 43.2666
"""Diagonal of 36 x 24 mm, the reference of EXIF's "focal length in 35 mm film"."""
ORIENTATION, MAKE, MODEL = 0x0112, 0x010F, 0x0110
EXIF, FOCAL_LENGTH, FOCAL_LENGTH_35 = 0x8769, 0x920A, 0xA405


@dataclass(frozen=True)
class UprightCopy:
    """An upright copy of a photograph, and known data of its camera."""

    name: str
    """File, relative to the folder of copies."""
    source: str
    """Source file, relative to the folder of photographs."""
    width: int
    height: int
    focal: float | None
    """Focal length in pixels of the copy from EXIF, or None."""
    lens: str
    """Key of camera, lens and zoom from EXIF."""


def write_upright(root: Path, source: str, folder: Path) -> UprightCopy:
    """Write an upright copy of the photograph `root`/`source` to the same place in `folder`.

    A small upright 8-bit JPEG or PNG is copied byte for byte; a format that COLMAP may not read
    becomes a PNG.
    """
    check_file(root / source)
    refuse_pointer(root / source)
    try:
        with Image.open(root / source, formats=IMAGE_FORMATS) as image:
            exif = image.getexif()
            name = _name_copy(source, image.format)
            target = _reserve_path(folder / name, root / source)
            width, height = _write_copy(image, exif, root / source, target)
            return UprightCopy(
                name,
                source,
                width,
                height,
                _compute_focal(exif, width, height),
                _describe_lens(exif),
            )
    except InputError:
        raise
    # Damaged files raise anything.
    except Exception as error:
        raise InputError(
            f"{quote_value(root / source)} cannot be read as an image "
            f"({quote_value(str(error))}); copy it "
            "again, or take it out of the folder."
        ) from error


def _name_copy(source: str, format: str | None) -> str:
    """Name the copy; in COLMAP's lists a space ends a name, and # begins a comment."""
    return re.sub(r"[\s#]", "_", source) + ("" if format in ("JPEG", "PNG") else ".png")


def _reserve_path(target: Path, source: Path) -> Path:
    """Create the folder of the copy; refuse a name that is taken."""
    if target.exists():
        raise InputError(
            f"The copy of {quote_value(source)} would be called {target.name} like that of another "
            "photograph; rename one of them."
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    return target


def _write_copy(
    image: Image.Image, exif: Image.Exif, source: Path, target: Path
) -> tuple[int, int]:
    plain = image.format in ("JPEG", "PNG") and image.mode in ("RGB", "L")
    upright = exif.get(ORIENTATION, 1) == 1
    if plain and upright and max(image.size) <= MAX_SIDE:
        image.load()  # detects truncated files
        shutil.copyfile(source, target)
        return image.size
    # Decodes a JPEG at half or a quarter of its size if that is enough.
    image.draft("RGB", (MAX_SIDE, MAX_SIDE))
    copy = ImageOps.exif_transpose(image).convert("RGB")
    copy.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.LANCZOS)
    copy.info.clear()  # removes the orientation, which is applied already
    if image.format == "JPEG":
        copy.save(target, format="JPEG", quality=QUALITY, subsampling=0)
    else:
        copy.save(target, format="PNG")
    return copy.size


def _compute_focal(exif: Image.Exif, width: int, height: int) -> float | None:
    """Compute the focal length in pixels from the 35 mm equivalent; None if there is none."""
    millimetres = _parse_number(exif.get_ifd(EXIF).get(FOCAL_LENGTH_35))
    if millimetres is None or not 1 <= millimetres <= 5000:
        return None
    return millimetres / FULL_FRAME_DIAGONAL * float(width**2 + height**2) ** 0.5


def _describe_lens(exif: Image.Exif) -> str:
    detail = exif.get_ifd(EXIF)
    values = (
        exif.get(MAKE),
        exif.get(MODEL),
        detail.get(FOCAL_LENGTH),
        detail.get(FOCAL_LENGTH_35),
    )
    return " ".join(str(value) for value in values if value is not None)


def _parse_number(value: Any) -> float | None:
    """Convert an EXIF value; broken ones are common and give None."""
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
