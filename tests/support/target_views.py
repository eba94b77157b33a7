"""A scene as a target sees it, for tests of single stages."""

from __future__ import annotations

from collections.abc import Sequence

from gscompleter.config import CompleterConfig
from gscompleter.numerics.geometry import pad_camera
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.loading import load_renderer
from gscompleter.render.protocols import Renderer
from gscompleter.stages.target_view import TargetView, render_target
from gscompleter.state import Completion, Photo
from gscompleter.trust import Trust
from gscompleter.types import Camera, ContextScene, Gaussians, View


def begin_with(
    context: Gaussians,
    views: Sequence[View],
    config: CompleterConfig = CompleterConfig(),
    trust: Trust = Trust(),
) -> Completion:
    """Begin a completion of `context` without guards."""
    photos = tuple(map(Photo, views))
    return Completion(config, ContextScene.whole(context), context, photos, len(photos), trust)


def observe(
    context: Gaussians,
    views: Sequence[View],
    target: Camera,
    config: CompleterConfig = CompleterConfig(),
    renderer: Renderer | None = None,
) -> TargetView:
    """Render `context` at a target without padding."""
    scenes = SceneRenderer(renderer or load_renderer("cpu"))
    return render_target(begin_with(context, views, config), pad_camera(target, 0.0), scenes)
