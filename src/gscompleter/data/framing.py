"""How an image is brought to a resolution: resized to cover it, then cropped in its centre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Shaped
from PIL import Image

from gscompleter.data.lens import Pinhole
from gscompleter.data.limits import MAX_SIDE
from gscompleter.errors import InputError, quoted


@dataclass(frozen=True)
class Framing:
    """Resize to `resized`, then keep what begins at `corner` and is as large as `size`."""

    resized: tuple[int, int]
    corner: tuple[int, int]
    size: tuple[int, int]

    def camera(self, pinhole: Pinhole) -> Pinhole:
        """The camera of the framed image."""
        return pinhole.resized(*self.resized).cropped(*self.corner, *self.size)

    def image(
        self, image: Shaped[np.ndarray, "h w *c"], filtering: Image.Resampling
    ) -> Shaped[np.ndarray, "h2 w2 *c"]:
        """The framed image."""
        left, top = self.corner
        width, height = self.size
        resized = resize(image, self.resized, filtering)
        return np.ascontiguousarray(resized[top : top + height, left : left + width])


def covering(width: int, height: int, resolution: tuple[int, int] | None) -> Framing:
    """How an image is resized to cover `resolution` (height, width) and cropped in its centre.

    Raises:
        InputError: where the resolution is impossible, or a strip would become too long.
    """
    check_resolution(resolution)
    if resolution is None:
        return Framing((width, height), (0, 0), (width, height))
    scale = max(resolution[0] / height, resolution[1] / width)
    new_width = max(round(width * scale), resolution[1])
    new_height = max(round(height * scale), resolution[0])
    if max(new_width, new_height) > MAX_SIDE:
        raise InputError(
            f"An image of {width} × {height} pixels that covers {resolution[1]} × {resolution[0]} "
            f"has a side above {MAX_SIDE}; choose a smaller resolution, or crop the image."
        )
    corner = (new_width - resolution[1]) // 2, (new_height - resolution[0]) // 2
    return Framing((new_width, new_height), corner, (resolution[1], resolution[0]))


def resize(
    image: Shaped[np.ndarray, "h w *c"], size: tuple[int, int], filtering: Image.Resampling
) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """The image resized to `size` (width, height)."""
    if image.shape[1::-1] == size:
        return image
    return np.array(Image.fromarray(image).resize(size, filtering))


def check_resolution(resolution: tuple[int, int] | None) -> None:
    """Raise an InputError where a height or width is not within 1 to `MAX_SIDE`."""
    if resolution is not None and not all(1 <= side <= MAX_SIDE for side in resolution):
        raise InputError(
            f"The resolution {' × '.join(map(quoted, resolution))} is impossible; height and "
            f"width have to be positive, and at most {MAX_SIDE}."
        )
