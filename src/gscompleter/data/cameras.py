"""Cameras: intrinsics, lens distortion, undistortion and the validation of poses.

Pixel coordinates put the centre of the top-left pixel at (0.5, 0.5). OpenCV puts it at (0, 0),
which matters only when an image is passed to it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from gscompleter.types import FOCAL_RANGE, MAX_CENTER, MAX_COORDINATE, MAX_RIGID_ERROR

MAX_ZOOM_OUT = 0.5
"""Smallest share of the central resolution that undistortion keeps."""
MAX_ZOOM_IN = 4.0
"""Largest factor on the central resolution from which undistortion begins to zoom out."""
FRACTIONS = (1, 1)
"""`Intrinsics.size` of values in image widths and heights."""

PANORAMA_MODEL = "EQUIRECTANGULAR"
"""Name of the camera model of panoramas, for COLMAP and for nerfstudio."""
PANORAMA_ADVICE = (
    "split the panoramas into perspective images with cameras, or name the folder of the panoramas "
    "alone, and cameras are found anew"
)
"""Advice on that model: no program undistorts a panorama into one image."""

FLOAT_NOISE = 1e-6
"""Largest deviation from a rotation that is kept as it is."""
SAME_ASPECT = 0.02
"""Relative difference of aspect ratios that rounding of sizes explains."""

Poses = Float[np.ndarray, "n 4 4"]
"""Camera-to-world matrices."""


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
        """Intrinsic matrix in pixels, float32."""
        rows = [[self.fl_x, 0, self.cx], [0, self.fl_y, self.cy], [0, 0, 1]]
        return torch.tensor(rows, dtype=torch.float64).float()

    def resize(self, width: int, height: int) -> Pinhole:
        """Return the camera of the image resized to width × height."""
        x = width / self.width
        y = height / self.height
        return Pinhole(self.fl_x * x, self.fl_y * y, self.cx * x, self.cy * y, width, height)

    def crop(self, left: int, top: int, width: int, height: int) -> Pinhole:
        """Return the camera of the crop that begins at pixel (left, top)."""
        return Pinhole(self.fl_x, self.fl_y, self.cx - left, self.cy - top, width, height)


Projection = Literal["perspective", "equidistant", "field-of-view", "division", "unified"]
"""Maps from directions to the image plane, before any polynomial (see `_compute_radius`)."""


@dataclass(frozen=True)
class Distortion:
    """Lens distortion of points of the image plane at z = 1: a projection, then polynomials.

    The polynomials are OpenCV's; with the equidistant projection they are its fisheye model.
    """

    projection: Projection = "perspective"
    shape: tuple[float, ...] = ()
    """Parameters of the projection: the angle ω, k, or α and β."""
    radial: tuple[float, ...] = ()
    """Coefficients k1, k2, … of even powers of the radius, from the second on."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """Coefficients p1 and p2."""
    denominator: tuple[float, ...] = ()
    """Coefficients k4, k5 and k6 of OpenCV's rational model, which divide the radial polynomial."""
    prism: tuple[float, float] = (0.0, 0.0)
    """Thin-prism coefficients s1 and s3, which multiply r² in x and y."""

    def __bool__(self) -> bool:
        """Return True if a photograph needs undistortion."""
        polynomials = (*self.radial, *self.tangential, *self.denominator, *self.prism)
        return self.projection != "perspective" or any(polynomials)


def distort(points: Float[np.ndarray, "*n 2"], distortion: Distortion) -> Float[np.ndarray, "*n 2"]:
    """Distort points of the image plane at z = 1; NaN outside the field of the lens."""
    # Far outside the photograph, polynomials overflow and the division has no solution.
    with np.errstate(all="ignore"):
        if distortion.projection != "perspective":
            # The factor below divides by r, which is 0 at the centre of the image.
            r = np.maximum(np.linalg.norm(points, axis=-1), 1e-6)
            points = points * (_compute_radius(r, distortion) / r)[..., None]
        return _apply_polynomials(points, distortion)


