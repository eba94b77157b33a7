"""Sequences of posed photographs, whatever format they lie in.

A clip reads nothing but cameras until some of its frames are asked for. What benchmarks leave
out (a lens too wide, a pose that is none) is a reason that the caller records, never a silent gap.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from gscompleter.data.framing import covering
from gscompleter.data.lens import Pinhole
from gscompleter.data.transforms import MAX_RIGID_ERROR, as_tensor
from gscompleter.errors import InputError
from gscompleter.io.image import as_image
from gscompleter.types import Camera, View

MAX_FOV = 100.0
"""Widest opening angle of a camera that benchmarks keep, in degrees."""
MAX_TRANSLATION = 1e3
"""Farthest a camera may be from the origin along an axis, in scene units."""


@runtime_checkable
class Clip(Protocol):
    """A named sequence of photographs with known cameras, numbered from 0."""

    @property
    def name(self) -> str:
        """What evaluation indices call it."""

    def __len__(self) -> int:
        """How many frames it has."""

    def views(self, frames: Sequence[int], resolution: tuple[int, int] | None = None) -> list[View]:
        """The photographs of `frames`, resized to cover `resolution` (height, width), cropped.

        Raises:
            InputError: where a frame does not exist or cannot be read.
        """

    def reason_to_skip(self, size: tuple[int, int] | None = None) -> str | None:
        """Why benchmarks leave the clip out; None where they keep it.

        Args:
            size: Height and width that every photograph must have before it is resized, for
                data sets of one size; any if left out.
        """


@dataclass(frozen=True)
class Skipped:
    """A clip that was left out."""

    name: str
    reason: str


def usable(
    clips: Iterable[Clip], skipped: list[Skipped], size: tuple[int, int] | None = None
) -> Iterator[Clip]:
    """The clips that benchmarks keep, one at a time; the others are appended to `skipped`.

    Args:
        clips: The clips of a data set.
        skipped: Where the clips that are left out are recorded.
        size: As in `Clip.reason_to_skip`.
    """
    for clip in clips:
        reason = clip.reason_to_skip(size)
        if reason is None:
            yield clip
        else:
            skipped.append(Skipped(clip.name, reason))


@dataclass(frozen=True)
class StoredCamera:
    """A camera as RealEstate10K has it: its intrinsics hold for an image of any size."""

    focal: tuple[float, float]
    """In widths and heights of the image."""
    center: tuple[float, float]
    """Principal point in widths and heights, (0.5, 0.5) in the middle."""
    viewmat: Float[np.ndarray, "4 4"]
    """World-to-camera transform in OpenCV axes."""

    @staticmethod
    def of_numbers(numbers: Float[np.ndarray, "18"]) -> StoredCamera:
        """From fx, fy, cx, cy, two that are unused, and the upper rows of the transform."""
        fx, fy, cx, cy = numbers[:4].tolist()
        viewmat = np.vstack([numbers[6:].reshape(3, 4), [0, 0, 0, 1]])
        return StoredCamera((fx, fy), (cx, cy), viewmat)

    @staticmethod
    def of_camera(camera: Camera) -> StoredCamera:
        """The same camera in that form."""
        w, h = camera.width, camera.height
        K = camera.K.double().tolist()
        viewmat = np.linalg.inv(camera.c2w.double().numpy())
        return StoredCamera((K[0][0] / w, K[1][1] / h), (K[0][2] / w, K[1][2] / h), viewmat)

    def pinhole(self, width: int, height: int) -> Pinhole:
        """The intrinsics of an image of that size."""
        (fx, fy), (cx, cy) = self.focal, self.center
        return Pinhole(fx * width, fy * height, cx * width, cy * height, width, height)

    @property
    def c2w(self) -> Float[np.ndarray, "4 4"]:
        """Camera-to-world, the inverse of `viewmat`."""
        return np.linalg.inv(self.viewmat)

    @property
    def fov(self) -> float:
        """The larger of its two opening angles, in degrees."""
        angles = [
            math.atan(center / focal) + math.atan((1 - center) / focal)
            for focal, center in zip(self.focal, self.center, strict=True)
        ]
        return math.degrees(max(angles))

    def defect(self) -> str | None:
        """What makes it no camera at all; None where it is one."""
        if not (np.isfinite([*self.focal, *self.center]).all() and np.isfinite(self.viewmat).all()):
            return "its camera holds NaN or infinity"
        if min(self.focal) <= 0:
            return f"its focal length {min(self.focal):g} is not positive"
        rotation = self.viewmat[:3, :3]
        determinant = float(np.linalg.det(rotation))
        if abs(determinant - 1) > MAX_RIGID_ERROR:
            return f"its rotation has the determinant {determinant:g} and not 1"
        if np.abs(rotation.T @ rotation - np.eye(3)).max() > MAX_RIGID_ERROR:
            return "its rotation is sheared"
        return None

    def oddity(self) -> str | None:
        """What makes benchmarks leave it out though it is a camera; None where they keep it."""
        if self.fov > MAX_FOV:
            return f"its opening angle of {self.fov:.1f}° is above {MAX_FOV:g}°"
        farthest = float(np.abs(self.c2w[:3, 3]).max())
        if farthest > MAX_TRANSLATION:
            return f"its translation of {farthest:g} is above {MAX_TRANSLATION:g}"
        return None


def cameras_to_skip(cameras: Sequence[StoredCamera]) -> str | None:
    """Why benchmarks leave out a clip with these cameras; None where they keep it."""
    for number, camera in enumerate(cameras):
        reason = camera.defect() or camera.oddity()
        if reason is not None:
            return f"frame {number}: {reason}"
    return None


def size_to_skip(number: int, found: tuple[int, int], needed: tuple[int, int]) -> str | None:
    """Why a photograph of `found` (width, height) is not `needed` (height, width); None if it is.

    The orders are those of image files and of resolutions.
    """
    if found == (needed[1], needed[0]):
        return None
    return f"frame {number}: its image is {found[1]} × {found[0]} and not {needed[0]} × {needed[1]}"


def view_of(
    pixels: UInt8[np.ndarray, "h w 3"],
    stored: StoredCamera,
    number: int,
    name: str,
    resolution: tuple[int, int] | None,
) -> View:
    """The view of a photograph at a resolution. `name` is what error messages call the frame.

    Raises:
        InputError: where the camera is none.
    """
    defect = stored.defect()
    if defect is not None:
        raise InputError(f"{name} cannot be used, because {defect}; choose another frame.")
    height, width = pixels.shape[:2]
    framing = covering(width, height, resolution)
    final = framing.camera(stored.pinhole(width, height))
    camera = Camera(as_tensor(stored.c2w), final.K, final.width, final.height)
    return View(as_image(framing.image(pixels, Image.Resampling.LANCZOS)), camera, number)


def check_frame(number: int, count: int, name: str) -> None:
    """Raise an InputError where a clip of `count` frames, called `name`, has no such frame."""
    if not 0 <= number < count:
        raise InputError(
            f"There is no frame {number} in {name}, whose frames are numbered 0 to {count - 1}; "
            "choose one of these."
        )
