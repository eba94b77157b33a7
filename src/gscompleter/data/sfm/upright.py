"""Upright copies of photographs, of bounded size, for structure from motion.

COLMAP ignores the EXIF orientation, so the pixels themselves are rotated.
"""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from pathlib import Path

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
    path = root / source
    check_file(path)
    refuse_pointer(path)
    try:
        with Image.open(path, formats=IMAGE_FORMATS) as image:
            exif = image.getexif()
            # In COLMAP's lists a space ends a name, and # begins a comment.
            ending = "" if image.format in ("JPEG", "PNG") else ".png"
            name = re.sub(r"[\s#]", "_", source) + ending
            width, height = _write_copy(image, path, folder / name)
            focal = _compute_focal(exif, width, height)
            return UprightCopy(name, source, width, height, focal, _describe_lens(exif))
    except InputError:
        raise
    except Exception as error:  # damaged files raise anything
        raise InputError(
            f"{quote_value(path)} cannot be read as an image ({quote_value(str(error))}); copy it "
            "again, or take it out of the folder."
        ) from error


def _write_copy(image: Image.Image, source: Path, target: Path) -> tuple[int, int]:
    """Write the copy, and return its width and height; refuse a name that is taken."""
    if target.exists():
        raise InputError(
            f"The copy of {quote_value(source)} would be called {target.name} like that of another "
            "photograph; rename one of them."
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    plain = image.format in ("JPEG", "PNG") and image.mode in ("RGB", "L")
    upright = image.getexif().get(ORIENTATION, 1) == 1
    if plain and upright and max(image.size) <= MAX_SIDE:
        image.load()  # detects truncated files
        shutil.copyfile(source, target)
        return image.size
    # Decodes a JPEG at half or a quarter of its size if that is enough.
    image.draft("RGB", (MAX_SIDE, MAX_SIDE))
    copy = ImageOps.exif_transpose(image).convert("RGB")
    copy.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.LANCZOS)
    copy.info.clear()  # removes the orientation, which is applied already
    options = {"quality": QUALITY, "subsampling": 0} if image.format == "JPEG" else {}
    copy.save(target, format="JPEG" if image.format == "JPEG" else "PNG", **options)
    return copy.size


def _compute_focal(exif: Image.Exif, width: int, height: int) -> float | None:
    """Compute the focal length in pixels from the 35 mm equivalent; None if there is none."""
    try:
        millimetres = float(exif.get_ifd(EXIF)[FOCAL_LENGTH_35])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):  # broken values are common
        return None
    if not 1 <= millimetres <= 5000:
        return None
    return millimetres / FULL_FRAME_DIAGONAL * float(width**2 + height**2) ** 0.5


def _describe_lens(exif: Image.Exif) -> str:
    detail = exif.get_ifd(EXIF)
    values = [exif.get(MAKE), exif.get(MODEL)]
    values += [detail.get(FOCAL_LENGTH), detail.get(FOCAL_LENGTH_35)]
    return " ".join(str(value) for value in values if value is not None)
