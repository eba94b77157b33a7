"""A frozen scene that is redrawn at each call, for renderers that have nothing faster."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gscompleter.numerics.geometry import move_to_depths
from gscompleter.render.protocols import (
    ColorErrors,
    ColorSums,
    DepthRender,
    FrozenScene,
    JointScene,
    OpacityRender,
    Renderer,
)
from gscompleter.types import Camera, Gaussians, Render, merge, sh_from_rgb

ColorRender = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "h w 3"]]
"""Renders an image of Gaussians in given colours."""


@dataclass(frozen=True)
class RedrawnScene:
    """A `FrozenScene` of any renderer, by rendering and autograd alone."""

    renderer: Renderer
    scene: Gaussians
    camera: Camera

    @cached_property
    def render(self) -> Render:
        """The render of the scene alone."""
        with torch.no_grad():
            return self.renderer.render(self.scene, self.camera)

    def extend(self, new: Gaussians) -> RedrawnScene:
        """Add `new` to the scene."""
        return replace(self, scene=merge([self.scene, new]))

    def freeze_occluders(self, others: Gaussians) -> FrozenScene:
        """Freeze `others`, all of them."""
        return self.renderer.freeze(others, self.camera)

    def repaint(self, rows: Int64[Tensor, "m"], painted: Gaussians) -> RedrawnScene:
        """Give Gaussians of the scene the harmonics of `painted`."""
        sh = self.scene.sh.index_copy(0, rows, painted.sh.to(self.scene.sh))
        return replace(self, scene=replace(self.scene, sh=sh))

    def backproject(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        """Sum `image` over the compositing weights of each Gaussian of the scene."""
        return backproject(self._render_colors, self.scene, image)

    def splat(self, values: Float[Tensor, "n"]) -> Float[Tensor, "h w"]:
        """Render the visible Gaussians with the values as grey."""
        return self._render_colors(values[:, None].expand(-1, 3))[..., 0]

    def _render_colors(self, colors: Float[Tensor, "n 3"]) -> Float[Tensor, "h w 3"]:
        return self.renderer.render(set_colors(self.scene, colors), self.camera).image

    def composite(self, new: Gaussians) -> Render:
        """Render the visible Gaussians and `new`."""
        return self.renderer.render(merge([self.scene, new]), self.camera)

    def vary_opacities(self, new: Gaussians, is_fading: bool = False) -> OpacityRender:
        """Fix all of `new` but the opacities."""
        return lambda opacities: self.composite(replace(new, opacities=opacities))

    def vary_colors(self, new: Gaussians) -> ColorErrors:
        """Fix all of `new` but its colours."""

        def render(colors: Float[Tensor, "n 3"]) -> Float[Tensor, "h w 3"]:
            return self.composite(set_colors(new, colors)).image

        def errors(colors: Float[Tensor, "n 3"], photograph: Float[Tensor, "h w 3"]) -> ColorSums:
            # Weights are those of an image of ones; all three channels have the same.
            missing = photograph - render(colors).detach()
            weights = backproject(render, new, torch.ones_like(missing))[:, 0]
            return backproject(render, new, missing), weights

        return errors

    def vary_depths(self, new: Gaussians) -> DepthRender:
        """Fix all of `new` but its depths."""
        return lambda depths: self.composite(move_to_depths(new, self.camera, depths))


def composite_beside(
    frozen: FrozenScene, new: Gaussians, renderer: Renderer, other: Camera
) -> tuple[Render, Render]:
    """Render a scene with `new`, and `new` alone from another camera; at once where possible."""
    if isinstance(frozen, JointScene):
        return frozen.composite_beside(new, other)
    return frozen.composite(new), renderer.render(new, other)


def make_empty_render(camera: Camera, device: torch.device) -> Render:
    """Render nothing."""
    empty = torch.zeros(camera.height, camera.width, device=device)
    return Render(empty[..., None].expand(-1, -1, 3), empty, empty)


def set_colors(gaussians: Gaussians, colors: Float[Tensor, "n 3"]) -> Gaussians:
    """Give Gaussians colours that are the same from every direction."""
    return replace(gaussians, sh=sh_from_rgb(colors), encoded=None)


def backproject(
    render: ColorRender, gaussians: Gaussians, image: Float[Tensor, "h w 3"]
) -> Float[Tensor, "n 3"]:
    """Sum `image` over the compositing weights of the Gaussians that `render` colours.

    A compositing weight is the gradient of a pixel in the colour of the Gaussian.
    """
    # Any colour serves, as the image is linear in colours; 0.5 is not cut off at 0.
    with torch.enable_grad():
        colors = torch.full_like(gaussians.means, 0.5).requires_grad_()
        (gradient,) = torch.autograd.grad((image * render(colors)).sum(), colors)
    return gradient
