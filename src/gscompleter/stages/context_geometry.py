"""Stage 1 with geometry from elsewhere: photographs get its depth (not in the paper).

They get it before Ψ makes a scene of them, so that Ψ uses the depth. A scene that is given tells
first where the geometry belongs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from gscompleter.numerics.given_geometry import GivenGeometry
from gscompleter.numerics.place_geometry import place_geometry
from gscompleter.numerics.sky import mask_out_sky
from gscompleter.render.cache import SceneRenderer
from gscompleter.stages.context import InitialContext, sort_by_frame
from gscompleter.stages.given_geometry import (
    ContradictedError,
    give_depth_before_scene,
    give_photographs_depth,
    require_uncontradicted,
)
from gscompleter.system.errors import InputError
from gscompleter.types import DepthMap, View

InitFrom = Callable[[Sequence[View]], InitialContext]
"""Initializes the context from photographs."""


def init_with_geometry(
    geometry: GivenGeometry,
    views: Sequence[View],
    has_scene: bool,
    init: InitFrom,
    scenes: SceneRenderer,
) -> InitialContext:
    """Initialize the context, whose photographs get the depth of geometry.

    `has_scene` is True if a scene is given, which Ψ does not make. Raises InputError if the scene,
    or what photographs measure, contradicts the geometry.
    """
    if has_scene:
        context = init(views)
        placed, surfaces = place_in_context(geometry, context, scenes)
        given = give_photographs_depth(placed, context.views, surfaces)
        return replace(context, views=given, geometry=placed)
    try:
        return init_from_depth(geometry, views, init)
    except ContradictedError as contradiction:
        # It may be in a frame of its own, which the scene that Ψ makes without it tells.
        try:
            context = init(views)
        except InputError as refusal:
            # Ψ makes no scene of a single photograph without depth, which geometry was to give.
            raise (contradiction if len(views) == 1 else refusal) from None
        placed, _ = place_in_context(geometry, context, scenes)
        # The same object, if the scene shows it where it stands: the contradiction remains.
        if placed is geometry:
            raise
        return init_from_depth(placed, views, init)


def init_from_depth(placed: GivenGeometry, views: Sequence[View], init: InitFrom) -> InitialContext:
    """Let Ψ make the context of photographs that have the depth of geometry.

    Raises ContradictedError if they measure something else.
    """
    views = sort_by_frame(views)  # as those of the context are
    given, notes = give_depth_before_scene(placed, views)
    context = init(given)
    require_uncontradicted(placed, views, given, context.views)
    return replace(context, notes=(*notes, *context.notes), geometry=placed)


def place_in_context(
    geometry: GivenGeometry, context: InitialContext, scenes: SceneRenderer
) -> tuple[GivenGeometry, list[DepthMap]]:
    """Move geometry to where the photographs of a context show it.

    Also returns the surfaces that they show, without the sky. Raises InputError if they show
    something else.
    """
    cameras = [view.camera for view in context.views]
    frozen = scenes.freeze_at((context.source.rendered,), cameras)
    surfaces = [
        mask_out_sky(scene.render, camera) for scene, camera in zip(frozen, cameras, strict=True)
    ]
    return place_geometry(geometry, cameras, surfaces), surfaces
