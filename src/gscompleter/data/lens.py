"""Pinhole intrinsics, and lens distortion and its removal.

Pixels are ours throughout: the centre of the top-left one is (0.5, 0.5). OpenCV puts it at
(0, 0), which matters only where an image is handed to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

MAX_ZOOM_OUT = 0.5
"""Undistortion keeps at least this share of the resolution in the middle of the image."""
MAX_ZOOM_IN = 4.0


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics of a pinhole camera, in pixels and float64."""

    fl_x: float
    fl_y: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def K(self) -> Float[Tensor, "3 3"]:
        return torch.tensor(
            [[self.fl_x, 0, self.cx], [0, self.fl_y, self.cy], [0, 0, 1]], dtype=torch.float64
        ).float()

    def resized(self, width: int, height: int) -> Pinhole:
        """The camera of the image resized to width × height."""
        x, y = width / self.width, height / self.height
        return Pinhole(self.fl_x * x, self.fl_y * y, self.cx * x, self.cy * y, width, height)

    def cropped(self, left: int, top: int, width: int, height: int) -> Pinhole:
        """The camera of the part of the image that begins at pixel (left, top)."""
        return Pinhole(self.fl_x, self.fl_y, self.cx - left, self.cy - top, width, height)

    def zoomed(self, zoom: float) -> Pinhole:
        """The same image plane seen `zoom` times larger about the principal point."""
        return Pinhole(
            self.fl_x * zoom, self.fl_y * zoom, self.cx, self.cy, self.width, self.height
        )


@dataclass(frozen=True)
class Distortion:
    """Coefficients of OpenCV's lens models."""

    fisheye: bool = False
    """Angles are polynomials of the angle to the axis, rather than radii of the radius."""
    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1 to k4; the last one belongs to the fisheye model alone."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """p1 and p2; not for the fisheye model."""

    def __bool__(self) -> bool:
        """Whether a photograph needs undistorting."""
        return self.fisheye or any(self.radial) or any(self.tangential)


def distort(points: Float[np.ndarray, "*n 2"], distortion: Distortion) -> Float[np.ndarray, "*n 2"]:
    """Where the lens puts points of the image plane at z = 1."""
    x, y = points[..., 0], points[..., 1]
    k1, k2, k3, k4 = distortion.radial
    r2 = x * x + y * y
    if distortion.fisheye:
        r = np.sqrt(r2)
        angle = np.arctan(r)
        a2 = angle * angle
        bent = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        return points * np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)[..., None]
    p1, p2 = distortion.tangential
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


@lru_cache(maxsize=16)
def undistorted(pinhole: Pinhole, distortion: Distortion) -> Pinhole | None:
    """The pinhole camera of the undistorted photograph, of the same size.

    Its principal point is that of the lens, and it is zoomed so far that every pixel lies
    within the photograph and as little as possible is lost at the borders. A fisheye lens
    loses more, since the zoom stops at `MAX_ZOOM_OUT`. None where the coefficients fold the
    image over itself, so that no zoom serves.
    """
    if not distortion:
        return pinhole
    zoom, radius = None, np.zeros(())
    for candidate in np.geomspace(MAX_ZOOM_IN, MAX_ZOOM_OUT, 400):
        bent = distort(_border(pinhole.zoomed(float(candidate))), distortion)
        # Zooming out has to move every border point outwards: beyond the fold of a
        # polynomial, points come back into the photograph and show something else.
        if not _within(pinhole, bent) or (np.linalg.norm(bent, axis=-1) < radius).any():
            break
        zoom, radius = float(candidate), np.linalg.norm(bent, axis=-1)
    return None if zoom is None else pinhole.zoomed(zoom)


@lru_cache(maxsize=1)
def undistortion_map(
    pinhole: Pinhole, distortion: Distortion, new: Pinhole
) -> Float[np.ndarray, "h w 2"]:
    """For each pixel of the undistorted image, where the photograph shows it, for `remap`.

    The last one stays in memory, for the frames of one lens.
    """
    x, y = np.meshgrid(np.arange(new.width) + 0.5, np.arange(new.height) + 0.5)
    pixels = _pixels(pinhole, distort(_plane_points(new, x, y), distortion))
    return (pixels - 0.5).astype(np.float32)


def remap(
    image: Shaped[np.ndarray, "h w *c"], source: Float[np.ndarray, "h w 2"], interpolation: int
) -> Shaped[np.ndarray, "h w *c"]:
    """The image whose pixels are those of `image` at `source`."""
    x, y = np.ascontiguousarray(source[..., 0]), np.ascontiguousarray(source[..., 1])
    return np.asarray(cv2.remap(image, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE))


def _border(pinhole: Pinhole) -> Float[np.ndarray, "n 2"]:
    """The centres of the outermost pixels, on the image plane at z = 1."""
    x, y = np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5
    rows = [_plane_points(pinhole, x, np.full_like(x, edge)) for edge in (y[0], y[-1])]
    columns = [_plane_points(pinhole, np.full_like(y, edge), y) for edge in (x[0], x[-1])]
    return np.concatenate(rows + columns)


def _plane_points(
    pinhole: Pinhole, x: Float[np.ndarray, "*n"], y: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n 2"]:
    return np.stack([(x - pinhole.cx) / pinhole.fl_x, (y - pinhole.cy) / pinhole.fl_y], axis=-1)


def _pixels(pinhole: Pinhole, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    return points * [pinhole.fl_x, pinhole.fl_y] + [pinhole.cx, pinhole.cy]


def _within(pinhole: Pinhole, points: Float[np.ndarray, "*n 2"]) -> bool:
    """Whether all points fall on pixels of the photograph, up to a thousandth of a pixel."""
    x, y = np.moveaxis(_pixels(pinhole, points), -1, 0)
    return bool(
        (x.min() >= 0.499)
        and (x.max() <= pinhole.width - 0.499)
        and (y.min() >= 0.499)
        and (y.max() <= pinhole.height - 0.499)
    )
