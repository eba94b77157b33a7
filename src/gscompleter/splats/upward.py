"""Upward direction of a splat, as far as its file states it."""

from __future__ import annotations

import re
from pathlib import Path

from gscompleter.splats.formats import SPLAT_FORMATS, detect_splat_format
from gscompleter.system.files.ply import read_header
from gscompleter.system.files.reading import open_file

Direction = tuple[float, float, float]
USUAL: Direction = (0.0, -1.0, 0.0)
"""Up in most files: the cameras of photographs have y down."""

_AXIS_LINE = re.compile(
    rb"^(?:comment|obj_info)[ ]+vertical[ _-]?axis[ ]*[:=]?[ ]*([+-]?)([xyz])[ \t]*\r?$",
    re.I | re.M,
)
"""Comment of a .ply, such as `comment Vertical Axis: z` of nerfstudio."""


def read_upward(path: Path) -> Direction | None:
    """Read what is up in a file of Gaussians, in the axes of a 3DGS .ply; None if it does not say.

    A .ply may say it in a comment; some formats define it.
    """
    row = SPLAT_FORMATS[detect_splat_format(path)]
    if row.is_y_up:
        return USUAL
    if not row.has_ply_header:
        return None
    with open_file(path) as file:
        header, _ = read_header(file, path)
    stated = _AXIS_LINE.findall(header)
    if not stated:
        return None
    sign, axis = stated[-1]
    x, y, z = (
        (-1.0 if sign == b"-" else 1.0) * (axis.lower() == one) for one in (b"x", b"y", b"z")
    )
    return (x, y, z)