def _compute_radius(r: Float[np.ndarray, "*n"], distortion: Distortion) -> Float[np.ndarray, "*n"]:
    """Project a radius at z = 1; the division model gives the ρ with ρ / (1 + k ρ²) = r."""
    if distortion.projection == "equidistant":
        return np.arctan(r)
    if distortion.projection == "field-of-view":
        # The "FOV" model of Devernay and Faugeras (2001).
        (omega,) = distortion.shape
        # The limit for small angles, which bends nothing.
        if omega == 0:
            return r
        return np.arctan(2 * r * np.tan(omega / 2)) / omega
    if distortion.projection == "division":
        # The smaller root of the quadratic equation, in the form that is stable for small k.
        (k,) = distortion.shape
        return 2 * r / (1 + np.sqrt(1 - 4 * k * r * r))
    # The enhanced unified camera model (EUCM; Khomutenko et al., 2016).
    alpha, beta = distortion.shape
    return r / (alpha * np.sqrt(beta * r * r + 1) + 1 - alpha)


def _apply_polynomials(
    points: Float[np.ndarray, "*n 2"], distortion: Distortion
) -> Float[np.ndarray, "*n 2"]:
    x = points[..., 0]
    y = points[..., 1]
    r2 = x * x + y * y
    # Both are 1 + k1 r² + k2 r⁴ + …
    numerator = np.polynomial.polynomial.polyval(r2, (1.0, *distortion.radial))
    denominator = np.polynomial.polynomial.polyval(r2, (1.0, *distortion.denominator))
    radial = numerator / denominator
    p1, p2 = distortion.tangential
    s1, s3 = distortion.prism
    new_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2
    new_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2
    return np.stack([new_x, new_y], axis=-1)


@lru_cache(maxsize=16)
def undistort_pinhole(pinhole: Pinhole, distortion: Distortion) -> Pinhole | None:
    """Compute the pinhole camera of the undistorted photograph, of the same size.

    It keeps the principal point and zooms until every pixel lies in the photograph and the borders
    lose as little as possible. Fisheye lenses lose more, since the zoom stops at `MAX_ZOOM_OUT`.
    Returns None if no zoom works, for the reasons of `find_distortion_defect`.
    """
    if not distortion:
        return pinhole
    widest = None
    radius = np.zeros(())
    size = np.array([pinhole.width, pinhole.height])
    # From the narrowest view outwards: the last zoom that works loses least of the borders.
    for zoom in np.geomspace(MAX_ZOOM_IN, MAX_ZOOM_OUT, 400).tolist():
        new = replace(pinhole, fl_x=pinhole.fl_x * zoom, fl_y=pinhole.fl_y * zoom)
        bent = distort(_compute_border(new), distortion)
        # Zooming out must move every border point outwards: beyond the fold of a polynomial,
        # points return into the photograph and show something else.
        pixels = _to_pixels(pinhole, bent)
        # Border pixels have their centres half a pixel inside, but for rounding.
        is_within = ((pixels >= 0.499) & (pixels <= size - 0.499)).all()
        if not is_within or (np.linalg.norm(bent, axis=-1) < radius).any():
            break
        widest = new
        radius = np.linalg.norm(bent, axis=-1)
    return widest


@lru_cache(maxsize=1)
def compute_undistortion_map(
    pinhole: Pinhole, distortion: Distortion, new: Pinhole
) -> Float[np.ndarray, "h w 2"]:
    """Compute the photograph position of each undistorted pixel, for `remap`."""
    plane = _compute_plane(new, np.arange(new.width), np.arange(new.height))
    pixels = _to_pixels(pinhole, distort(plane, distortion))
    # OpenCV's `remap` counts from the centre of the first pixel. Of `undistort_pinhole` all pixels
    # of `new` lie in the photograph; a position that is not finite would take the first pixel.
    finite = np.nan_to_num(pixels - 0.5, nan=-1.0, posinf=-1.0, neginf=-1.0)
    with np.errstate(over="ignore"):
        return finite.astype(np.float32)


