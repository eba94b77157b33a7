"""One photograph without a camera: its own frame, and the focal length of EXIF or of a phone."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.file_names import PHOTOGRAPH_ENDINGS
from gscompleter.data.frame import Frame
from gscompleter.data.limits import require
from gscompleter.data.panorama import has_panoramas
from gscompleter.data.photograph import FULL_FRAME_DIAGONAL, StoredPhotograph
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.data.sfm.poses import iterate_photographs
from gscompleter.system.errors import quote_value

PHONE_FOCAL = 26 / FULL_FRAME_DIAGONAL
"""Focal length if EXIF has none, in image diagonals: 26 mm in 35 mm film, a phone's camera."""


def find_photograph(path: Path) -> Path | None:
    """Return an image file, or the only photograph of a folder; None for anything else."""
    if os.path.isfile(path):
        return path if path.suffix.lower() in PHOTOGRAPH_ENDINGS else None
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
    photograph = StoredPhotograph(file)
    size = photograph.upright_size
    exif_focal = photograph.optics.focal
    title = quote_value(file)
    focal = (exif_focal or PHONE_FOCAL) * math.hypot(*size)
    frame = Frame(file.name, title, np.eye(4), Intrinsics(size, (focal, focal)), photograph)
    # The camera is that of the upright photograph. Its width and height tell the frame of most
    # quarter turns; of half a turn, a mirror or a square they do not.
    if frame.find_turn() != photograph.orientation:
        frame = replace(frame, image=replace(photograph, is_turned=True))
    origin = "of EXIF" if exif_focal else "of a phone, since EXIF has none"
    note = f"The photograph has no camera; a focal length of {focal:.0f} px is used, {origin}."
    yield replace(build_photographs(file.stem, title, [frame]), notes=(note,))
