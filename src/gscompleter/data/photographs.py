"""Posed photographs, independent of their format.

A format (one module each, listed in `formats.py`) reads cameras and locates images. This module
reads images on demand, removes lens distortion, and resizes image and intrinsics together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from numbers import Integral

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from PIL import Image
from torch import Tensor

from gscompleter.data.cameras import compute_fov, compute_undistortion_map, find_pose_defect, remap
from gscompleter.data.driving.vehicle import mask_moving
from gscompleter.data.frame import Frame
from gscompleter.data.limits import MAX_SIDE
from gscompleter.data.local_origin import choose_local_origin
from gscompleter.errors import InputError, quote_value
from gscompleter.geometry import compute_sparse_depth
from gscompleter.io.image import convert_to_image, read_pixels
from gscompleter.types import Camera, View

Resolution = tuple[int, int] | int | None
"""Target size of images.

Height and width in pixels: resize to cover, then crop the centre. One number: shrink to at most
this longer side. None: keep the size.
"""

MAX_FOV = 100.0
"""Largest field of view that benchmarks keep, in degrees."""
MAX_TRANSLATION = 1e3
"""Largest camera coordinate that benchmarks keep, in scene units from the origin."""

MAX_MAP_COORDINATE = 100.0
"""Largest vehicle coordinate without a local origin, in metres."""


@dataclass(frozen=True, eq=False)
class Photographs:
    """A named sequence of photographs with known cameras, numbered from 0."""

    name: str
    title: str
    """Name in error messages."""
    frames: tuple[Frame, ...]
    origin: Float[np.ndarray, "3"]
    """Origin of the cameras' coordinates, in those of the files (float64)."""
    near: float | None = None
    far: float | None = None
    """Range of the scene's z-depths, in scene units."""
    notes: tuple[str, ...] = ()
    """Sentences about choices made while opening."""
    format: str | None = None
    sparse: Callable[[], Float[np.ndarray, "n 3"]] | None = None
    """Reads points on the scene's surfaces, in the files' frame."""
    front: str | None = None
    """Name of the front camera of a vehicle with several cameras."""

    def __len__(self) -> int:
        return len(self.frames)

    def camera(self, frame: int, resolution: Resolution = None) -> Camera:
        """Return the camera of a frame, even without its photograph if the file gives the size."""
        found = self.frame(frame)
        return self._build_camera(found, found.size(), resolution)

    def views(self, frames: Sequence[int], resolution: Resolution = None) -> list[View]:
        """Load undistorted photographs with cameras, known depth and the detected vehicle."""
        return [self._load_view(number, resolution) for number in frames]

    def mask(self, frame: int, resolution: Resolution = None) -> Bool[Tensor, "h w"] | None:
        """Return True where the photograph's mask is black or a moving box lies, or None."""
        found = self.frame(frame)
        masks = []
        if found.mask is not None:
            shown = read_pixels(found.mask).max(axis=-1)
            masks.append(undistort_and_resize(found, shown, found.size(), resolution) == 0)
        if found.boxes is not None:
            masks.append(mask_moving(found.boxes(), self.camera(frame, resolution), self.origin))
        return torch.from_numpy(np.logical_or.reduce(masks)) if masks else None

    def points(self) -> Float[Tensor, "n 3"] | None:
        """Load points on the scene's surfaces relative to `origin`; None if unknown."""
        if self.sparse is None:
            return None
        return torch.from_numpy(self.sparse() - self.origin).float()

    def keep_ego_vehicle(self) -> Photographs:
        """Return a copy that keeps the vehicle that carries the camera in the scene."""
        return replace(self, frames=tuple(replace(f, vehicle=None) for f in self.frames))

    @property
    def has_masks(self) -> bool:
        """True if some frame has a mask or boxes."""
        return any(frame.mask is not None or frame.boxes is not None for frame in self.frames)

    def find_skip_reason(self) -> str | None:
        """Explain why benchmarks skip the photographs; None if they are kept."""
        for number, frame in enumerate(self.frames):
            reason = _find_skip_reason(frame, self.origin)
            if reason is not None:
                return f"frame {number}: {reason}"
        return None

    def frame(self, number: int) -> Frame:
        """Return the frame of that number."""
        is_whole = isinstance(number, Integral) and not isinstance(number, bool)
        if not is_whole or not 0 <= number < len(self):
            raise InputError(
                f"There is no frame {quote_value(number)} in {self.title}, whose frames are "
                f"numbered 0 to {len(self) - 1}; choose one of these."
            )
        return self.frames[number]

    def _build_camera(self, frame: Frame, size: tuple[int, int], resolution: Resolution) -> Camera:
        _, pinhole = frame.compute_pinholes(*size)
        framing = compute_framing(*size, resolution)
        final = pinhole.resize(*framing.scaled_size).crop(*framing.corner, *framing.size)
        c2w = frame.c2w.copy()
        c2w[:3, 3] -= self.origin  # before rounding to float32
        pose = torch.from_numpy(c2w).float()
        return Camera(pose, final.K, final.width, final.height, self.near, self.far)

    def _load_view(self, number: int, resolution: Resolution) -> View:
        frame = self.frame(number)
        pixels = frame.load_pixels()
        size = pixels.shape[1], pixels.shape[0]
        camera = self._build_camera(frame, size, resolution)
        image = convert_to_image(undistort_and_resize(frame, pixels, size, resolution))
        depth = ignored = None
        if frame.depth is not None:
            values = undistort_and_resize(frame, frame.depth(), size, resolution)
            depth = torch.from_numpy(values)
        elif frame.laser_points is not None:
            points = torch.from_numpy(frame.laser_points() - self.origin).float()
            depth = compute_sparse_depth(points, camera)
        vehicle = None if frame.vehicle is None else frame.vehicle()
        if vehicle is not None:
            mask = undistort_and_resize(frame, vehicle.astype(np.uint8), size, resolution) > 0
            ignored = torch.from_numpy(mask)
        return View(image, camera, number, depth, ignored)


