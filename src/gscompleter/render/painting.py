"""Renders of Gaussians in other colours, which expose their compositing weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.render import ColourSums, LooksError
from gscompleter.types import Gaussians, sh_from_rgb


def painted(gaussians: Gaussians, colours: Float[Tensor, "n 3"]) -> Gaussians:
    """Give Gaussians colours that are the same from every direction."""
    return replace(gaussians, sh=sh_from_rgb(colours), encoded=None)


def grey(values: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """Repeat each value in three channels."""
    return values[:, None].expand(-1, 3)


def looking(
    gaussians: Gaussians, opacities: Float[Tensor, "n"], sh: Float[Tensor, "n k 3"]
) -> Gaussians:
    """Replace the opacities and spherical harmonics of Gaussians."""
    return replace(gaussians, opacities=opacities, sh=sh, encoded=None)


@dataclass(frozen=True)
class DrawnAnew:
    """An `AppearanceRender` that redraws the whole image at each call."""

    draw: Callable[[Float[Tensor, "n"], Float[Tensor, "n k 3"]], Float[Tensor, "h w 3"]]

    def __call__(
        self, opacities: Float[Tensor, "n"], sh: Float[Tensor, "n k 3"]
    ) -> Float[Tensor, "h w 3"]:
        """Render the image; differentiable."""
        return self.draw(opacities, sh)

    def compared(self, wanted: Float[Tensor, "h w 3"], weights: Float[Tensor, "h w"]) -> LooksError:
        """Make an error function: sum of `weights` (>= 0) times squared errors of all channels."""

        def error(opacities: Float[Tensor, "n"], sh: Float[Tensor, "n k 3"]) -> Float[Tensor, ""]:
            return (weights * (self.draw(opacities, sh) - wanted).square().sum(dim=-1)).sum()

        return error


def sums_by_slopes(
    draw: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "h w 3"]],
    gaussians: Gaussians,
    layers: Float[Tensor, "h w 3"],
) -> Float[Tensor, "n 3"]:
    """Sum `image` over the compositing weights of `gaussians`, by autograd through `render`.

    A compositing weight is the gradient of a pixel in the colour of the Gaussian.
    """
    with torch.enable_grad():
        colors = gaussians.means.new_full((len(gaussians), 3), 0.5).requires_grad_()
        (gradient,) = torch.autograd.grad((layers * draw(colors)).sum(), colors)
    return gradient


def errors_by_slopes(
    draw: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "h w 3"]],
    gaussians: Gaussians,
    colours: Float[Tensor, "n 3"],
    photograph: Float[Tensor, "h w 3"],
) -> ColourSums:
    """Implement `ColorErrors` by autograd; arguments as in `backproject_by_autograd`."""
    missing = photograph - draw(colours).detach()
    weights = sums_by_slopes(draw, gaussians, torch.ones_like(missing))[:, 0]
    return sums_by_slopes(draw, gaussians, missing), weights
