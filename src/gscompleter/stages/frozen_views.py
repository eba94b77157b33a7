"""A cache of frozen scenes; as a scene grows, they are extended by what was added."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Hashable, Sequence
from itertools import accumulate, pairwise

from gscompleter.render import FrozenScene, Renderer, get_view_map
from gscompleter.state import Completion
from gscompleter.types import Camera, Gaussians, merge

FrozenScenes = dict[Hashable, tuple[int, FrozenScene]]
"""Frozen scene per camera, and the number of Gaussians in it."""

Simplification = Callable[[Gaussians], Gaussians]
"""Simplification of the context, or of what a target added, before it is rendered."""


class SceneRenderer:
    """Freezes the current scene at cameras and remembers it; the results equal frozen anew."""

    def __init__(self, renderer: Renderer, simplify: Simplification | None = None) -> None:
        self._renderer, self._simplify = renderer, simplify
        self._scene: weakref.ref[Gaussians] | None = None
        self._views: FrozenScenes = {}
        self._parts: dict[tuple[int, int], Gaussians] = {}
        """Simplified Gaussians of the context and of each target, by their rows."""

    def freeze_at(
        self, completion: Completion, cameras: Sequence[Camera]
    ) -> tuple[FrozenScene, ...]:
        """Freeze the scene at cameras, or reuse frozen scenes."""
        if self._scene is None or self._scene() is not completion.rendered_scene:
            self._scene, self._views, self._parts = weakref.ref(completion.rendered_scene), {}, {}
        views, keys = self._views, [make_camera_key(camera) for camera in cameras]
        known = [views.get(key, (0, None)) for key in keys]
        missing = {count: self._select_since(completion, count) for count, _ in known}

        def up_to_date(camera: Camera, kept: tuple[int, FrozenScene | None]) -> FrozenScene:
            count, view = kept
            if view is None:
                return self._renderer.freeze(missing[0], camera)
            return view if count == len(completion.rendered_scene) else view.extend(missing[count])

        frozen = tuple(get_view_map(completion.rendered_scene)(up_to_date, cameras, known))
        views.update(
            zip(keys, ((len(completion.rendered_scene), view) for view in frozen), strict=True)
        )
        return frozen

    def clear(self) -> None:
        """Drop all frozen scenes to free their memory."""
        self._scene, self._views, self._parts = None, {}, {}

    def accept_growth(self, before: Gaussians, after: Gaussians) -> None:
        """Accept `after` as the scene `before` with additions."""
        if self._scene is not None and self._scene() is before:
            self._scene = weakref.ref(after)

    def _select_since(self, completion: Completion, count: int) -> Gaussians:
        """Select (and simplify) the Gaussians after the first `count`."""
        if self._simplify is None:
            return completion.rendered_scene[count:]
        added = [len(result.added) for result in completion.targets]
        bounds = [0, *accumulate(added, initial=completion.num_kept)]
        wanted = [part for part in pairwise(bounds) if part[0] >= count]
        for part in wanted:
            if part not in self._parts:
                self._parts[part] = self._simplify(completion.rendered_scene[slice(*part)])
        parts = [self._parts[part] for part in wanted]
        return parts[0] if len(parts) == 1 else merge([completion.rendered_scene[:0], *parts])


def make_camera_key(camera: Camera) -> Hashable:
    """Make a key that is equal for cameras with equal images."""
    numbers = (*camera.c2w.flatten().tolist(), *camera.K.flatten().tolist())
    return (*numbers, camera.width, camera.height, camera.near_plane)
