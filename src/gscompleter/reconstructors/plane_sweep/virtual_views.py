"""Virtual photographs: what each photograph shows, from one baseline beyond its nearest neighbour.

Photographs do not determine the colours of many more Gaussians than pixels: fitted to them alone,
colours cancel errors of depth, pose and exposure there and look wrong from everywhere else. Virtual
photographs say what the scene should look like elsewhere. They show the finest detail only as far
as two photographs agree about its place: detail a pixel beside it is a larger error than a blur.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import is_inside, project, sample, unproject
from gscompleter.numerics.image_ops import blur_gaussian
from gscompleter.render.protocols import Renderer
from gscompleter.types import Camera, DepthMap, Gaussians, Render, View

COLOR_DEPTH_TOLERANCE = 0.03
"""Relative depth difference at which the share of a photograph's colour falls to 1/e."""
DETAIL_SIGMA = 1.6
"""Standard deviation of the blur that takes detail away, in pixels."""
WINDOW_SIGMA = 2.0
"""Standard deviation of the window in which detail is compared, in pixels."""
MIN_SHARED = 0.3
"""Share of that window that both photographs have to show."""
UNCONFIRMED_DETAIL = 0.6
"""Share of its detail that a photograph shows where no other one can confirm it; about what
bilinear sampling keeps of the finest octave."""
LEAST_DETAIL = 1e-5
"""Sum of squared colour differences in a window up to which there is no detail."""
ONE_PLACE = 2.0**-16
"""Distance of cameras up to which they stand in one place, relative to the most distant camera.
Stereo rounds places to as much of the widest baseline."""


@dataclass(frozen=True)
class WarpedPhotograph:
    """A photograph warped to another camera, without a decision about what that camera sees."""

    image: Float[Tensor, "h w 3"]
    share: Float[Tensor, "h w"]
    """Share in [0, 1] with which it shows the surface that the other camera sees."""


def make_virtual_views(
    scene: Gaussians, views: Sequence[View], depths: Sequence[DepthMap], renderer: Renderer
) -> list[View]:
    """Warp each photograph to a camera beyond it, through the depth of `scene` there.

    The camera continues the way from the nearest other photograph, which has to confirm the detail.
    `depths` are those of the scene at the photographs, of which two or more stand apart. Their
    masks are not read: ignored pixels are those of a render already.
    """
    cameras = [view.camera for view in views]
    virtual = []
    for view, depth in zip(views, depths, strict=True):
        nearest = find_nearest_camera(view.camera, cameras)
        camera = extrapolate_camera(cameras[nearest], view.camera)
        # Backward warps: the depth that the scene draws in the virtual camera says where each of
        # its pixels lies in a photograph.
        shown = renderer.render(scene, camera)
        own = warp(view, depth, shown, camera)
        other = warp(views[nearest], depths[nearest], shown, camera)
        virtual.append(View(blend(confirm_detail(own, other), own.share, shown), camera))
    return virtual


def find_nearest_camera(camera: Camera, cameras: Sequence[Camera]) -> int:
    """Find the index of the nearest of `cameras` that stands in another place."""
    distances = torch.stack([(camera.center - other.center).norm() for other in cameras])
    # Cameras in one place, such as those of a panorama, give no direction to go on in. Their
    # centres may differ by rounding.
    is_apart = distances > ONE_PLACE * distances.max()
    return int(torch.where(is_apart, distances, torch.inf).argmin())


def extrapolate_camera(before: Camera, camera: Camera) -> Camera:
    """Continue the motion from `before` to `camera` by as much again."""
    rotation = camera.c2w[:3, :3]
    c2w = camera.c2w.clone()
    # Cameras that move on without turning were slightly worse (decision 043).
    c2w[:3, :3] = rotation @ before.c2w[:3, :3].T @ rotation
    c2w[:3, 3] = 2 * camera.center - before.center
    return replace(camera, c2w=c2w)


def warp(view: View, own: DepthMap, shown: Render, camera: Camera) -> WarpedPhotograph:
    """Warp a photograph with depth `own` to `camera`, through the depth of its render `shown`."""
    pixels, z = project(unproject(shown.depth, camera), view.camera)
    # Places outside of the photograph are moved to its border. Points beside the camera project to
    # places without a bound, at which bicubic weights are not finite.
    x, y = pixels.unbind(dim=-1)
    near = torch.stack([x.clamp(0, view.camera.width), y.clamp(0, view.camera.height)], dim=-1)
    # Bilinear samples would lose a third of the finest octave.
    image = sample(view.image, near, "bicubic")
    layers = torch.stack([own.depth, own.valid.to(own.depth)], dim=-1)
    depth, valid = sample(layers, pixels).unbind(dim=-1)

    # Where another surface hides this one in the photograph, the two depths differ.
    error = (z - depth) / (COLOR_DEPTH_TOLERANCE * z.abs().clamp_min(1e-12))
    seen = (shown.alpha >= COVERED) & is_inside(pixels, z, view.camera) & (valid >= 0.5)
    return WarpedPhotograph(image, torch.exp(-error.square()) * seen)


def confirm_detail(own: WarpedPhotograph, other: WarpedPhotograph) -> Float[Tensor, "h w 3"]:
    """Return the image of `own`, with its detail weakened where `other` does not have it.

    Detail counts by its correlation with that of the other photograph: an estimate of the share of
    the detail that both have in the same place.
    """
    smooth = blur_gaussian(own.image, DETAIL_SIGMA)
    detail = own.image - smooth
    other_detail = other.image - blur_gaussian(other.image, DETAIL_SIGMA)

    # Both sums of squares, the sum of products and what both photographs show, in one blur.
    shared = own.share * other.share
    products = (detail.square(), other_detail.square(), detail * other_detail)
    sums = [shared * product.sum(dim=-1) for product in products]
    own_energy, other_energy, product, covered = blur_gaussian(
        torch.stack([*sums, shared], dim=-1), WINDOW_SIGMA
    ).unbind(dim=-1)
    energy = (own_energy * other_energy).clamp_min(0).sqrt() + LEAST_DETAIL
    correlation = (product / energy).clamp(0, 1)
    confirmed = correlation.where(covered > MIN_SHARED, UNCONFIRMED_DETAIL)
    return smooth + confirmed[..., None] * detail


def blend(
    warped: Float[Tensor, "h w 3"], share: Float[Tensor, "h w"], shown: Render
) -> Float[Tensor, "h w 3"]:
    """Blend a warped photograph with the render, whose colours stay where it shows nothing."""
    # Where the scene ends it is half transparent, and a completion adds what is behind. Gaussians
    # that had to show all of the photograph's colour alone would be too bright with it (decision
    # 043).
    wanted = shown.alpha[..., None] * warped
    return (shown.image + share[..., None] * (wanted - shown.image)).clamp(0, 1)
