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
from gscompleter.render.protocols import ColorErrors, Renderer
from gscompleter.render.spherical_harmonics import SH_C1
from gscompleter.render.view_map import get_view_map
from gscompleter.types import SH_C0, Camera, DepthMap, Gaussians, View

VIRTUAL_WEIGHT = 0.45
"""Weight of a pixel of a virtual photograph, against one of a photograph."""
DIRECTIONAL_PENALTY = 1.0
"""Cost of a squared colour change between middle and photograph, against a squared difference in
the images."""
DIRECTIONAL_ANGLE = 0.015
"""Angle in radians, from the middle to the ray of a photograph, at which that cost is doubled."""
DIRECTIONAL_RELAXATIONS = (4.0, 1.0), (5.0, 1.0, 1.5, 1.0)
"""Step sizes of the rounds on the photographs alone, then on all (Richardson 1911). The long ones
restore fine detail, which converges slowest, and the others damp what they exaggerate."""
DAMPED_BLEND_WEIGHT = 0.05
"""Summed weight up to which colours are damped, as hardly any image shows them."""

Colors = Float[Tensor, "n 3"]


@dataclass(frozen=True)
class ColorLine:
    """Directions, one per Gaussian, along which the colours change."""

    middle: Float[Tensor, "n 3"]
    """Mean of the unit rays from two photographs."""
    axis: Float[Tensor, "n 3"]
    """Half of their difference: the ray of the second is `middle + axis`."""
    squared_angle: Float[Tensor, "n 1"]
    """Squared length of the axis, in squared radians."""

    @staticmethod
    def between(scene: Gaussians, first: Camera, second: Camera) -> ColorLine:
        """Return the line between the rays of two cameras."""
        start = normalize(scene.means - first.center, dim=-1)
        end = normalize(scene.means - second.center, dim=-1)
        axis = (end - start) / 2
        squared_angle = axis.square().sum(dim=-1, keepdim=True).clamp_min(1e-12)
        return ColorLine((start + end) / 2, axis, squared_angle)

    def locate(self, scene: Gaussians, camera: Camera) -> Float[Tensor, "n 1"]:
        """Locate the rays of a camera on the lines: -1 and 1 are those of the two cameras."""
        rays = normalize(scene.means - camera.center, dim=-1)
        return ((rays - self.middle) * self.axis).sum(dim=-1, keepdim=True) / self.squared_angle

    def to_sh(self, colors: Colors, gradients: Colors) -> Float[Tensor, "n 4 3"]:
        """Convert colours at position 0, and their gradients, to spherical harmonics.

        The position is (ray - middle) · axis / axis², so that the colour is linear in the ray. Its
        constant part goes into degree 0, and the rest into the three harmonics of degree 1, which
        are -y, z and -x of the ray times `SH_C1`.
        """
        x, y, z = (self.axis / self.squared_angle)[..., None].unbind(1)
        at_zero = colors - gradients * (self.middle * self.axis / self.squared_angle).sum(1, True)
        linear = [-y * gradients / SH_C1, z * gradients / SH_C1, -x * gradients / SH_C1]
        return torch.stack([(at_zero - 0.5) / SH_C0, *linear], dim=1)


@dataclass(frozen=True)
class WeightedImage:
    """An image to fit to, and where its rays are on the lines."""

    errors: ColorErrors
    image: Float[Tensor, "h w 3"]
    weight: float
    position: Float[Tensor, "n 1"]

    def backproject(self, colors: Colors, gradients: Colors) -> tuple[Colors, Float[Tensor, "n 1"]]:
        """Backproject the weighted residual at given colours, and the weights."""
        residual, seen = self.errors(colors + self.position * gradients, self.image)
        return self.weight * residual, self.weight * seen[:, None]


def fit_directional_colors(
    scene: Gaussians, views: Sequence[View], depths: Sequence[DepthMap], renderer: Renderer
) -> Gaussians:
    """Fit colours that are linear in the direction to two photographs and two virtual ones.

    `views` are the two photographs, and `depths` those of the scene at them. Returns the scene with
    harmonics of degree 1, which are made of its colours by degree 0 alone.
    """
    line = ColorLine.between(scene, views[0].camera, views[1].camera)

    def weigh(view: View, weight: float) -> WeightedImage:
        # Nothing is frozen around the scene: the colours of all of it vary.
        errors = renderer.freeze(scene[:0], view.camera).vary_colors(scene)
        return WeightedImage(errors, view.image, weight, line.locate(scene, view.camera))

    virtual = make_virtual_views(scene, views, depths, renderer)
    weights = [1.0] * len(views) + [VIRTUAL_WEIGHT] * len(virtual)
    all_images = list(get_view_map(scene.means)(weigh, [*views, *virtual], weights))
    photographs = all_images[: len(views)]

    # Photographs first, then all: as good as all in every round, and a quarter of the renders less;
    # the reverse order loses 0.3 to 0.5 dB (decision 043).
    colors = scene.sh[:, 0] * SH_C0 + 0.5
    gradients = torch.zeros_like(colors)
    for images, relaxations in zip((photographs, all_images), DIRECTIONAL_RELAXATIONS, strict=True):
        for relaxation in relaxations:
            colors, gradients = improve_colors(
                colors, gradients, images, line.squared_angle, relaxation
            )
    return replace(scene, sh=line.to_sh(colors, gradients))


def improve_colors(
    colors: Colors,
    gradients: Colors,
    images: Sequence[WeightedImage],
    squared_angle: Float[Tensor, "n 1"],
    relaxation: float,
) -> tuple[Colors, Colors]:
    """Improve colours and their gradients, which are damped, by a step of block Jacobi.

    With a relaxation of 1 it minimizes an upper bound in which every Gaussian stands alone.
    """
    sums = list(get_view_map(colors)(lambda image: image.backproject(colors, gradients), images))
    residuals = [residual for residual, _ in sums]
    weights = [weight for _, weight in sums]
    positions = [image.position for image in images]

    # Normal equations of each Gaussian, for its changes of colour c and gradient g:
    #     [total  cross ] [c]   [pull_color   ]
    #     [cross  square] [g] = [pull_gradient]
    total = torch.stack(weights).sum(0).clamp_min(DAMPED_BLEND_WEIGHT)
    damping = DIRECTIONAL_PENALTY * total * (1 + DIRECTIONAL_ANGLE**2 / squared_angle)
    cross = torch.stack([w * s for w, s in zip(weights, positions, strict=True)]).sum(0)
    square = torch.stack([w * s**2 for w, s in zip(weights, positions, strict=True)]).sum(0)
    square = square + damping
    pull_color = torch.stack(residuals).sum(0)
    turning = torch.stack([r * s for r, s in zip(residuals, positions, strict=True)]).sum(0)
    pull_gradient = turning - damping * gradients

    # Their solution by Cramer's rule.
    step = relaxation / (total * square - cross * cross)
    new_colors = colors + step * (square * pull_color - cross * pull_gradient)
    new_gradients = gradients + step * (total * pull_gradient - cross * pull_color)
    return new_colors, new_gradients
