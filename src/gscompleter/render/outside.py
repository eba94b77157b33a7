"""A splat as it is seen from outside, all around, and the visual hull of its silhouettes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import look_along, project_mask, quats_to_rotations
from gscompleter.numerics.image_ops import dilate, is_enclosed, label_regions
from gscompleter.render.lod import MAX_PREVIEW_GAUSSIANS, thin_gaussians
from gscompleter.render.protocols import Renderer
from gscompleter.render.view_map import get_view_map
from gscompleter.types import Camera, Gaussians, Render

EXTENT_QUANTILES = (0.02, 0.98)
"""Quantiles of the coordinates, weighted by opacity, between which the extent lies."""
NUM_COMPARED_MEANS = 2000
"""Means that stand for all in the search of the smallest box."""
OUTSIDE_SEED = 0
"""Seed of this search."""
NUM_TURNS = 300
"""Boxes of its first round, which are turned at random."""
NUM_BEST = 6
"""Smallest boxes that are kept from round to round."""
NUM_RANDOM_TURNS = 40
"""Random turns of each of them in a round."""
REACHES = (0.15, 0.05, 0.02, 0.007)
"""Standard deviations of these turns in the rounds after the first, about each of three axes and in
half radians: a small turn by an angle has half of it in its quaternion."""
DISTANCE = 4.0
"""Distance of the cameras from the middle, in radii of the extent: twice its diagonal."""
FIELD = 2.0
"""Half of the width that an image shows at the middle, in radii of the extent."""
OUTSIDE_NEAR = 1.0
"""`near` of these cameras, in radii of the extent, which begins at 3 of them. Renderers clip at a
hundredth of it: a floater close before a camera is drawn, and hides what is behind it."""
SLACK = 1
"""Pixels by which a silhouette is dilated, since Gaussians on its rim reach out of it."""


@dataclass(frozen=True)
class Extent:
    """The smallest box in which a splat lies, without its outliers."""

    center: Float[Tensor, "3"]
    half: Float[Tensor, "3"]
    """Half of the sides of the box, in scene units; the shortest first."""
    axes: Float[Tensor, "3 3"]
    """Unit directions of its sides, in rows, in the same order."""

    @property
    def radius(self) -> float:
        """Half of the diagonal, in scene units."""
        return max(self.half.norm().item(), 1e-12)


@dataclass(frozen=True)
class OutsideView:
    """A splat as a camera outside of it sees it."""

    camera: Camera
    render: Render

    @property
    def silhouette(self) -> Bool[Tensor, "h w"]:
        """Pixels that show the splat."""
        return self.render.alpha >= COVERED

    @property
    def border_share(self) -> float:
        """Share of the border of the image that shows the splat."""
        shown = self.silhouette
        border = torch.cat([shown[0], shown[-1], shown[:, 0], shown[:, -1]])
        return border.float().mean().item()


def measure_extent(scene: Gaussians) -> Extent:
    """Measure the extent of a splat, in which each Gaussian counts by its opacity.

    The axes of a file may have any direction in its scene. Of the boxes that are turned at random,
    and of the best of them turned a little, the smallest lies along walls and floor. Only the
    centres of Gaussians count, not their sizes.
    """
    points = sample_by_opacity(scene)
    generator = torch.Generator().manual_seed(OUTSIDE_SEED)
    draws = torch.randn((NUM_TURNS, 4), generator=generator)
    turns = torch.cat([torch.eye(3)[None], quats_to_rotations(draws)])
    for reach in REACHES:
        best = turns[measure_volumes(points, turns).topk(NUM_BEST, largest=False).indices]
        steps = reach * torch.randn((NUM_BEST, NUM_RANDOM_TURNS, 4), generator=generator)
        # With a real part of 1 and small other parts: small turns.
        steps[..., 0] = 1.0
        turned = quats_to_rotations(steps) @ best[:, None]
        turns = torch.cat([best, turned.reshape(-1, 3, 3)])
    axes = turns[measure_volumes(points, turns).argmin()]
    low, high = (points @ axes.T).quantile(torch.tensor(EXTENT_QUANTILES), dim=0)
    # In one order, so that what follows is the same whatever the axes of the file are.
    order = (high - low).argsort()
    low, high, axes = low[order], high[order], axes[order]
    extent = Extent((low + high) / 2 @ axes, (high - low) / 2, axes)
    return Extent(*(value.to(scene.means) for value in vars(extent).values()))


def sample_by_opacity(scene: Gaussians) -> Float[Tensor, "n 3"]:
    """Sample means on the CPU, each as often as its opacity says.

    `NUM_COMPARED_MEANS` steps of one length through the running sum of opacities: no random number
    takes part.
    """
    sums = scene.opacities.double().cpu().cumsum(0)
    steps = (torch.arange(NUM_COMPARED_MEANS) + 0.5) / NUM_COMPARED_MEANS * sums[-1]
    rows = torch.searchsorted(sums, steps).clamp_max(len(scene) - 1)
    return scene.means.cpu()[rows]


def measure_volumes(
    points: Float[Tensor, "n 3"], turns: Float[Tensor, "t 3 3"]
) -> Float[Tensor, "t"]:
    """Measure the volume of the box that holds points, along each triple of axes."""
    turned = torch.einsum("tij,nj->tin", turns, points)
    low, high = compute_quantiles(turned, EXTENT_QUANTILES)
    return (high - low).prod(dim=1)


def compute_quantiles(
    values: Float[Tensor, "t i n"], shares: Sequence[float]
) -> list[Float[Tensor, "t i"]]:
    """Compute quantiles of the last axis on the CPU, to the bit as `torch.quantile`.

    NumPy sorts in a tenth of its time.
    """
    ordered = torch.from_numpy(np.sort(values.contiguous().numpy(), axis=-1))
    ranks = torch.tensor(shares) * (values.shape[-1] - 1)
    below = ordered[..., ranks.floor().long()]
    above = ordered[..., ranks.ceil().long()]
    return list(below.lerp(above, ranks - ranks.floor()).unbind(dim=-1))


def list_directions() -> Float[Tensor, "12 3"]:
    """List the directions of the vertices of an icosahedron, which are spread evenly."""
    golden = (1 + 5**0.5) / 2
    corners = []
    for short, long in product((-1.0, 1.0), (-golden, golden)):
        corners += [(0.0, short, long), (short, long, 0.0), (long, 0.0, short)]
    return normalize(torch.tensor(corners), dim=1)


def look_from_outside(
    scene: Gaussians, renderer: Renderer, side: int, extent: Extent | None = None
) -> list[OutsideView]:
    """Render a splat from twelve directions about its box.

    Images have `side` pixels along each side, and show twice the diameter of the extent: around an
    object they are empty at their borders. The extent is measured if it is not given.
    """
    small = thin_gaussians(scene, MAX_PREVIEW_GAUSSIANS)

    def look(camera: Camera) -> OutsideView:
        return OutsideView(camera, renderer.render(small, camera))

    cameras = list_outside_cameras(extent or measure_extent(scene), side)
    return list(get_view_map(scene.means)(look, cameras))


def list_outside_cameras(extent: Extent, side: int) -> list[Camera]:
    """List the cameras of `look_from_outside`."""
    # Along the sides of the box, not along the axes of the file, which may be turned.
    directions = list_directions().to(extent.center) @ extent.axes
    half = FIELD / DISTANCE
    return [
        place_outside_camera(
            extent.center + DISTANCE * extent.radius * direction,
            -direction,
            half,
            side,
            OUTSIDE_NEAR * extent.radius,
        )
        for direction in directions
    ]


def place_outside_camera(
    center: Float[Tensor, "3"], forward: Float[Tensor, "3"], half: float, side: int, near: float
) -> Camera:
    """Place a camera with a square image, whose border is `half` aside at a depth of 1.

    `near` is that of `Camera`, in scene units.
    """
    focal = side / 2 / half
    K = torch.tensor([[focal, 0.0, side / 2], [0.0, focal, side / 2], [0.0, 0.0, 1.0]])
    c2w = torch.eye(4).to(center)
    c2w[:3, 3] = center
    # Any axis that is not parallel to the direction: nothing here depends on what is up.
    up = torch.eye(3).to(center)[int(forward.abs().argmin())]
    return look_along(Camera(c2w, K.to(center), side, side, near=near), forward, up)


def find_in_hull(gaussians: Gaussians, views: Sequence[OutsideView]) -> Bool[Tensor, "n"]:
    """Find Gaussians in the visual hull: every view sees them in the silhouette of the splat.

    Gaps that the splat encloses in an image belong to the silhouette. A hole that was cut through a
    surface is such a gap where it is looked through, and has to be filled.
    """
    inside = torch.ones_like(gaussians.opacities, dtype=torch.bool)
    for view in views:
        filled = dilate(fill_enclosed(view.silhouette), SLACK)
        inside &= project_mask(filled, gaussians, view.camera)
    return inside


def fill_enclosed(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Fill the gaps of a mask that do not reach the border of the image."""
    labels, count = label_regions(~mask)
    filled = mask
    for label in range(1, count):
        region = labels == label
        if is_enclosed(region):
            filled = filled | region
    return filled
