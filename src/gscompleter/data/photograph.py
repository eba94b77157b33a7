"""One photograph: a file, bytes in a container, or what stands for a photograph.

Whoever has a frame asks its photograph, which looks into its file once for each fact: the size,
what EXIF says, whether there is an alpha channel. Pixels are read each time, and never kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from gscompleter.system.files.image import (
    QUARTER_TURNS,
    has_alpha,
    leave_out_constant,
    read_colors_and_alpha,
    read_image_size,
    read_orientation,
    turn_upright,
)
from gscompleter.system.files.image_opening import open_image

FULL_FRAME_DIAGONAL = 43.2666
"""Diagonal of 36 x 24 mm, the reference of EXIF's "focal length in 35 mm film"."""

# Tags of EXIF.
MAKE = 0x010F
MODEL = 0x0110
EXIF = 0x8769
FOCAL_LENGTH = 0x920A
FOCAL_LENGTH_35 = 0xA405


@runtime_checkable
class Photograph(Protocol):
    """What a frame shows, whatever it is stored as."""

    def measure(self) -> tuple[int, int]:
        """Return width and height of the pixels as they are stored."""

    def read_orientation(self) -> int:
        """Return the EXIF orientation of the pixels; 1, which is upright, without one."""

    def read_pixels(
        self,
    ) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"] | None]:
        """Read the stored colours, as they are below the alpha, and the alpha or None."""


class Optics(NamedTuple):
    """What EXIF says of the lens of a photograph."""

    lens: str
    """Key of camera, lens and zoom; photographs of one size with the same one share intrinsics."""
    focal: float | None
    """Focal length in image diagonals, or None."""


@dataclass(frozen=True)
class StoredPhotograph:
    """Hold a photograph in a file of its own, or among others in a container.

    Its size, optics and pixels raise InputError where the file is damaged or gone. The orientation
    and `has_alpha` do not: they are then 1 and False, as reading the pixels reports the error.
    """

    source: Path | Callable[[], bytes]
    """An existing file, or a function that reads the bytes of one from its container."""
    title: str = ""
    """Name of bytes, for errors."""
    is_turned: bool = False
    """True to turn the pixels as EXIF asks when they are read, whatever their camera says: they
    then count as stored upright."""

    @property
    def path(self) -> Path | None:
        """File of its own, or None."""
        return self.source if isinstance(self.source, Path) else None

    @property
    def stored(self) -> Path | bytes:
        """The file, or its bytes, which are read each time."""
        return self.source if isinstance(self.source, Path) else self.source()

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height of the stored pixels."""
        return read_image_size(self.stored, self.title)

    @cached_property
    def orientation(self) -> int:
        """EXIF orientation; 1, which is upright, without one."""
        return read_orientation(self.stored)

    @cached_property
    def optics(self) -> Optics:
        """Camera, lens and focal length of EXIF."""
        with open_image(self.stored, self.title) as image:
            tags = image.getexif()
            return Optics(read_lens(tags), read_focal(tags))

    @cached_property
    def has_alpha(self) -> bool:
        """True if it is a file with an alpha channel; containers are not opened for that."""
        return self.path is not None and has_alpha(self.path)

    @property
    def upright_size(self) -> tuple[int, int]:
        """Width and height as EXIF turns it."""
        width, height = self.size
        return (height, width) if self.orientation in QUARTER_TURNS else (width, height)

    def measure(self) -> tuple[int, int]:
        """Return `size`, or `upright_size` if it is turned."""
        return self.upright_size if self.is_turned else self.size

    def read_orientation(self) -> int:
        """Return `orientation`, or 1 if it is turned."""
        return 1 if self.is_turned else self.orientation

    def read_pixels(
        self,
    ) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"] | None]:
        """Read colours and alpha; one that is the same everywhere tells nothing, and is None."""
        colors, alpha = read_colors_and_alpha(self.stored, self.title)
        alpha = None if alpha is None else leave_out_constant(alpha)
        if not self.is_turned:
            return colors, alpha
        upright = turn_upright(colors, self.orientation)
        return upright, None if alpha is None else turn_upright(alpha, self.orientation)


def read_lens(exif: Image.Exif) -> str:
    """Read the key of camera, lens and zoom, which share intrinsics at one size.

    All photographs without EXIF have the same key.
    """
    detail = exif.get_ifd(EXIF)
    values = (
        exif.get(MAKE),
        exif.get(MODEL),
        detail.get(FOCAL_LENGTH),
        detail.get(FOCAL_LENGTH_35),
    )
    return " ".join(str(value) for value in values)


def read_focal(exif: Image.Exif) -> float | None:
    """Read the focal length in image diagonals from the 35 mm equivalent; None if unknown."""
    try:
        millimetres = float(exif.get_ifd(EXIF)[FOCAL_LENGTH_35])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):  # broken values are common
        return None
    return millimetres / FULL_FRAME_DIAGONAL if 1 <= millimetres <= 5000 else None
