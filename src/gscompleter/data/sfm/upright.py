"""Upright copies of photographs, of bounded size, for structure from motion.

COLMAP ignores the EXIF orientation, so the pixels themselves are rotated.
"""

from __future__ import annotations

import math
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, ImageOps

from gscompleter.errors import InputError, quote_value
from gscompleter.io.image import ORIENTATION, open_image

MAX_SIDE = 1600
"""Longest side of a copy in pixels; SIFT finds no better features in larger ones."""
QUALITY = 95
"""JPEG quality of rotated or shrunk copies."""
FULL_FRAME_DIAGONAL = 43.2666
"""Diagonal of 36 x 24 mm, the reference of EXIF's "focal length in 35 mm film"."""
MAKE, MODEL = 0x010F, 0x0110
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
    with open_image(path) as image:
        exif, kind = image.getexif(), image.format
        is_known = kind in ("JPEG", "PNG")
        is_upright = exif.get(ORIENTATION, 1) == 1 and max(image.size) <= MAX_SIDE
        is_ready = is_known and is_upright and image.mode in ("RGB", "L")
        if not is_ready:  # decodes a JPEG at half or a quarter of its size if that is enough
            image.draft("RGB", (MAX_SIDE, MAX_SIDE))
        copy = ImageOps.exif_transpose(image).convert("RGB")
        focal, lens = _read_focal(exif), _describe_lens(exif)
    copy.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.LANCZOS)
    # In COLMAP's lists a space ends a name, and # begins a comment.
    name = re.sub(r"[\s#]", "_", source) + ("" if is_known else ".png")
    target = _prepare_target(folder / name, path)
    if is_ready:
        shutil.copyfile(path, target)
    else:
        _save(copy, target, "JPEG" if kind == "JPEG" else "PNG")
    diagonal = math.hypot(*copy.size)
    return UprightCopy(name, source, *copy.size, focal and focal * diagonal, lens)


def _prepare_target(target: Path, source: Path) -> Path:
    """Make the folder of a copy; refuse a name that is taken."""
    if target.exists():
        raise InputError(
            f"The copy of {quote_value(source)} would be called {target.name} like that of another "
            "photograph; rename one of them."
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    return target


def _save(image: Image.Image, target: Path, kind: str) -> None:
    image.info.clear()  # removes the orientation, which is applied already
    options = {"quality": QUALITY, "subsampling": 0} if kind == "JPEG" else {}
    image.save(target, format=kind, **options)


def _read_focal(exif: Image.Exif) -> float | None:
    """Read the focal length in image diagonals from the 35 mm equivalent; None if there is none."""
    try:
        millimetres = float(exif.get_ifd(EXIF)[FOCAL_LENGTH_35])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):  # broken values are common
        return None
    return millimetres / FULL_FRAME_DIAGONAL if 1 <= millimetres <= 5000 else None


def _describe_lens(exif: Image.Exif) -> str:
    detail = exif.get_ifd(EXIF)
    values = [exif.get(MAKE), exif.get(MODEL)]
    values += [detail.get(FOCAL_LENGTH), detail.get(FOCAL_LENGTH_35)]
    return " ".join(map(str, values))
