"""The ground below the cameras of a drive or a walk, where stereo cannot measure it.

From one photograph of a drive to the next the near road leaves the image. Its even asphalt then
matches itself at the same pixel, as if it stood at infinity, and is built hundreds of metres away.
But cameras that keep one height move over ground: the plane below all of them on which most of
what is measured lies. A photograph far from all others, but for those from its own place, is held
to it where they show the same colours (decision 138).

Lengths are in widest baselines and inverse depths in their inverse, as in `sweep.py`. Places and
directions are in world axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from gscompleter.numerics.kernels.parallel import map_in_parallel
from gscompleter.reconstructors.features.stereo_image import StereoImage
from gscompleter.reconstructors.plane_sweep.matching import Planes
from gscompleter.reconstructors.plane_sweep.rig import Rig, Transform
from gscompleter.reconstructors.plane_sweep.sweep import (
    BACKGROUND_WEIGHT,
    Map,
    Mask,
    Measurement,
    compute_plane_index,
)

MIN_GROUND_VIEWS = 3
"""Fewest photographs. Two that are good for stereo show the near ground with parallax."""
MIN_FORWARD = 0.8
"""Smallest cosine between viewing axes and the ways to the nearest cameras. Cameras that move to a
side see the ground with parallax, and may look at a table."""

NUM_GROUNDS = 500
"""Number of planes that are tried, each through three measured points."""
POINTS_PER_VIEW = 1500
"""Most measured points of a photograph that propose planes and count for them."""
MIN_GROUND_CONFIDENCE = 0.2
"""Confidence above which a measured depth is such a point."""
MIN_GROUND_POINTS = 100
"""Fewest points below the horizon."""
MIN_UPWARDS = 0.8
"""Smallest cosine between the normal of the ground and the mean upward axis of the cameras, which
may look down."""
MAX_SIDEWAYS = 0.2
"""Largest sine of the angle by which it leans to the side of most cameras, since people keep
horizons level."""
MIN_GROUND_SHARE = 0.1
"""Smallest share of the points that lies on the ground."""
MAX_GROUND_SLOPE = 0.1
"""Largest sine of the angle between the ground and the way of the cameras. Without it a slanted
plane through the furniture of a room is the ground of a short walk."""
MAX_HEIGHT_RATIO = 1.4
"""Largest height of a camera above the ground, relative to the smallest one."""
MAX_GROUND_MISS = 0.03
"""Largest relative error of inverse depth on the ground, beside one plane of the sweep."""
GROUND_REFITS = 5
"""Number of least-squares fits to the inliers, each to those of the last one."""

MAX_CENTER_SHIFT = 2.0**-15
"""Largest distance of cameras in one place: their centres are rounded to 2^-16 in each axis. They
have no parallax, and so see the same colours at any depth, which confirm none."""
MIN_STRIDE = 1.0
"""Smallest distance to the nearest camera in another place, in heights above the ground, of a
photograph that is held to it. Nearer ones see the near ground with parallax, and its colours hardly
tell depth."""
MIN_GROUND_INDEX = 4.0
"""Smallest inverse depth of ground that is judged, in planes of the sweep. Nearer to the horizon
all that is far lies on it."""
GROUND_REACH = 5.0
"""Distance from the place below a camera up to which there is ground, in heights of the cameras."""
BEYOND = 0.85
"""Inverse depth relative to that of the ground below which a surface is clearly beyond it."""
BEYOND_PLANES = 1.5
"""Distance of such a surface from the ground, in planes of the sweep."""
MAX_GROUND_DIFFERENCE = 0.06
"""Largest colour difference from another photograph at the depth of the ground, as a mean over the
channels and a window, of colours in [0, 1]."""
GROUND_WINDOW = 9
"""Side of the window over which differences are averaged, in pixels."""
MIN_AGREEING_GROUND = 0.6
"""Smallest share of the ground in view of others that has to agree with them, for what no other
photograph shows to be held, too."""
MIN_COMPARED_GROUND = 0.02
"""Smallest share of the photograph that is compared for that."""

Places = Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class MeasuredPoints:
    """Points that were measured below the horizon, by the rays of their pixels."""

    rays: Places
    """Rays with z-depth 1, in world axes."""
    centers: Places
    """Centre of the camera of each ray."""
    inverse: Float[np.ndarray, "n"]
    """Measured inverse depth."""
    step: Float[np.ndarray, "n"]
    """Distance of two planes of the sweep that measured it, in inverse depth."""

    @cached_property
    def places(self) -> Places:
        """Positions in world axes."""
        return self.centers + self.rays / self.inverse[:, None]


@dataclass(frozen=True)
class Ground:
    """The plane of points x with normal · x = offset; the normal points upwards."""

    normal: Float[np.ndarray, "3"]
    offset: float

    def measure_heights(self, centers: Places) -> Float[np.ndarray, "n"]:
        """Measure how high points are above the ground."""
        return centers @ self.normal - self.offset

    def compute_inverse(
        self, rays: Float[np.ndarray, "*n 3"], heights: Float[np.ndarray, "*#n"]
    ) -> Float[np.ndarray, "*n"]:
        """Compute the inverse depths at which rays of z-depth 1 meet the ground.

        `heights` are those of their cameras above it. Rays above the horizon have negative ones.
        """
        # A ray meets it where its height, that of the camera and depth times ray · normal, is 0.
        inverse: Float[np.ndarray, "*n"] = -(rays @ self.normal) / heights
        return inverse

    def find_inliers(self, points: MeasuredPoints) -> Bool[np.ndarray, "n"]:
        """Find the points on the ground, apart from those near the horizon."""
        inverse = self.compute_inverse(points.rays, self.measure_heights(points.centers))
        is_judged = inverse > MIN_GROUND_INDEX * points.step
        is_near = np.abs(points.inverse - inverse) < points.step + MAX_GROUND_MISS * inverse
        found: Bool[np.ndarray, "n"] = is_judged & is_near
        return found


def hold_to_ground(
    rig: Rig, measured: Sequence[Measurement], skies: Sequence[Mask]
) -> list[Measurement]:
    """Put on the ground what is not measured there, or was measured beyond it.

    What is put there weighs as little as the background of occluded pixels. `measured` are at full
    size, and stay as they are without a ground that the cameras moved over.
    """
    if len(rig.images) < MIN_GROUND_VIEWS or not moves_forward(rig.images):
        return list(measured)
    ground = find_ground(rig.images, measured, skies)
    if ground is None:
        return list(measured)
    hold = partial(hold_view, rig, ground)
    return map_in_parallel(hold, range(len(measured)), measured, skies)


def moves_forward(images: Sequence[StereoImage]) -> bool:
    """Check whether most cameras look along the way to the nearest other one, or back along it."""
    axes = np.stack([image.rotation[:, 2] for image in images])
    return float(np.median(np.abs((find_ways(images) * axes).sum(axis=1)))) > MIN_FORWARD


def find_ways(images: Sequence[StereoImage]) -> Places:
    """Find the direction from each camera to the nearest one in another place.

    They are zero if all cameras are in one place.
    """
    centers = np.stack([image.center for image in images])
    ways = []
    for number, center in enumerate(centers):
        distances = measure_baselines_from(images, number)
        nearest = int(distances.argmin())
        ways.append((centers[nearest] - center) / distances[nearest])
    return np.stack(ways)


def measure_baselines_from(images: Sequence[StereoImage], number: int) -> Float[np.ndarray, "n"]:
    """Measure how far cameras are from that of image `number`; infinite if in the same place."""
    centers = np.stack([image.center for image in images])
    distances = np.linalg.norm(centers - images[number].center, axis=1)
    return np.where(distances > MAX_CENTER_SHIFT, distances, np.inf)


def find_ground(
    images: Sequence[StereoImage], measured: Sequence[Measurement], skies: Sequence[Mask]
) -> Ground | None:
    """Find the plane below all cameras with the most measured points, by RANSAC.

    None if no plane has points and all cameras at about one height above it.
    """
    centers = np.stack([image.center for image in images])
    ways = find_ways(images)
    # Rotations are from camera to world axes: their columns are the axes of cameras, of which x
    # points to the right and y down.
    rotations = np.stack([image.rotation for image in images])
    sideways = rotations[:, :, 0]
    downwards = rotations[:, :, 1].mean(axis=0)
    upwards = -downwards / max(float(np.linalg.norm(downwards)), 1e-9)
    generator = np.random.default_rng(0)
    points = sample_points(images, measured, skies, upwards, generator)
    if len(points.inverse) < MIN_GROUND_POINTS:
        return None

    def is_possible(ground: Ground) -> bool:
        """Check that cameras move along a plane, upright and at about the same height above it."""
        heights = ground.measure_heights(centers)
        lowest = float(heights.min())
        # Cameras may look along the way and back, so that their axes to the side have no mean.
        return (
            float(ground.normal @ upwards) > MIN_UPWARDS
            and float(np.median(np.abs(sideways @ ground.normal))) < MAX_SIDEWAYS
            and float(np.median(np.abs(ways @ ground.normal))) < MAX_GROUND_SLOPE
            and 0 < float(heights.max()) < MAX_HEIGHT_RATIO * lowest
        )

    best = None
    most = MIN_GROUND_SHARE * len(points.inverse)
    for _ in range(NUM_GROUNDS):
        corners = points.places[generator.choice(len(points.inverse), 3, replace=False)]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        ground = make_ground(normal, corners[0], upwards)
        if is_possible(ground):
            count = float(ground.find_inliers(points).sum())
            if count > most:
                best = ground
                most = count
    if best is None:
        return None
    for _ in range(GROUND_REFITS):
        refitted = refit_ground(best, points, upwards)
        if not is_possible(refitted):
            break
        best = refitted
    return best


def sample_points(
    images: Sequence[StereoImage],
    measured: Sequence[Measurement],
    skies: Sequence[Mask],
    upwards: Float[np.ndarray, "3"],
    generator: np.random.Generator,
) -> MeasuredPoints:
    """Sample measured points of all photographs, below the horizon and not in the sky."""
    parts = []
    for image, measurement, sky in zip(images, measured, skies, strict=True):
        rays = compute_rays(image)
        candidates = (measurement.confidence > MIN_GROUND_CONFIDENCE) & ~sky & (rays @ upwards < 0)
        pixels = generator.permutation(np.flatnonzero(candidates))[:POINTS_PER_VIEW]
        step = float(measurement.planes[1] - measurement.planes[0])
        parts.append(
            (
                rays.reshape(-1, 3)[pixels],
                np.tile(image.center, (len(pixels), 1)),
                measurement.inverse.reshape(-1)[pixels].astype(np.float64),
                np.full(len(pixels), step),
            )
        )
    return MeasuredPoints(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def compute_rays(image: StereoImage) -> Float[np.ndarray, "h w 3"]:
    """Compute the ray of each pixel, with z-depth 1, in world axes."""
    height, width = image.size
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays: Float[np.ndarray, "h w 3"] = pixels @ (image.rotation @ np.linalg.inv(image.K)).T
    return rays


def make_ground(
    normal: Float[np.ndarray, "3"], place: Float[np.ndarray, "3"], upwards: Float[np.ndarray, "3"]
) -> Ground:
    """Make the plane through `place` whose normal, of any length and sign, is turned upwards."""
    length = max(float(np.linalg.norm(normal)), 1e-30)
    unit = normal / (length if normal @ upwards > 0 else -length)
    return Ground(unit, float(unit @ place))


def refit_ground(ground: Ground, points: MeasuredPoints, upwards: Float[np.ndarray, "3"]) -> Ground:
    """Fit the plane to its inliers by least squares of their distances from it."""
    found = ground.find_inliers(points)
    places = points.places[found]
    # A step of the sweep changes a depth, 1 / inverse, by step / inverse², and so the height of a
    # point of the ground by step / inverse times that of the camera: its weight is 1 / that².
    heights = ground.measure_heights(points.centers[found])
    weight = (points.inverse[found] / (points.step[found] * heights)) ** 2
    middle = weight @ places / weight.sum()
    # The direction in which they spread least is the normal.
    scaled = (places - middle) * np.sqrt(weight)[:, None]
    normal = np.linalg.svd(scaled, full_matrices=False)[2][-1]
    return make_ground(normal, middle, upwards)


def hold_view(
    rig: Rig, ground: Ground, number: int, measured: Measurement, sky: Mask
) -> Measurement:
    """Hold the pixels of a view to the ground where other photographs agree with it."""
    image = rig.images[number]
    centers = np.stack([other.center for other in rig.images])
    heights = ground.measure_heights(centers)
    if float(measure_baselines_from(rig.images, number).min()) < MIN_STRIDE * heights[number]:
        return measured
    rays = compute_rays(image)
    inverse = ground.compute_inverse(rays, heights[number]).astype(np.float32)
    step = measured.planes[1] - measured.planes[0]
    is_ground = (inverse > MIN_GROUND_INDEX * step) & ~sky & (image.given == 0)
    if image.ignore_mask is not None:
        is_ground &= ~image.ignore_mask

    # Ground is known where cameras passed: within reach of the places below them.
    hits = image.center + rays / np.maximum(inverse, step)[..., None]
    feet = centers - heights[:, None] * ground.normal
    distances = [np.linalg.norm(hits - foot, axis=-1) for foot in feet]
    is_ground &= np.min(distances, axis=0) < GROUND_REACH * float(np.median(heights))

    is_confirmed, is_compared = confirm_ground(rig, number, inverse, is_ground)
    index = compute_plane_index(measured.planes, inverse)
    is_beyond = (measured.inverse < BEYOND * inverse) & (measured.index < index - BEYOND_PLANES)
    is_unmeasured = measured.weight == 0
    held = is_confirmed & (is_beyond | is_unmeasured)
    # Fusion keeps a place that several photographs measured in the finest of them alone, and tells
    # what is measured by its confidence. So ground that others show has some. That which nobody
    # else shows has none, as depths between measured ones, and gives way to any measurement.
    confidence = np.where(is_compared, BACKGROUND_WEIGHT, np.float32(0))
    return replace(
        measured,
        planes=extend_planes(measured.planes, index[held]),
        index=np.where(held, index, measured.index),
        weight=np.where(held, BACKGROUND_WEIGHT, measured.weight),
        confidence=np.where(held, confidence, measured.confidence),
    )


def extend_planes(
    planes: Planes, index: Float32[np.ndarray, "n"]
) -> Float32[np.ndarray, "extended"]:
    """Extend planes in their steps, so that each plane `index` is one of them.

    The sweep ends at the nearest depth that another photograph sees. That which stands rearmost on
    a drive sees nearer ground than any of them.
    """
    if index.size == 0 or index.max() < len(planes) - 0.5:
        return planes
    count = math.ceil(float(index.max())) + 1
    step = float(planes[1]) - float(planes[0])
    further = planes[0] + step * np.arange(len(planes), count)
    return np.concatenate([planes, further.astype(planes.dtype)])


def confirm_ground(rig: Rig, number: int, inverse: Map, is_ground: Mask) -> tuple[Mask, Mask]:
    """Find the ground of a view that other photographs confirm, and that which any of them shows.

    `inverse` are its inverse depths, and `is_ground` marks the pixels that are judged.
    """
    difference = measure_difference(rig, number, inverse)
    is_compared = is_ground & np.isfinite(difference)
    agrees = is_ground & (difference < MAX_GROUND_DIFFERENCE)
    # Where no other photograph looks, the ground goes on if the rest of it proved right.
    is_right = agrees.sum() >= MIN_AGREEING_GROUND * is_compared.sum()
    if is_right and is_compared.mean() >= MIN_COMPARED_GROUND:
        agrees |= is_ground & ~is_compared
    return agrees, is_compared


def measure_difference(rig: Rig, number: int, inverse: Map) -> Float32[np.ndarray, "h w"]:
    """Measure how much a view differs from the most similar other one at some inverse depths.

    Colour differences are averaged over a window, since an edge may be a pixel off. Infinite where
    no photograph from another place shows the surface in a pixel that is not ignored.
    """
    own = rig.images[number].image
    is_elsewhere = np.isfinite(measure_baselines_from(rig.images, number))
    least = np.full(inverse.shape, np.inf, np.float32)
    for other, image in enumerate(rig.images):
        if is_elsewhere[other]:
            transform = rig.transforms[number, other]
            seen, is_seen = sample_at(image.image, inverse, transform)
            if image.ignore_mask is not None:
                ignored, _ = sample_at(image.ignore_mask.astype(np.float32), inverse, transform)
                is_seen &= ignored == 0
            difference = cv2.blur(np.abs(seen - own).mean(axis=-1), (GROUND_WINDOW, GROUND_WINDOW))
            least = np.where(is_seen, np.minimum(least, difference), least)
    return least


def sample_at(
    image: Float32[np.ndarray, "H W *channels"], inverse: Map, transform: Transform
) -> tuple[Float32[np.ndarray, "h w *channels"], Mask]:
    """Sample another image at the inverse depths of a view, and mark what lies inside of it."""
    height, width = inverse.shape
    x = np.arange(width, dtype=np.float32) + np.float32(0.5)
    y = np.arange(height, dtype=np.float32)[:, None] + np.float32(0.5)
    u, v, z = (a * x + b * y + c + d * inverse for a, b, c, d in transform)
    in_front = z > 1e-3
    # Pixel centres are at whole numbers for OpenCV; -1 is outside.
    u = np.where(in_front, u / np.where(in_front, z, 1) - np.float32(0.5), np.float32(-1))
    v = np.where(in_front, v / np.where(in_front, z, 1) - np.float32(0.5), np.float32(-1))
    is_inside = (u >= 0) & (v >= 0) & (u <= image.shape[1] - 1) & (v <= image.shape[0] - 1)
    # Beside the image its border goes on, so that it blurs into no foreign colour.
    sampled = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sampled, is_inside
