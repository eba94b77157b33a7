"""Colours of many photographs by direction: each photograph keeps its own where it stands.

What photographs show of a surface differs by exposure, reflections, and errors of depth and pose.
One colour for all directions is their mean, which is right at none of them. So the colour of a
Gaussian is linear in the unit ray towards it, in all three components; `directional_colors` is the
same for two photographs, whose rays span one line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.reconstructors.plane_sweep.directional_colors import (
    DAMPED_BLEND_WEIGHT,
    VIRTUAL_WEIGHT,
)
from gscompleter.reconstructors.plane_sweep.virtual_views import make_virtual_views
from gscompleter.render.protocols import ColorSums, Renderer
from gscompleter.render.spherical_harmonics import SH_C1
from gscompleter.render.view_map import get_view_map
from gscompleter.types import SH_C0, DepthMap, Gaussians, View

LINEAR_PENALTY = 0.1
"""Cost of a squared colour change between the middle and the ray of a photograph, against a squared
difference in the images. A tenth of that of two photographs, as many rays determine the change."""
LINEAR_ANGLE = 0.1
"""Angle in radians, from the middle to the ray of a photograph, at which that cost is doubled. It
is wide, as cheap changes between rays that lie close together lose up to two decibels in cameras
that stand far off all photographs."""
LINEAR_RELAXATIONS = (2.0,), (2.5, 1.0)
"""Step sizes of the rounds on the photographs alone, then on all. Twice as many take 1.18 times the
time of the context of five photographs, and gain 0.03 dB beside them."""


@dataclass(frozen=True)
class LinearColors:
    """Colours that are linear in the ray: `colors + (ray - reference) @ gradients`."""

    reference: Float[Tensor, "n 3"]
    """Unit rays from the middle of all photographs."""
    colors: Float[Tensor, "n 3"]
    gradients: Float[Tensor, "n 3 3"]
    """Colour change [channel] per component of the ray [axis, channel]."""

    def evaluate(self, offsets: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Evaluate the colours at rays that differ by `offsets` from the reference."""
        return self.colors + (offsets[..., None] * self.gradients).sum(dim=1)

    def change(
        self, color_step: Float[Tensor, "n 3"], gradient_step: Float[Tensor, "n 3 3"]
    ) -> LinearColors:
        """Add steps to colours and gradients."""
        return replace(
            self, colors=self.colors + color_step, gradients=self.gradients + gradient_step
        )

    def to_sh(self) -> Float[Tensor, "n 4 3"]:
        """Convert to spherical harmonics of degree 1.

        The constant part goes into degree 0; the harmonics of degree 1 are -y, z and -x of the ray
        times `SH_C1`.
        """
        at_zero = self.evaluate(-self.reference)
        x, y, z = self.gradients.unbind(dim=1)
        return torch.stack([(at_zero - 0.5) / SH_C0, -y / SH_C1, z / SH_C1, -x / SH_C1], dim=1)


@dataclass(frozen=True)
class FittedImage:
    """An image to fit to, with the weight of its pixels."""

    view: View
    weight: float


@dataclass(frozen=True)
class Moments:
    """Moments of the weighted offsets of all images, per Gaussian."""

    total: Float[Tensor, "n 1"]
    first: Float[Tensor, "n 3"]
    second: Float[Tensor, "n 3 3"]

    @property
    def covariance(self) -> Float[Tensor, "n 3 3"]:
        """Covariance of the rays, weighted by how much the images show of the Gaussian."""
        total = self.total.clamp_min(DAMPED_BLEND_WEIGHT)
        # Up to DAMPED_WEIGHT hardly any image shows a Gaussian, and the division would blow up.
        mean = self.first / total
        return self.second / total[..., None] - multiply_outer(mean, mean)


@dataclass(frozen=True)
class LinearColorFit:
    """The fit of the colours of a scene to images."""

    scene: Gaussians
    reference: Float[Tensor, "n 3"]
    renderer: Renderer

    def compute_offsets(
        self, view: View, rows: Int[Tensor, "shown"] | slice = slice(None)
    ) -> Float[Tensor, "shown 3"]:
        """Compute how the unit rays of a camera to some Gaussians differ from the reference."""
        rays = normalize(self.scene.means[rows] - view.camera.center, dim=-1)
        return rays - self.reference[rows]

    def measure_moments(
        self, images: Sequence[FittedImage], weights: Sequence[Float[Tensor, "n"]]
    ) -> Moments:
        """Sum the moments over images; `weights` are what each shows of the Gaussians."""
        total = torch.zeros_like(self.reference[:, :1])
        first = torch.zeros_like(self.reference)
        second = torch.zeros_like(first)[..., None].repeat(1, 1, 3)
        for image, seen in zip(images, weights, strict=True):
            rows = find_shown_rows(seen)
            offsets = self.compute_offsets(image.view, rows)
            weighted = seen[rows, None] * offsets
            total += seen[:, None]
            first[rows] += weighted
            second[rows] += multiply_outer(weighted, offsets)
        return Moments(total, first, second)

    def improve(
        self,
        start: LinearColors,
        images: Sequence[FittedImage],
        spread: Float[Tensor, "n 3 3"] | None,
        relaxations: Sequence[float],
    ) -> tuple[LinearColors, Float[Tensor, "n 3 3"]]:
        """Improve the colours by steps of block Jacobi; also return the spread of the rays.

        With a relaxation of 1 a step minimizes an upper bound in which every Gaussian stands alone.
        `spread` is the covariance of the rays of the photographs, None if `images` are these.
        """

        # The lists of Gaussians of an image are made anew in each round: kept, those of eight
        # photographs of 350 x 630 pixels take 1.2 GB, and save no time that can be measured.
        def measure(image: FittedImage) -> ColorSums:
            errors = self.renderer.freeze(self.scene[:0], image.view.camera).vary_colors(self.scene)
            shown = colors.evaluate(self.compute_offsets(image.view))
            residual, seen = errors(shown, image.view.image)
            return image.weight * residual, image.weight * seen

        colors = start
        equations = None
        for relaxation in relaxations:
            color_pull = torch.zeros_like(start.colors)
            turning = torch.zeros_like(start.gradients)
            weights = []
            sums = get_view_map(color_pull)(measure, images)
            for image, (residual, seen) in zip(images, sums, strict=True):
                rows = find_shown_rows(seen)
                color_pull += residual
                turning[rows] += multiply_outer(
                    self.compute_offsets(image.view, rows), residual[rows]
                )
                weights.append(seen)
            if equations is None:
                # What the images show of a Gaussian does not depend on its colours.
                moments = self.measure_moments(images, weights)
                spread = moments.covariance if spread is None else spread
                equations = ColorEquations.build(moments, spread)
            color_step, gradient_step = equations.solve(color_pull, turning, colors.gradients)
            colors = colors.change(relaxation * color_step, relaxation * gradient_step)
        assert spread is not None
        return colors, spread


