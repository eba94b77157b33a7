"""Plain autograd over the same renderer, to tell what freezing the context is worth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from jaxtyping import Float
from torch import Tensor

from gscompleter.render import OpacityRender, Renderer
from gscompleter.types import Camera, Gaussians, Render, merge


@dataclass(frozen=True)
class Unfrozen:
    """A renderer that computes nothing in advance: the whole scene is merged and drawn anew at
    each iteration, and differentiated through."""

    renderer: Renderer

    def render(self, gaussians: Gaussians, camera: Camera) -> Render:
        return self.renderer.render(gaussians, camera)

    def freeze(self, context: Gaussians, camera: Camera) -> UnfrozenView:
        return UnfrozenView(self.renderer, context, camera)


@dataclass(frozen=True)
class UnfrozenView:
    """A `FrozenView` in name: it only remembers what it would draw."""

    renderer: Renderer
    scene: Gaussians
    camera: Camera

    @cached_property
    def context(self) -> Render:
        """The context alone."""
        return self.renderer.render(self.scene, self.camera)

    def composite(self, new: Gaussians) -> Render:
        """Context and `new` together, all of them projected, sorted and binned."""
        return self.renderer.render(merge([self.scene, new]), self.camera)

    def plan(self, new: Gaussians) -> OpacityRender:
        """Nothing is fixed: everything is drawn anew for each set of opacities."""

        def render(opacities: Float[Tensor, "n"]) -> Render:
            return self.composite(replace(new, opacities=opacities, encoded=None))

        return render
