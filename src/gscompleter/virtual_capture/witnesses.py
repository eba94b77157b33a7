"""Witnesses of a splat without photographs: cameras all over it from which it looks well.

Renders around a target know what stands before that target. An addition may still hide what the
splat shows from elsewhere: with three renders around one target, photographs of a trained splat
that nobody had given lost up to 9.8 dB. So the splat itself is the witness. Where it is opaque,
nothing is added before it, seen from any of these cameras (decision 061).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from gscompleter.numerics.geometry import (
    add_near_plane,
    is_same_camera,
    resize_camera,
    select_spread_cameras,
)
from gscompleter.render.protocols import Renderer
from gscompleter.types import Camera, Gaussians
from gscompleter.virtual_capture.pixel_aligned import aim_pixel_camera, move_beside
from gscompleter.virtual_capture.standpoints import find_standpoints

MAX_WITNESSES = 64
"""Most witnesses of a splat; of a file with more cameras, those that are spread most are taken. Of
40, some of a trained splat that tested saw its rim hidden (26.5 dB), of 64 none (45.8 dB)."""
ENOUGH_KNOWN_CAMERAS = 12
"""Cameras of a file besides the context from which on no further witnesses are found."""
TESTING = 4
"""Every so many-th witness guards nothing, and tests the result."""
WIDE = 100.0
"""Field of view of those that guard, in degrees."""
WITNESS_SIDE = 96
"""Width and height of the images of witnesses that are found, in pixels."""
FARTHER = 1.6
"""Moves of the camera of a pixel-aligned splat to its witnesses, relative to those to its renders.
Any farther, the backs of its surfaces look as good as their fronts."""


@dataclass(frozen=True)
class Witnesses:
    """Cameras from which a splat looks well, and that are neither targets nor rendered as views."""

    guarding: tuple[Camera, ...] = ()
    """Nothing is added before what these see."""
    testing: tuple[Camera, ...] = ()
    """These decide nothing. They measure what additions hide."""


def divide_witnesses(cameras: Sequence[Camera]) -> Witnesses:
    """Divide cameras into those that guard and those that test."""
    guarding = [camera for index, camera in enumerate(cameras) if index % TESTING != TESTING - 1]
    guarding = [widen(camera) for camera in guarding]
    return Witnesses(tuple(guarding), tuple(cameras[TESTING - 1 :: TESTING]))


def widen(camera: Camera) -> Camera:
    """Widen the view of a camera to what a person there sees who looks around."""
    K = camera.K.clone()
    K[[0, 1], [0, 1]] = camera.width / 2 / math.tan(math.radians(WIDE) / 2)
    return replace(camera, K=K)


def choose_witnesses(
    scene: Gaussians,
    pixel_center: Float[Tensor, "3"] | None,
    context: Sequence[Camera],
    others: Sequence[Camera],
    up: Float[Tensor, "3"],
    renderer: Renderer,
) -> Witnesses:
    """Choose the witnesses of a splat among its known cameras, and find others if these are few.

    `context` are the cameras at which it is rendered, which guard it in any case; `others` are
    further ones from which it is known to look well. `up` is the upward direction, and
    `pixel_center` the centre of the camera of a pixel-aligned splat.
    """
    if len(others) > MAX_WITNESSES:
        others = [others[index] for index in select_spread_cameras(others, MAX_WITNESSES)]
    if len(others) < ENOUGH_KNOWN_CAMERAS:
        # Not where renders are taken: the same splat has the same witnesses, whether its cameras
        # were found or come from the file of an earlier run.
        small = [resize_camera(camera, WITNESS_SIDE, WITNESS_SIDE) for camera in context]
        found = find_witnesses(scene, pixel_center, up, renderer)
        others = [*others, *(c for c in found if not any(is_same_camera(c, s) for s in small))]
    return divide_witnesses(others)


def find_witnesses(
    scene: Gaussians,
    pixel_center: Float[Tensor, "3"] | None,
    up: Float[Tensor, "3"],
    renderer: Renderer,
) -> list[Camera]:
    """Find cameras from which a splat looks well, by the splat alone."""
    if pixel_center is None:
        return find_standpoints(scene, up, WITNESS_SIDE, renderer, MAX_WITNESSES)
    pixel_camera = aim_pixel_camera(scene, pixel_center, up, WITNESS_SIDE)
    seen = renderer.render(scene, add_near_plane(pixel_camera, scene.means)).depth_map()
    if not seen.valid.any():
        return []
    depth = seen.depth[seen.valid].median().item()
    return [*move_beside(pixel_camera, depth), *move_beside(pixel_camera, FARTHER * depth)[1:]]