@dataclass(frozen=True)
class ColorEquations:
    """Normal equations of each Gaussian, for its changes of colour c and gradient G.

    [total    first' ] [c]   [color pull               ]
    [first    square ] [G] = [turning - damping @ G now]
    """

    total: Float[Tensor, "n 1"]
    first: Float[Tensor, "n 3"]
    damping: Float[Tensor, "n 3 3"]
    inverse: Float[Tensor, "n 3 3"]
    """Inverse of the Schur complement square - first first' / total."""

    @staticmethod
    def build(moments: Moments, spread: Float[Tensor, "n 3 3"]) -> ColorEquations:
        """Build the equations; a colour change as wide as the rays of the photographs costs."""
        total = moments.total.clamp_min(DAMPED_BLEND_WEIGHT)
        smallest = LINEAR_ANGLE**2 * torch.eye(3, device=total.device)
        damping = LINEAR_PENALTY * total[..., None] * (spread + smallest)
        square = moments.second + damping
        complement = square - multiply_outer(moments.first, moments.first / total)
        return ColorEquations(total, moments.first, damping, invert_3x3(complement))

    def solve(
        self,
        color_pull: Float[Tensor, "n 3"],
        turning: Float[Tensor, "n 3 3"],
        gradients: Float[Tensor, "n 3 3"],
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
        """Solve for the changes of colour and gradient."""
        # The colour is eliminated first, so that only a 3 x 3 system is left for the gradient.
        pull = turning - self.damping @ gradients
        reduced = pull - multiply_outer(self.first, color_pull / self.total)
        gradient_step = self.inverse @ reduced
        along = (self.first[..., None] * gradient_step).sum(dim=1)
        return (color_pull - along) / self.total, gradient_step


def fit_linear_colors(
    scene: Gaussians,
    views: Sequence[View],
    depths: Sequence[DepthMap],
    renderer: Renderer,
    weights: Sequence[float] | None = None,
) -> Gaussians:
    """Fit colours that are linear in the direction to photographs and as many virtual ones.

    `depths` are those of the scene at the photographs. `weights` say how much each photograph
    counts, by default all alike. They have one exposure.
    """
    # Rays, in world axes, are taken relative to those from the middle of the cameras: they differ
    # by angles of some hundredths, whose squares float32 would lose beside rays of length 1.
    middle = torch.stack([view.camera.center for view in views]).mean(dim=0)
    reference = normalize(scene.means - middle, dim=-1)
    fit = LinearColorFit(scene, reference, renderer)
    virtual = make_virtual_views(scene, views, depths, renderer)
    weights = weights or [1.0] * len(views)
    photographs = [FittedImage(view, weight) for view, weight in zip(views, weights, strict=True)]
    # Each virtual photograph shows what one of the photographs does.
    of_virtual = [VIRTUAL_WEIGHT * weight for weight in weights]
    all_images = [*photographs, *map(FittedImage, virtual, of_virtual)]

    constant = scene.sh[:, 0] * SH_C0 + 0.5
    colors = LinearColors(reference, constant, torch.zeros_like(constant)[:, None].repeat(1, 3, 1))
    # Photographs first, then all, as for two (decision 043).
    colors, spread = fit.improve(colors, photographs, None, LINEAR_RELAXATIONS[0])
    colors, _ = fit.improve(colors, all_images, spread, LINEAR_RELAXATIONS[1])
    return replace(scene, sh=colors.to_sh())


def find_shown_rows(seen: Float[Tensor, "n"]) -> Int[Tensor, "shown"] | slice:
    """Find the rows of the Gaussians that an image shows: few, where images are many.

    On a GPU these are all rows, since it would have to be waited for their number.
    """
    return torch.nonzero(seen)[:, 0] if seen.device.type == "cpu" else slice(None)


def multiply_outer(a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """Multiply each row of `a`, as a column, by that of `b`."""
    return a[:, :, None] * b[:, None, :]


def invert_3x3(matrices: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    """Invert positive definite matrices by their cofactors, faster than a solver of any size."""
    # The rows of the cofactors are cross products of the rows, and the matrix is symmetric.
    a, b, c = matrices.unbind(dim=1)
    cofactors = torch.stack(
        [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=1
    )
    determinants = (a * cofactors[:, 0]).sum(dim=-1)
    return cofactors / determinants[:, None, None]
