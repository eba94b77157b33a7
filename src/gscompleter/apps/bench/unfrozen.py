"""Plain autograd over the same renderer, to measure the benefit of a frozen context."""

from __future__ import annotations

from dataclasses import dataclass

from gscompleter.render import Renderer
from gscompleter.render.redraw import RedrawnScene
from gscompleter.types import Camera, Gaussians, Render


@dataclass(frozen=True)
class UnfrozenRenderer:
    """A renderer that renders and differentiates the whole scene in every iteration."""

    renderer: Renderer

    def render(self, gaussians: Gaussians, camera: Camera) -> Render:
        """Render as the wrapped renderer does."""
        return self.renderer.render(gaussians, camera)

    def freeze(self, context: Gaussians, camera: Camera) -> RedrawnScene:
        """Return a scene that is rendered anew with every call."""
        return RedrawnScene(self.renderer, context, camera)
