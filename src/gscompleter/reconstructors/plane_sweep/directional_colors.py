"""Colours of two photographs by direction: each keeps its own, and cameras beyond see the nearer's.

What a photograph shows depends on exposure, reflections, and errors of depth and pose. So a colour
may change linearly with the direction, between the rays to the two photographs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.reconstructors.plane_sweep.virtual_views import make_virtual_views
from gscompleter.render import ColorErrors, Renderer
from gscompleter.render.spherical_harmonics import linear_colors_to_sh
from gscompleter.types import SH_C0, Camera, Gaussians, View

VIRTUAL_WEIGHT = 0.5
"""Weight of a pixel of a virtual photograph, against one of a photograph."""
SLOPE_PENALTY = 0.0006
"""Cost of a squared colour change per radian, against a squared colour difference in the images."""
RELAXATIONS = 3.0, 1.0, 2.5, 1.0
"""Step size of each round; long steps in turn with short ones converge faster (Richardson 1911)."""
MIN_WEIGHT = 0.05
"""Summed weight up to which colours are damped, as hardly any image shows them."""


@dataclass(frozen=True)
class ColorLine:
    """Direction, per Gaussian, along which its colour changes."""

    middle: Float[Tensor, "n 3"]
    """Mean of the unit rays from two photographs."""
    axis: Float[Tensor, "n 3"]
    """Half of their difference: the ray of the second is `middle + axis`."""
    squared_angle: Float[Tensor, "n"]
    """Squared length of the axis, in squared radians."""

    @staticmethod
    def between(scene: Gaussians, first: Camera, second: Camera) -> ColorLine:
        """Return the line between the rays of two cameras."""
        start, end = (normalize(scene.means - c.center, dim=-1) for c in (first, second))
        axis = (end - start) / 2
        return ColorLine((start + end) / 2, axis, axis.square().sum(dim=-1).clamp_min(1e-12))

    def locate(self, scene: Gaussians, camera: Camera) -> Float[Tensor, "n"]:
        """Locate the rays of a camera on the lines: -1 and 1 are those of the two cameras."""
        rays = normalize(scene.means - camera.center, dim=-1)
        return ((rays - self.middle) * self.axis).sum(dim=-1) / self.squared_angle

    def to_sh(
        self, colors: Float[Tensor, "n 3"], slopes: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 4 3"]:
        """Convert colours at position 0, and their slopes, to spherical harmonics."""
        per_radian = self.axis / self.squared_angle[:, None]
        return linear_colors_to_sh(colors, self.middle, per_radian[..., None] * slopes[:, None])


@dataclass(frozen=True)
class WeightedImage:
    """An image to fit to, and where its rays are on the lines."""

    errors: ColorErrors
    image: Float[Tensor, "h w 3"]
    weight: float
    position: Float[Tensor, "n"]

    def backproject(
        self, colors: Float[Tensor, "n 3"], slopes: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Backproject the weighted residual at given colours, and the weights."""
        residual, seen = self.errors(colors + self.position[:, None] * slopes, self.image)
        return self.weight * residual, self.weight * seen


def fit_directional_colors(
    scene: Gaussians, views: Sequence[View], renderer: Renderer
) -> Gaussians:
    """Fit colours that are linear in the direction to two photographs and two virtual ones.

    Each round minimizes an upper bound in which every Gaussian stands alone, as in SIRT.
    """
    line = ColorLine.between(scene, views[0].camera, views[1].camera)
    weighted = [(view, 1.0) for view in views]
    weighted += [(view, VIRTUAL_WEIGHT) for view in make_virtual_views(scene, views, renderer)]
    images = [
        WeightedImage(
            renderer.freeze(scene[:0], view.camera).vary_colors(scene),
            view.image,
            weight,
            line.locate(scene, view.camera),
        )
        for view, weight in weighted
    ]
    colors, slopes = solve_colors(images, scene.sh[:, 0] * SH_C0 + 0.5, line.squared_angle)
    return replace(scene, sh=line.to_sh(colors, slopes))


def solve_colors(
    images: Sequence[WeightedImage],
    colors: Float[Tensor, "n 3"],
    squared_angle: Float[Tensor, "n"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Solve for colours and slopes by block Jacobi with varying relaxation, slopes damped."""
    slopes = torch.zeros_like(colors)
    for relaxation in RELAXATIONS:
        residuals, seen = zip(*(i.backproject(colors, slopes) for i in images), strict=True)
        at = [image.position[:, None] for image in images]
        total = torch.stack(seen).sum(0).clamp_min(MIN_WEIGHT)[:, None]
        cross = sum(w[:, None] * s for w, s in zip(seen, at, strict=True))
        damping = SLOPE_PENALTY * total / squared_angle[:, None]
        square = sum(w[:, None] * s * s for w, s in zip(seen, at, strict=True)) + damping
        pull = torch.stack(residuals).sum(0)
        turn = sum(r * s for r, s in zip(residuals, at, strict=True)) - damping * slopes
        step = relaxation / (total * square - cross * cross)
        colors = colors + step * (square * pull - cross * turn)
        slopes = slopes + step * (total * turn - cross * pull)
    return colors, slopes
