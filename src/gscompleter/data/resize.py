"""Resizing of images and cameras to a resolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Shaped
from PIL import Image

from gscompleter.data.limits import MAX_SIDE
from gscompleter.data.undistort import Pinhole
from gscompleter.errors import InputError, quote_value

Resolution = tuple[int, int] | int | None
"""Target size of images.

Height and width in pixels: resize to cover, then crop the centre. One number: shrink to at most
this longer side. None: keep the size.
"""


@dataclass(frozen=True)
class Framing:
    """Resize to `scaled_size`, then crop `size` at `corner` (all x, y)."""

    scaled_size: tuple[int, int]
    corner: tuple[int, int]
    size: tuple[int, int]

    def apply_to_camera(self, pinhole: Pinhole) -> Pinhole:
        """Return the camera of the framed image."""
        return pinhole.resize(*self.scaled_size).crop(*self.corner, *self.size)

    def apply_to_image(
        self, image: Shaped[np.ndarray, "h w *c"], filtering: Image.Resampling
    ) -> Shaped[np.ndarray, "h2 w2 *c"]:
        """Resize and crop an image."""
        left, top = self.corner
        width, height = self.size
        resized = resize(image, self.scaled_size, filtering)
        return np.ascontiguousarray(resized[top : top + height, left : left + width])


def compute_framing(width: int, height: int, resolution: Resolution) -> Framing:
    """Compute the framing of a width × height image for a resolution."""
    check_resolution(resolution)
    if resolution is None or isinstance(resolution, int):
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


def check_resolution(resolution: Resolution) -> None:
    """Raise an InputError if a side is not within 1 to `MAX_SIDE`."""
    sides = (resolution,) if isinstance(resolution, int) else resolution or ()
    if not all(1 <= side <= MAX_SIDE for side in sides):
        raise InputError(
            f"The resolution {' × '.join(map(quote_value, sides))} is impossible; height and "
            f"width have to be positive, and at most {MAX_SIDE}."
        )