def remap(
    image: Shaped[np.ndarray, "h w *c"], source: Float[np.ndarray, "h2 w2 2"], interpolation: int
) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """Sample `image` at the positions `source`."""
    x = np.ascontiguousarray(source[..., 0])
    y = np.ascontiguousarray(source[..., 1])
    return np.asarray(cv2.remap(image, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE))


def _compute_border(pinhole: Pinhole) -> Float[np.ndarray, "n 2"]:
    """Compute the outermost pixel centres on the image plane at z = 1."""
    columns = np.arange(pinhole.width)
    rows = np.arange(pinhole.height)
    edges = (columns, rows[[0, -1]]), (columns[[0, -1]], rows)
    return np.concatenate([_compute_plane(pinhole, *edge).reshape(-1, 2) for edge in edges])


def _compute_plane(
    pinhole: Pinhole, columns: Int[np.ndarray, "w"], rows: Int[np.ndarray, "h"]
) -> Float[np.ndarray, "h w 2"]:
    """Compute the pixel centres in these columns and rows on the image plane at z = 1."""
    x = (columns + 0.5 - pinhole.cx) / pinhole.fl_x
    y = (rows + 0.5 - pinhole.cy) / pinhole.fl_y
    return np.stack(np.meshgrid(x, y), axis=-1)