def apply_masks(
    views: Sequence[View], photographs: Photographs, resolution: Resolution = None
) -> list[View]:
    """Mark masked pixels of views as ignored; refuses views without any other pixel."""
    found = []
    for view in views:
        assert view.frame is not None
        mask = photographs.mask(view.frame, resolution)
        if mask is None:
            found.append(view)
            continue
        if mask.all():
            raise InputError(
                f"All of frame {view.frame} of {photographs.name} is masked; choose another frame."
            )
        found.append(replace(view, ignore_mask=mask | ~view.valid_mask))
    return found


def build_photographs(
    name: str, title: str, frames: Sequence[Frame], front: str | None = None
) -> Photographs:
    """Build photographs, with a local origin if the cameras are far from zero."""
    valid = [frame.c2w for frame in frames if find_pose_defect(frame.c2w) is None]
    return Photographs(name, title, tuple(frames), choose_local_origin(valid), front=front)


def build_drive(
    name: str, title: str, frames: Sequence[Frame], front: str | None = None
) -> Photographs:
    """Build the photographs of a vehicle, with the first camera as origin if far from zero."""
    built = build_photographs(name, title, frames, front)
    valid = (frame.c2w[:3, 3] for frame in frames if find_pose_defect(frame.c2w) is None)
    first = next(valid, np.zeros(3))
    is_far = np.abs(first).max() > MAX_MAP_COORDINATE
    return replace(built, origin=first.copy() if is_far else np.zeros(3))


def undistort_and_resize(
    frame: Frame,
    pixels: Shaped[np.ndarray, "h w *c"],
    size: tuple[int, int],
    resolution: Resolution,
) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """Undistort and resize the photograph of a frame, or a map [h, w] of depth or mask values.

    Maps are resized to `size` (width, height) first. Colours (uint8, [h, w, 3]) are interpolated,
    values of maps never.
    """
    colours = pixels.ndim == 3
    if not colours:
        pixels = resize(pixels, size, Image.Resampling.NEAREST)
    if frame.intrinsics.distortion:
        pinhole, new = frame.compute_pinholes(*size)
        source = compute_undistortion_map(pinhole, frame.intrinsics.distortion, new)
        pixels = remap(pixels, source, cv2.INTER_CUBIC if colours else cv2.INTER_NEAREST)
    filtering = Image.Resampling.LANCZOS if colours else Image.Resampling.NEAREST
    framing = compute_framing(*size, resolution)
    (left, top), (width, height) = framing.corner, framing.size
    resized = resize(pixels, framing.scaled_size, filtering)
    return np.ascontiguousarray(resized[top : top + height, left : left + width])


def _find_skip_reason(frame: Frame, origin: Float[np.ndarray, "3"]) -> str | None:
    size = frame.intrinsics.size or frame.size()
    defect = frame.find_defect(*size)
    if defect is not None:
        return defect
    fov = compute_fov(frame.compute_pinholes(*size)[1])
    if fov > MAX_FOV:
        return f"its opening angle of {fov:.1f}° is above {MAX_FOV:g}°"
    farthest = float(np.abs(frame.c2w[:3, 3] - origin).max())
    too_far = f"its translation of {farthest:g} is above {MAX_TRANSLATION:g}"
    return too_far if farthest > MAX_TRANSLATION else None


@dataclass(frozen=True)
class Framing:
    """Resize to `scaled_size`, then crop `size` at `corner` (all x, y)."""

    scaled_size: tuple[int, int]
    corner: tuple[int, int]
    size: tuple[int, int]


def compute_framing(width: int, height: int, resolution: Resolution) -> Framing:
    """Compute the framing of a width × height image for a resolution."""
    check_resolution(resolution)
    if not isinstance(resolution, (tuple, list)):
        scale = 1.0 if resolution is None else min(1.0, resolution / max(width, height))
        size = max(round(width * scale), 1), max(round(height * scale), 1)
        return Framing(size, (0, 0), size)
    new_height, new_width = resolution
    scale = max(new_height / height, new_width / width)
    scaled = max(round(width * scale), new_width), max(round(height * scale), new_height)
    if max(scaled) > MAX_SIDE:
        raise InputError(
            f"An image of {width} × {height} pixels that covers {new_width} × {new_height} has a "
            f"side above {MAX_SIDE}; choose a smaller resolution, or crop the image."
        )
    corner = (scaled[0] - new_width) // 2, (scaled[1] - new_height) // 2
    return Framing(scaled, corner, (new_width, new_height))


def resize(
    image: Shaped[np.ndarray, "h w *c"], size: tuple[int, int], filtering: Image.Resampling
) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """Resize an image to `size` (width, height)."""
    if image.shape[1::-1] == size:
        return image
    return np.array(Image.fromarray(image).resize(size, filtering))


def _is_side(value: object) -> bool:
    is_whole = isinstance(value, Integral) and not isinstance(value, bool)
    return is_whole and 1 <= value <= MAX_SIDE  # type: ignore[operator]


def check_resolution(resolution: Resolution) -> None:
    """Raise an InputError if a side is not within 1 to `MAX_SIDE`."""
    if resolution is None:
        return
    sides: Sequence[object] = (resolution,)
    if isinstance(resolution, (tuple, list)) and len(resolution) == 2:
        sides = resolution
    if not all(_is_side(side) for side in sides):
        raise InputError(
            f"The resolution {' × '.join(map(quote_value, sides))} is impossible; height and "
            f"width have to be positive, and at most {MAX_SIDE}."
        )
