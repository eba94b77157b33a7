"""Cameras from which a trained splat looks like a photograph, and cameras around a place in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.numerics.geometry import look_along, resize_camera
from gscompleter.render.lod import MAX_PREVIEW_GAUSSIANS, thin_gaussians
from gscompleter.render.protocols import Renderer
from gscompleter.render.view_map import get_view_map
from gscompleter.trust.lifted import Core, measure_core
from gscompleter.types import Camera, Gaussians
from gscompleter.virtual_capture.pixel_aligned import make_intrinsics
from gscompleter.virtual_capture.quality import measure_camera_quality

STANDPOINT_SIDE = 48
"""Width and height of the images in which cameras are compared."""
FIELD_OF_VIEW = 60.0
"""Field of view of cameras that are found, in degrees."""
STANDPOINT_NEAR = 0.02
"""Near plane of the images that are compared, in radii of the core."""
STANDPOINT_SEED = 0

NUM_RANDOM = 200
"""Random cameras of the search for standpoints; with 300 those found of a trained splat are no
better, with 100 their scores are a tenth lower."""
NUM_IMPROVED = 20
"""Best cameras that are moved a little, in each of two rounds."""
NUM_MOVES = 3
"""Moves of each, in each round."""
PITCH = (-0.75, 0.35)
"""Range of the sine of the angle by which a camera looks up."""
MIN_NEAREST = 0.04
"""Least depth of the nearest surface, in radii of the core."""
FREE_NEAREST = 0.12
"""The same, from which on it does not matter."""
APART = (0.35, 0.6)
"""Distance, in radii of the core, and angle, in radians, of standpoints that count as others; both
shares are summed."""
MIN_RELATIVE_SCORE = 0.3
"""Least score of a standpoint, relative to the best."""

DISTANCES = (2.5, 4.0, 6.0)
"""Distances of cameras around a place, in its radii."""
AROUND_NEAR = 0.05
"""Near plane of the images that are compared, in radii of the place, which begins 1.5 of them from
the nearest camera. It is small, so that what stands close before a camera hides the place."""
AZIMUTH_STEP = 20
ELEVATIONS = (0, 20, 45)
"""Directions of cameras around a place, in degrees."""
MIN_BALL_SHARE = 0.35
"""Least share of a place, against a ball of its size, that a camera around it has to show."""
AROUND_APART = 35.0
"""Angle, in degrees, from which on cameras around a place show other sides of it."""
MIN_AROUND = 0.1
"""Least gain of a camera around a place, relative to the best."""


@dataclass(frozen=True)
class Standpoint:
    """A camera with its score."""

    score: float
    camera: Camera


def find_standpoints(
    scene: Gaussians,
    up: Float[Tensor, "3"],
    side: int,
    renderer: Renderer,
    count: int,
) -> list[Camera]:
    """Find up to `count` cameras where a photographer may have stood, the best first.

    Random cameras inside and around the core, level up to a pitch, are rated by what they see; the
    best are improved. `up` is in world axes, of any length. `side` is the size of their images, in
    pixels. The cameras have no near plane.
    """
    core = measure_core(scene.means)
    small = thin_gaussians(scene, MAX_PREVIEW_GAUSSIANS)
    up = normalize(up, dim=0)
    generator = torch.Generator().manual_seed(STANDPOINT_SEED)

    def rate(camera: Camera) -> Standpoint:
        quality = measure_camera_quality(small, camera, renderer.freeze(small, camera))
        nearest = quality.nearest / core.radius
        if nearest < MIN_NEAREST:
            return Standpoint(0.0, camera)
        return Standpoint(quality.score * min(nearest / FREE_NEAREST, 1.0), camera)

    def rate_all(cameras: Sequence[Camera]) -> list[Standpoint]:
        return list(get_view_map(scene.means)(rate, cameras))

    found = rate_all([sample_camera(core, up, generator) for _ in range(NUM_RANDOM)])
    for reach in (1.0, 0.5):
        found.sort(key=lambda one: -one.score)
        moved = [
            shift_camera(one.camera, core, up, reach, generator)
            for one in found[:NUM_IMPROVED]
            for _ in range(NUM_MOVES)
        ]
        found += rate_all(moved)

    def measure_apart(cameras: Sequence[Camera], other: Camera) -> Float[Tensor, "n"]:
        centers = torch.stack([camera.center for camera in cameras])
        distances = (centers - other.center).norm(dim=1) / core.radius
        return distances / APART[0] + measure_turns(cameras, other) / APART[1]

    chosen = choose_apart(found, measure_apart, count, MIN_RELATIVE_SCORE)
    return [replace(resize_camera(camera, side, side), near=None) for camera in chosen]


def choose_cameras_around_place(
    scene: Gaussians,
    chosen: Bool[Tensor, "n"],
    up: Float[Tensor, "3"],
    side: int,
    renderer: Renderer,
    count: int = 6,
) -> list[Camera]:
    """Choose up to `count` cameras that see chosen Gaussians unhidden, from several sides.

    A camera counts by its quality and by the share of the place that it shows. `up` is in world
    axes, of any length. `side` is the size of their images, in pixels. The cameras have no near
    plane.
    """
    core = measure_core(scene.means)
    up = normalize(up, dim=0)
    middle = scene.means[chosen].median(dim=0).values
    radius = (scene.means[chosen] - middle).norm(dim=1).quantile(0.9).item()
    radius = max(radius, 1e-3 * core.radius)
    small, values = thin_with_values(scene, chosen)
    half = math.tan(math.radians(FIELD_OF_VIEW) / 2)

    def rate(place: tuple[float, int, int]) -> Standpoint:
        distance, azimuth, elevation = place
        aside = make_direction(up, math.radians(azimuth), math.radians(elevation))
        center = middle + distance * radius * aside
        camera = make_standpoint_camera(center, -aside, up, AROUND_NEAR * radius)
        frozen = renderer.freeze(small, camera)
        # A ball of that radius covers this share of the image.
        expected = math.pi / distance**2 / (4 * half**2)
        shown = (frozen.splat(values) > 0.5).float().mean().item() / expected
        if shown < MIN_BALL_SHARE:
            return Standpoint(0.0, camera)
        return Standpoint(
            measure_camera_quality(small, camera, frozen).score * min(shown, 1.0), camera
        )

    places = list(product(DISTANCES, range(0, 360, AZIMUTH_STEP), ELEVATIONS))
    rated = list(get_view_map(scene.means)(rate, places))

    def measure_apart(cameras: Sequence[Camera], other: Camera) -> Float[Tensor, "n"]:
        return measure_turns(cameras, other) / math.radians(AROUND_APART)

    cameras = choose_apart(rated, measure_apart, count, MIN_AROUND)
    return [replace(resize_camera(camera, side, side), near=None) for camera in cameras]


def choose_apart(
    found: Sequence[Standpoint],
    measure_apart: Callable[[Sequence[Camera], Camera], Float[Tensor, "n"]],
    count: int,
    min_share: float,
) -> list[Camera]:
    """Choose cameras greedily.

    The gain of a camera is its score times its distance from the nearest chosen one, at most its
    score (`measure_apart`: 1 or more is another place). None is chosen whose gain is below
    `min_share` of the best score. With a larger `count` the first ones are the same.
    """
    best = max((one.score for one in found), default=0.0)
    # The gain of a camera is at most its score, so that none of the others is ever chosen.
    left = [one for one in found if one.score > 0 and one.score >= min_share * best]
    if not left:
        return []
    cameras = [one.camera for one in left]
    scores = torch.tensor([one.score for one in left], dtype=torch.float64)
    gains = scores
    chosen: list[Camera] = []
    while len(chosen) < count and gains.max() >= min_share * best:
        chosen.append(cameras[int(gains.argmax())])
        apart = measure_apart(cameras, chosen[-1]).double().cpu()
        gains = torch.minimum(gains, scores * apart)
    return chosen


def measure_turns(cameras: Sequence[Camera], other: Camera) -> Float[Tensor, "n"]:
    """Measure the angles of the rotations between cameras and another one, in radians."""
    rotations = torch.stack([camera.c2w[:3, :3] for camera in cameras])
    # The norm of the difference of two rotations is 2 √2 sin(angle / 2).
    chords = (rotations - other.c2w[:3, :3]).flatten(1).norm(dim=1)
    return 2 * torch.asin((chords / 8**0.5).clamp(max=1.0))


def thin_with_values(
    scene: Gaussians, chosen: Bool[Tensor, "n"]
) -> tuple[Gaussians, Float[Tensor, "m"]]:
    """Thin a scene, and return 1 for each of the Gaussians left that is chosen, else 0."""
    # The id of a target is a byte that thinning carries along.
    marked = replace(scene, generated=chosen.to(torch.uint8))
    small = thin_gaussians(marked, MAX_PREVIEW_GAUSSIANS)
    return small, small.generated.to(small.means)


def sample_camera(core: Core, up: Float[Tensor, "3"], generator: torch.Generator) -> Camera:
    """Draw a camera in the core or around it, which looks across or at the middle.

    The numbers are ranges of the search only; results are rated, so none is a limit but `PITCH`.
    """

    def draw(low: float, high: float) -> float:
        return low + (high - low) * torch.rand((), generator=generator).item()

    if draw(0.0, 1.0) < 0.5:
        offset = torch.tensor([draw(-1.0, 1.0) for _ in range(3)]).to(up)
        center = core.center + offset * core.half
    else:
        aside = make_direction(up, draw(0.0, 2 * math.pi), math.radians(draw(-5.0, 45.0)))
        center = core.center + core.radius * draw(0.5, 2.7) * aside
    if draw(0.0, 1.0) < 0.5:
        spot = torch.tensor([draw(-0.25, 0.25) for _ in range(3)]).to(up)
        forward = core.center + spot * core.radius - center
    else:
        forward = make_direction(up, draw(0.0, 2 * math.pi), -math.asin(draw(-0.15, 0.45)))
    return make_standpoint_camera(
        center, limit_pitch(forward, up), up, STANDPOINT_NEAR * core.radius
    )


def shift_camera(
    camera: Camera,
    core: Core,
    up: Float[Tensor, "3"],
    reach: float,
    generator: torch.Generator,
) -> Camera:
    """Move and turn a camera a little, the less the smaller `reach` is.

    The numbers are ranges of the search only; results are rated, so none is a limit but `PITCH`.
    """
    steps = torch.randn((2, 3), generator=generator).to(up)
    center = camera.center + 0.15 * reach * core.radius * steps[0]
    forward = limit_pitch(camera.forward + 0.25 * reach * steps[1], up)
    return make_standpoint_camera(center, forward, up, STANDPOINT_NEAR * core.radius)


def limit_pitch(forward: Float[Tensor, "3"], up: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Return a unit direction that looks neither too far up nor too far down."""
    forward = normalize(forward, dim=0)
    sine = (forward @ up).clamp(*PITCH)
    level = normalize(forward - up * (forward @ up), dim=0)
    return (1 - sine**2).sqrt() * level + sine * up


def make_direction(up: Float[Tensor, "3"], azimuth: float, elevation: float) -> Float[Tensor, "3"]:
    """Make a unit direction from angles in radians."""
    # Any axis that is not parallel to the upward direction starts the azimuths.
    start = torch.eye(3).to(up)[int(up.abs().argmin())]
    first = normalize(start - up * (start @ up), dim=0)
    second = torch.linalg.cross(up, first)
    level = math.cos(azimuth) * first + math.sin(azimuth) * second
    return math.cos(elevation) * level + math.sin(elevation) * up


def make_standpoint_camera(
    center: Float[Tensor, "3"], forward: Float[Tensor, "3"], up: Float[Tensor, "3"], near: float
) -> Camera:
    """Make a small camera at a place."""
    c2w = torch.eye(4).to(center)
    c2w[:3, 3] = center
    K = make_intrinsics(STANDPOINT_SIDE, math.tan(math.radians(FIELD_OF_VIEW) / 2)).to(center)
    return look_along(Camera(c2w, K, STANDPOINT_SIDE, STANDPOINT_SIDE, near=near), forward, up)
