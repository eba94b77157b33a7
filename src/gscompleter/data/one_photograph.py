"""One photograph without a camera: its own frame, and the focal length of EXIF or of a phone."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from io import BytesIO
from itertools import islice
from pathlib import Path

import numpy as np
from PIL import ImageOps

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.frame import Frame
from gscompleter.data.limits import require
from gscompleter.data.panorama import has_panoramas
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.data.sfm.poses import (
    ENDINGS,
    FULL_FRAME_DIAGONAL,
    iterate_photographs,
    read_focal,
)
from gscompleter.system.errors import quote_value
from gscompleter.system.files.image import ORIENTATION, open_image

PHONE_FOCAL = 26 / FULL_FRAME_DIAGONAL
"""Focal length if EXIF has none, in image diagonals: 26 mm in 35 mm film, a phone's camera."""


def find_photograph(path: Path) -> Path | None:
    """Return an image file, or the only photograph of a folder; None for anything else."""
    if os.path.isfile(path):
        return path if path.suffix.lower() in ENDINGS else None
    # Two are enough to know that there are several.
    photographs = list(islice(iterate_photographs(path), 2))
    return photographs[0] if len(photographs) == 1 else None


def open_photograph(path: Path) -> Iterator[Photographs]:
    """Open one photograph, upright, at the origin; x is right, y down, z forward."""
    file = find_photograph(path)
    assert file is not None
    require(
        not has_panoramas([file]),
        f"There is a single panorama in {quote_value(path)}, which shows no depth; name a folder "
        "with another one, taken a step away.",
    )
    with open_image(file) as image:
        exif = image.getexif()
        size = ImageOps.exif_transpose(image).size
    exif_focal = read_focal(exif)
    title = quote_value(file)
    focal = (exif_focal or PHONE_FOCAL) * math.hypot(*size)
    # The camera is that of the upright photograph, so the pixels are turned once and for all.
    is_upright = exif.get(ORIENTATION, 1) == 1
    stored: Path | Callable[[], bytes] = file if is_upright else partial(read_upright, file)
    frame = Frame(file.name, title, np.eye(4), Intrinsics(size, (focal, focal)), stored)
    origin = "of EXIF" if exif_focal else "of a phone, since EXIF has none"
    note = f"The photograph has no camera; a focal length of {focal:.0f} px is used, {origin}."
    yield replace(build_photographs(file.stem, title, [frame]), notes=(note,))


def read_upright(path: Path) -> bytes:
    """Read a photograph that EXIF turns, as an upright PNG."""
    upright = BytesIO()
    with open_image(path) as image:
        ImageOps.exif_transpose(image).convert("RGB").save(upright, "PNG")
    return upright.getvalue()
