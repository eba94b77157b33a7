"""Plain autograd over the same renderer, to tell what freezing the context is worth."""

from __future__ import annotations

from dataclasses import dataclass

from gscompleter.render import Renderer
from gscompleter.render.reference import ReferenceView
from gscompleter.types import Camera, Gaussians, Render


@dataclass(frozen=True)
class Unfrozen:
    """A renderer that computes nothing in advance: the whole scene is merged and drawn anew at
    each iteration, and differentiated through."""

    renderer: Renderer

    def render(self, gaussians: Gaussians, camera: Camera) -> Render:
        return self.renderer.render(gaussians, camera)

    def freeze(self, context: Gaussians, camera: Camera) -> ReferenceView:
        return ReferenceView(self.renderer, context, camera)
