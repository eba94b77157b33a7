"""What is so far away that it moves with the camera.

The sky is a layer of its own: Gaussians at one z-depth far behind the far plane, so that between
photographs and target it shifts by less than can be seen, and no surface is ever behind it.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gscompleter.interpolation import push_pull
from gscompleter.masks import dilate
from gscompleter.types import Camera, DepthMap, Gaussians, Render, View, observed, sh_from_rgb

SKY_DEPTH = 8.0
"""z-depth of the sky, in multiples of the far plane."""
SKY_FROM = 3.0
"""z-depth from which what is drawn counts as sky, in multiples of the far plane. What an edge and
the sky behind it make together lies in between."""
REACH = 0.125
"""How far the sky goes on behind what stands before it, as a share of the image's shorter side: it
moves with the camera while roofs and trees do not, and gaps would open along all of them."""
OPACITY = 0.98
"""Of the Gaussians there."""


def is_sky(depth: Float[Tensor, "*n"], camera: Camera) -> Bool[Tensor, "*n"]:
    """Which z-depths, in scene units, are the sky's; none where the far plane is not known."""
    return depth > (float("inf") if camera.far is None else SKY_FROM * camera.far)


def sky_depth(camera: Camera) -> float:
    """z-depth of the sky, in scene units; `camera` knows its far plane."""
    assert camera.far is not None, "a camera with a sky has a far plane"
    return SKY_DEPTH * camera.far


def shows_sky(render: Render, camera: Camera) -> bool:
    """Whether `camera` sees the sky in `render`."""
    depth = render.depth_map()
    return bool((depth.valid & is_sky(depth.depth, camera)).any())


def surfaces_in(render: Render, camera: Camera) -> DepthMap:
    """The depth that `camera` sees in `render`, valid where it is a surface's and not the sky's."""
    depth = render.depth_map()
    return DepthMap(depth.depth, depth.valid & ~is_sky(depth.depth, camera))


def sky_behind(
    view: View, sky: Bool[Tensor, "h w"], sigma: float
) -> tuple[Gaussians, Int[Tensor, "n"]]:
    """The sky behind what stands before it, near where it is seen, and the pixels it lies at [n].

    Args:
        view: The image and its camera.
        sky: Where it shows the sky.
        sigma: Standard deviation of the Gaussians, in pixels.
    """
    camera, image = view.camera, view.image
    reach = round(REACH * min(camera.width, camera.height))
    where = dilate(sky, reach) & ~sky
    pixels = torch.nonzero(where.flatten())[:, 0]
    depth = sky_depth(camera) if len(pixels) else 0.0
    size = sigma * depth * 2 / (camera.K[0, 0] + camera.K[1, 1])
    gaussians = observed(
        means=camera.center + depth * camera.z_rays()[where],
        quats=image.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(pixels), 1),
        scales=size.expand(len(pixels), 3).clone(),
        opacities=image.new_full((len(pixels),), OPACITY),
        sh=sh_from_rgb(push_pull(image, sky.to(image.dtype))[where]),
    )
    return gaussians, pixels


def with_sky_of(made: Gaussians, fitted: Gaussians, camera: Camera) -> Gaussians:
    """`fitted`, its sky in the colours that `made` has there.

    Fitted colours make up for what drawing blurs. At the edge of a roof that is a bright line of
    sky, which stays behind when the roof moves on.

    Args:
        made: The n Gaussians before they were fitted, and where they stood.
        fitted: The same afterwards.
        camera: One of those that saw them.
    """
    in_sky = is_sky((made.means - camera.center).norm(dim=-1), camera)
    if not in_sky.any():
        return fitted
    sh = torch.where(in_sky[:, None, None], made.sh, fitted.sh)
    return replace(fitted, sh=sh, encoded=None)
