"""Renders of Gaussians in other colours, which expose their compositing weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.render import AppearanceError, ColorSums
from gscompleter.types import Gaussians, sh_from_rgb


def set_colors(gaussians: Gaussians, colors: Float[Tensor, "n 3"]) -> Gaussians:
    """Give Gaussians colours that are the same from every direction."""
    return replace(gaussians, sh=sh_from_rgb(colors), encoded=None)


def to_grey(values: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """Repeat each value in three channels."""
    return values[:, None].expand(-1, 3)


def set_appearance(
    gaussians: Gaussians, opacities: Float[Tensor, "n"], sh: Float[Tensor, "n k 3"]
) -> Gaussians:
    """Replace the opacities and spherical harmonics of Gaussians."""
    return replace(gaussians, opacities=opacities, sh=sh, encoded=None)


@dataclass(frozen=True)
class FullRedraw:
    """An `AppearanceRender` that redraws the whole image at each call."""

    render: Callable[[Float[Tensor, "n"], Float[Tensor, "n k 3"]], Float[Tensor, "h w 3"]]

    def __call__(
        self, opacities: Float[Tensor, "n"], sh: Float[Tensor, "n k 3"]
    ) -> Float[Tensor, "h w 3"]:
        """Render the image; differentiable."""
        return self.render(opacities, sh)

    def make_error(
        self, wanted: Float[Tensor, "h w 3"], weights: Float[Tensor, "h w"]
    ) -> AppearanceError:
        """Make an error function: sum of `weights` (>= 0) times squared errors of all channels."""

        def error(opacities: Float[Tensor, "n"], sh: Float[Tensor, "n k 3"]) -> Float[Tensor, ""]:
            return (weights * (self.render(opacities, sh) - wanted).square().sum(dim=-1)).sum()

        return error


def backproject_by_autograd(
    render: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "h w 3"]],
    gaussians: Gaussians,
    image: Float[Tensor, "h w 3"],
) -> Float[Tensor, "n 3"]:
    """Sum `image` over the compositing weights of `gaussians`, by autograd through `render`.

    A compositing weight is the gradient of a pixel in the colour of the Gaussian.
    """
    with torch.enable_grad():
        colors = gaussians.means.new_full((len(gaussians), 3), 0.5).requires_grad_()
        (gradient,) = torch.autograd.grad((image * render(colors)).sum(), colors)
    return gradient


def backproject_errors_by_autograd(
    render: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "h w 3"]],
    gaussians: Gaussians,
    colors: Float[Tensor, "n 3"],
    photograph: Float[Tensor, "h w 3"],
) -> ColorSums:
    """Implement `ColorErrors` by autograd; arguments as in `backproject_by_autograd`."""
    missing = photograph - render(colors).detach()
    weights = backproject_by_autograd(render, gaussians, torch.ones_like(missing))[:, 0]
    return backproject_by_autograd(render, gaussians, missing), weights
