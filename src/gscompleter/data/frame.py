"""One camera of a scene, and where its photograph lies."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from gscompleter.data.intrinsics import FRACTIONS, Intrinsics, pinhole_defect
from gscompleter.data.lens import Pinhole, undistorted
from gscompleter.data.limits import MAX_SIDE
from gscompleter.data.moving_objects import Box
from gscompleter.data.poses import pose_defect
from gscompleter.errors import InputError, quoted
from gscompleter.io.image import decode_pixels, image_size, read_brightness, read_pixels

ENDINGS = ("", ".png", ".jpg", ".jpeg")
"""Of image files, for names without one."""

DOWNSCALED = (2, 4, 8)
"""By how much the copies of photographs are smaller that folders such as `images_4` hold."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One camera of a scene, with nothing of its photograph read.

    Raises:
        InputError: by its methods, where what they return is missing, damaged or impossible.
    """

    name: str
    title: str
    """What error messages call it, such as "frame 3 of room.json"."""
    c2w: Float[np.ndarray, "4 4"]
    """Camera-to-world in OpenCV axes and float64, as the file has it: see `defect`."""
    intrinsics: Intrinsics
    image: Path | Callable[[], bytes] | None
    """Where the photograph should lie, or how the bytes of its file are found."""
    depth: tuple[Path, float] | None = None
    """The file of its depth map, and what the values in it are multiplied by."""
    mask: Path | None = None
    """An image that is black where the photograph is to be ignored."""
    sensor: str | None = None
    """Which camera of a vehicle took it; None where there is one camera."""
    measured: Callable[[], Float[np.ndarray, "n 3"]] | None = None
    """Reads what lasers measured at about that time, in the frame of the poses."""
    boxes: Callable[[], tuple[Box, ...]] | None = None
    """Reads boxes around what stands or moves there at about that time, in that frame."""
    vehicle: Callable[[], Bool[np.ndarray, "h w"] | None] | None = None
    """Finds the vehicle that carries the camera, in a copy of the stored photograph of any size;
    None where it is not to be ignored."""

    def stored(self) -> Path | bytes | None:
        """The image file or its bytes; None where there is none."""
        if isinstance(self.image, Path):
            return find_image(self.image)
        return None if self.image is None else self.image()

    def has_photograph(self) -> bool:
        """Whether the photograph is there; what is stored within another file is not looked for."""
        if isinstance(self.image, Path):
            return find_image(self.image) is not None
        return self.image is not None

    def stored_size(self) -> tuple[int, int] | None:
        """Width and height of the photograph; None where there is none."""
        stored = self.stored()
        return None if stored is None else image_size(stored, capital(self.title))

    def size(self) -> tuple[int, int]:
        """Width and height of the photograph, or where there is none, what the file says.

        A photograph whose bytes have to be found first is not opened where the file says it.
        """
        told = None if self.intrinsics.size == FRACTIONS else self.intrinsics.size
        within = self.image is not None and not isinstance(self.image, Path)
        size = told if within and told is not None else self.stored_size() or told
        if size is None:
            raise InputError(
                f"The size of {self.title} is not known, because it has no image and no `w` and "
                "`h`; add these, or its image."
            )
        return size

    def needed(self) -> Path | bytes:
        """Return the image file or its bytes.

        Raises:
            InputError: where there is none.
        """
        stored = self.stored()
        if stored is None:
            place = "restore it" if self.image is None else f"put it at {quoted(self.image)}"
            raise InputError(
                f"The image of {self.title} is missing; {place}, or choose another frame."
            )
        return stored

    def pixels(self) -> UInt8[np.ndarray, "h w 3"]:
        """The photograph as it is stored."""
        stored = self.needed()
        if isinstance(stored, bytes):
            return decode_pixels(stored, capital(self.title))
        return read_pixels(stored)

    def small_pixels(self, side: int) -> Float[np.ndarray, "h w"]:
        """Read the brightness of the photograph, from 0 to 255, shrunk to at most `side` pixels on
        its longer side."""
        return read_brightness(self.needed(), side, capital(self.title))

    def defect(self, width: int, height: int) -> str | None:
        """What makes the camera of a photograph of that size impossible; None if nothing does."""
        if max(width, height) > MAX_SIDE:
            return f"its {width} × {height} pixels have a side above {MAX_SIDE}"
        if self.intrinsics.transposed(width, height):
            w, h = self.intrinsics.size or (width, height)
            return f"its image is {width} × {height} pixels and its `w` and `h` say {w} × {h}"
        pinhole = self.intrinsics.at(width, height)
        defect = pose_defect(self.c2w) or pinhole_defect(pinhole)
        if defect is None and undistorted(pinhole, self.intrinsics.distortion) is None:
            return "its distortion coefficients fold the image over itself"
        return defect

    def pinholes(self, width: int, height: int) -> tuple[Pinhole, Pinhole]:
        """The intrinsics of a photograph of that size, with its distortion and without."""
        defect = self.defect(width, height)
        if defect is not None:
            raise self.unusable(defect)
        pinhole = self.intrinsics.at(width, height)
        new = undistorted(pinhole, self.intrinsics.distortion)
        assert new is not None
        return pinhole, new

    def unusable(self, defect: str) -> InputError:
        """What is said of a frame with such a defect."""
        return InputError(
            f"{capital(self.title)} cannot be used, because {defect}; correct it, or leave "
            "the frame out."
        )


def find_image(path: Path) -> Path | None:
    """The image file at `path`, which may lack its ending; None where there is none.

    Where its folder `images` lacks it, the largest copy in `images_2`, `images_4` or `images_8`,
    as nerfstudio writes and DL3DV publishes them, takes its place.
    """
    folders = [path.parent]
    if path.parent.name == "images":
        folders += [path.parent.with_name(f"{path.parent.name}_{n}") for n in DOWNSCALED]
    candidates = [folder / (path.name + ending) for folder in folders for ending in ENDINGS]
    return next((candidate for candidate in candidates if os.path.isfile(candidate)), None)


def capital(text: str) -> str:
    """The text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]
