"""The sky: Gaussians so far behind the far plane that their parallax is invisible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gscompleter.numerics.geometry import compute_z_depths
from gscompleter.numerics.image_ops import dilate
from gscompleter.types import Camera, DepthMap, Gaussians, Render, View, make_observed, sh_from_rgb

SKY_DEPTH = 8.0
"""z-depth of the sky, in multiples of the far plane."""
MIN_SKY_DEPTH = 3.0
"""Rendered z-depth from which a pixel is sky, in multiples of the far plane.
Pixels on an edge mix surface and sky and lie in between."""
SKY_EXTENSION = 0.125
"""Extension of the sky behind surfaces, as a fraction of the shorter image side.
Without it, parallax would open gaps along roofs and trees."""
SKY_OPACITY = 0.98
"""Opacity of the extended sky, that of the discs of plane-sweep."""


def is_sky(depth: Float[Tensor, "*n"], camera: Camera) -> Bool[Tensor, "*n"]:
    """Return which z-depths, in scene units, are sky; none if the far plane is unknown."""
    return depth > (float("inf") if camera.far is None else MIN_SKY_DEPTH * camera.far)


def compute_sky_depth(camera: Camera) -> float:
    """Compute the z-depth of the sky in scene units; `camera` must have a far plane."""
    assert camera.far is not None, "a camera with a sky has a far plane"
    return SKY_DEPTH * camera.far


def is_sky_visible(renders: Sequence[Render], cameras: Sequence[Camera]) -> bool:
    """Return True if any of one or more renders shows sky."""
    # All flags are stacked, so that the host waits for a GPU once and not for each render.
    shown = []
    for render, camera in zip(renders, cameras, strict=True):
        depth = render.depth_map()
        shown.append((depth.valid & is_sky(depth.depth, camera)).any())
    return bool(torch.stack(shown).any())


def mask_out_sky(render: Render, camera: Camera) -> DepthMap:
    """Return the rendered depth, valid only on surfaces and not in the sky."""
    depth = render.depth_map()
    return DepthMap(depth.depth, depth.valid & ~is_sky(depth.depth, camera))


def extend_sky(
    view: View, sky: Bool[Tensor, "h w"], sky_image: Float[Tensor, "h w 3"], sigma: float
) -> tuple[Gaussians, Int[Tensor, "n"]]:
    """Extend the sky behind surfaces by Gaussians of `sigma` pixels; return their pixels, too.

    `sky_image` has the colours of the sky beside `sky`, as well.
    """
    camera = view.camera
    # Only behind surfaces: where the sky is seen, the reconstruction has its Gaussians.
    reach = round(SKY_EXTENSION * min(camera.width, camera.height))
    where = dilate(sky, reach) & ~sky
    pixels = torch.nonzero(where.flatten())[:, 0]
    # Without a far plane nothing is sky, and there is no pixel to place.
    depth = compute_sky_depth(camera) if len(pixels) else 0.0
    size = sigma * depth * 2 / (camera.K[0, 0] + camera.K[1, 1])
    gaussians = make_observed(
        means=camera.center + depth * camera.z_rays()[where],
        quats=sky_image.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(pixels), 1),
        scales=size.expand(len(pixels), 3).clone(),
        opacities=sky_image.new_full((len(pixels),), SKY_OPACITY),
        sh=sh_from_rgb(sky_image[where]),
    )
    return gaussians, pixels


def find_sky_gaussians(
    gaussians: Gaussians, view_index: Int[Tensor, "n"], cameras: Sequence[Camera]
) -> Bool[Tensor, "n"]:
    """Find the Gaussians of the sky, as the camera of the photograph that each is of sees them.

    Another one may stand far from it, as at the other end of a drive. `view_index` is the number of
    that camera among `cameras`.
    """
    in_sky = torch.zeros_like(gaussians.opacities, dtype=torch.bool)
    for number, camera in enumerate(cameras):
        depths = compute_z_depths(gaussians.means, camera)
        in_sky |= (view_index == number) & is_sky(depths, camera)
    return in_sky


def restore_sky_colors(made: Gaussians, fitted: Gaussians, in_sky: Bool[Tensor, "n"]) -> Gaussians:
    """Restore the colours that Gaussians of the sky had before colours were fitted.

    Fitting compensates for blur, which makes a bright line of sky along roofs; parallax would
    reveal it.
    """
    if not in_sky.any():
        return fitted
    # The fit may have added harmonics, which the sky does not have.
    sh = torch.where(in_sky[:, None, None], 0, fitted.sh)
    sh[in_sky, : made.sh.shape[1]] = made.sh[in_sky]
    return replace(fitted, sh=sh)
