"""Photographs as structure from motion can take them: upright, of a bounded size, in plain colours.

COLMAP ignores the orientation that a camera writes into EXIF, so the pixels themselves are turned.
"""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image, ImageOps

from gscompleter.errors import InputError, quoted, refuse_pointer
from gscompleter.io.image import FORMATS
from gscompleter.reading import check_file

MAX_SIDE = 1600
"""Longer side of a copy in pixels. SIFT finds no better places for features in larger ones."""
QUALITY = 95
"""Of the JPEG files that are written where a photograph is turned or made smaller."""
FULL_FRAME = 43.2666
"""Diagonal of 36 x 24 mm, which EXIF refers the "focal length in 35 mm film" to."""
ORIENTATION, MAKE, MODEL = 0x0112, 0x010F, 0x0110
EXIF, FOCAL_LENGTH, FOCAL_LENGTH_35 = 0x8769, 0x920A, 0xA405


@dataclass(frozen=True)
class Upright:
    """A copy that is upright, and what is known of the camera that took it."""

    name: str
    """Its file, relative to the folder of copies."""
    source: str
    """The file it was made from, relative to the folder of photographs."""
    width: int
    height: int
    focal: float | None
    """Focal length in pixels of the copy, where EXIF tells it."""
    lens: str
    """The same for photographs that one camera took with one lens at one zoom, as far as EXIF
    tells them apart."""


def write_upright(root: Path, source: str, folder: Path) -> Upright:
    """Write the copy of the photograph `source` below `root` to the same place below `folder`.

    A JPEG or PNG in 8-bit colours or grey that is upright and small is copied byte for byte; a
    format that COLMAP may not read becomes a PNG.

    Raises:
        InputError: where it is damaged or no image, or another copy has its name.
    """
    check_file(root / source)
    refuse_pointer(root / source)
    try:
        with Image.open(root / source, formats=FORMATS) as image:
            exif = image.getexif()
            name = _name(source, image.format)
            target = _free(folder / name, root / source)
            width, height = _write(image, exif, root / source, target)
            return Upright(name, source, width, height, _focal(exif, width, height), _lens(exif))
    except InputError:
        raise
    # A damaged file can fail in any way.
    except Exception as error:
        raise InputError(
            f"{quoted(root / source)} is no image that can be read ({quoted(str(error))}); copy it "
            "again, or take it out of the folder."
        ) from error


def _name(source: str, format: str | None) -> str:
    """What the copy is called. In COLMAP's lists a space ends a name, and # begins a comment."""
    return re.sub(r"[\s#]", "_", source) + ("" if format in ("JPEG", "PNG") else ".png")


def _free(target: Path, source: Path) -> Path:
    """Where to write the copy of `source`; no other one is there."""
    if target.exists():
        raise InputError(
            f"The copy of {quoted(source)} would be called {target.name} like that of another "
            "photograph; rename one of them."
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    return target


def _write(image: Image.Image, exif: Image.Exif, source: Path, target: Path) -> tuple[int, int]:
    """Write the copy; returns its width and height in pixels."""
    plain = image.format in ("JPEG", "PNG") and image.mode in ("RGB", "L")
    upright = exif.get(ORIENTATION, 1) == 1
    if plain and upright and max(image.size) <= MAX_SIDE:
        image.load()  # a truncated file is found out here
        shutil.copyfile(source, target)
        return image.size
    # A JPEG is decoded at half or a quarter of its size where that is enough.
    image.draft("RGB", (MAX_SIDE, MAX_SIDE))
    copy = ImageOps.exif_transpose(image).convert("RGB")
    copy.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.LANCZOS)
    copy.info.clear()  # no orientation stays behind that a reader could obey once more
    if image.format == "JPEG":
        copy.save(target, format="JPEG", quality=QUALITY, subsampling=0)
    else:
        copy.save(target, format="PNG")
    return copy.size


def _focal(exif: Image.Exif, width: int, height: int) -> float | None:
    """Focal length in pixels from its equivalent in 35 mm film; None where there is none."""
    millimetres = _number(exif.get_ifd(EXIF).get(FOCAL_LENGTH_35))
    if millimetres is None or not 1 <= millimetres <= 5000:
        return None
    return millimetres / FULL_FRAME * float(width**2 + height**2) ** 0.5


def _lens(exif: Image.Exif) -> str:
    detail = exif.get_ifd(EXIF)
    told = (exif.get(MAKE), exif.get(MODEL), detail.get(FOCAL_LENGTH), detail.get(FOCAL_LENGTH_35))
    return " ".join(str(value) for value in told if value is not None)


def _number(value: Any) -> float | None:
    """A value of EXIF as a number; broken ones are common, and count as none."""
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
