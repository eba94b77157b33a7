"""Renders of a scene as the photographs of it that nobody has."""

from __future__ import annotations

from collections.abc import Sequence

from gscompleter.numerics.geometry import add_near_plane
from gscompleter.numerics.value_checks import check_camera, check_gaussians
from gscompleter.render.loading import load_renderer
from gscompleter.render.protocols import Renderer
from gscompleter.system.errors import InputError
from gscompleter.system.tensor_checks import describe
from gscompleter.system.torch_modes import run_in_plain_torch
from gscompleter.types import Camera, Gaussians, View

MIN_OPAQUE = 0.95
"""Alpha from which a rendered pixel counts as photographed. With 0.5, dark and half transparent
rims of holes would be kept as if they had been seen (decision 053)."""


@run_in_plain_torch
def render_views(
    scene: Gaussians, cameras: Sequence[Camera], renderer: Renderer | None = None
) -> list[View]:
    """Render a scene at cameras, as views that take the place of photographs.

    Where the scene is not opaque, nothing is known: these pixels are ignored, and have no depth.
    Elsewhere the rendered z-depth, in scene units, is that of the view. Cameras without a near
    plane get one from the scene, for the rendering alone. `renderer` is by default that of the
    scene's device.

    Raises:
        InputError: The scene or a camera cannot be rendered, or a camera sees nothing opaque.
    """
    check_gaussians(scene, "The scene")
    if not isinstance(cameras, (list, tuple)):
        raise InputError(
            "The cameras have to be a list, such as gsc.load_cameras returns, and are "
            f"{describe(cameras)}."
        )
    for number, camera in enumerate(cameras):
        check_camera(camera, f"Camera {number}")
    renderer = renderer or load_renderer("cuda" if scene.means.is_cuda else "cpu")

    views = []
    for number, camera in enumerate(cameras):
        camera = camera.to(scene.means.device)
        render = renderer.render(scene, add_near_plane(camera, scene.means))
        is_opaque = render.alpha >= MIN_OPAQUE
        if not is_opaque.any():
            raise InputError(
                f"Camera {number} sees nothing opaque of the scene, so that its render cannot "
                "stand in for a photograph; move it, or leave it out."
            )
        views.append(
            View(
                render.image.clamp(0, 1),
                camera,
                number,
                ignore_mask=None if is_opaque.all() else ~is_opaque,
                given_depth=render.depth.where(is_opaque, 0.0),
            )
        )
    return views