def _to_pixels(pinhole: Pinhole, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    return points * [pinhole.fl_x, pinhole.fl_y] + [pinhole.cx, pinhole.cy]


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics as stored in a file; None for values that it omits."""

    size: tuple[int, int] | None
    """Width and height in pixels of the image that the values refer to; None for the photograph's.
    It is `FRACTIONS` for values in image widths and heights, which then has both focal lengths."""
    focal: tuple[float | None, float | None]
    """Focal lengths in x and y, in pixels of that image; the other one if None."""
    center: tuple[float | None, float | None] = (None, None)
    """Principal point in pixels of that image; the image centre if None."""
    angle: tuple[float | None, float | None] = (None, None)
    """Full fields of view in radians, for files without focal lengths."""
    distortion: Distortion = Distortion()

    def compute_pinhole(self, width: int, height: int) -> Pinhole:
        """Compute the intrinsics of an image of this size, before undistortion.

        A focal length or a field of view is known in x or y.
        """
        w, h = self.size or (width, height)
        fl_x = _compute_focal(self.focal[0], self.angle[0], w)
        fl_y = _compute_focal(self.focal[1], self.angle[1], h)
        cx = w / 2 if self.center[0] is None else self.center[0]
        cy = h / 2 if self.center[1] is None else self.center[1]
        # With only one focal length, pixels are square.
        if fl_x is None:
            fl_x = fl_y
        if fl_y is None:
            fl_y = fl_x
        assert fl_x is not None
        assert fl_y is not None
        return Pinhole(fl_x, fl_y, cx, cy, w, h).resize(width, height)

    def fits(self, width: int, height: int) -> bool:
        """Check whether a photograph has the aspect ratio of `size`, apart from rounding."""
        if self.size is None or self.size == FRACTIONS:
            return True
        return has_same_aspect(self.size, (width, height))

    def is_transposed(self, width: int, height: int) -> bool:
        """Check whether a photograph of this size is rotated by 90° relative to `size`."""
        return not self.fits(width, height) and self.fits(height, width)


def has_same_aspect(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Check whether two sizes differ by a scale, whose sides were rounded to whole pixels."""
    w, h = one
    width, height = other
    # Equal ratios have equal cross products, which needs no division by a small side.
    # A side that is rounded by a pixel changes its product by a side of the other image.
    largest = max(w, h, width, height, SAME_ASPECT * width * h)
    return abs(width * h - height * w) <= largest


def find_pinhole_defect(pinhole: Pinhole) -> str | None:
    """Describe why intrinsics are impossible; None if they are valid."""
    # Relative to the image size, so that one range fits images of all sizes.
    unit = pinhole.resize(1, 1)
    low, high = FOCAL_RANGE
    for focal in (unit.fl_x, unit.fl_y):
        if not low <= focal <= high:
            defect = f"its focal length is {focal:g} times the size of the image"
            return f"{defect}, which is not within {low:g} to {high:g}"
    for center in (unit.cx, unit.cy):
        if not abs(center) <= MAX_CENTER:
            defect = f"its principal point lies {center:g} image sizes from the corner"
            return f"{defect}, which is beyond {MAX_CENTER:g}"
    return None


def find_distortion_defect(pinhole: Pinhole, distortion: Distortion) -> str | None:
    """Describe why distortion cannot be removed from a photograph; None if it can."""
    if undistort_pinhole(pinhole, distortion) is not None:
        return None
    # Zooms are about the principal point, so it has to be shown.
    is_in_row = 0.5 <= pinhole.cx <= pinhole.width - 0.5
    is_in_column = 0.5 <= pinhole.cy <= pinhole.height - 0.5
    if not (is_in_row and is_in_column):
        return "its principal point lies outside of it, and its distortion is removed around that"
    return "its distortion coefficients fold the image over itself"


def compute_fov(pinhole: Pinhole) -> float:
    """Compute the larger field of view of a camera, in degrees."""
    sides = ((pinhole.fl_x, pinhole.cx, pinhole.width), (pinhole.fl_y, pinhole.cy, pinhole.height))
    # The principal point need not be central, so each half has its own angle.
    return math.degrees(
        max(math.atan(c / focal) + math.atan((side - c) / focal) for focal, c, side in sides)
    )


def _compute_focal(focal: float | None, angle: float | None, length: int) -> float | None:
    if focal is not None or angle is None:
        return focal
    return length / 2 / math.tan(angle / 2)


def find_pose_defect(pose: Float[np.ndarray, "4 4"]) -> str | None:
    """Describe why a pose is invalid; None for a rigid transform within the limits."""
    if not np.isfinite(pose).all():
        return "its pose holds NaN or infinity"
    if np.abs(pose).max() > MAX_COORDINATE:
        return f"its pose holds {np.abs(pose).max():g}, which is above {MAX_COORDINATE:g}"
    rotation = pose[:3, :3]
    # A pose of columns of unit length at right angles, and the last row of a homogeneous transform.
    errors = (rotation.T @ rotation - np.eye(3), pose[3] - [0, 0, 0, 1])
    if max(np.abs(error).max() for error in errors) > MAX_RIGID_ERROR:
        return "its pose is not a rigid transform but scaled, sheared or projective"
    if np.linalg.det(rotation) < 0:
        return "its pose is a reflection (its determinant is negative)"
    return None


def make_rigid(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Replace the rotation by the nearest exact one, unless it is within `FLOAT_NOISE`."""
    rotation = pose[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > FLOAT_NOISE:
        # The nearest rotation in the Frobenius norm: the polar decomposition without its stretch.
        u, _, v = np.linalg.svd(rotation)
        rotation = u @ v
    rigid = np.eye(4)
    rigid[:3, :3] = rotation
    rigid[:3, 3] = pose[:3, 3]
    return rigid


def invert_viewmat(viewmat: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Invert a world-to-camera transform; an invalid one stays, so its defect is found later."""
    return viewmat if find_pose_defect(viewmat) is not None else np.linalg.inv(viewmat)


def compute_rotation(quaternion: Sequence[float]) -> Float[np.ndarray, "3 3"]:
    """Compute the rotation of a quaternion (real part first, any length); NaN if it is zero."""
    q = np.array(quaternion, dtype=np.float64)
    with np.errstate(all="ignore"):
        # Squares of large components overflow and those of tiny ones vanish; scaled first, neither
        # does.
        q = q / np.abs(q).max()
        w, x, y, z = q / np.linalg.norm(q)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows)
