"""A cache of frozen scenes; as a scene grows, they are extended by what was added."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Hashable, Sequence
from itertools import accumulate, pairwise

from gscompleter.render import FrozenView, Renderer, each_view
from gscompleter.types import Camera, Completion, Gaussians, merge

Views = dict[Hashable, tuple[int, FrozenView]]
"""Frozen scene per camera, and the number of Gaussians in it."""

Drawn = Callable[[Gaussians], Gaussians]
"""Simplification of the context, or of what a target added, before it is rendered."""


class KeptViews:
    """Freezes the current scene at cameras and remembers it; the results equal frozen anew."""

    def __init__(self, renderer: Renderer, drawn: Drawn | None = None) -> None:
        self._renderer, self._drawn = renderer, drawn
        self._scene: weakref.ref[Gaussians] | None = None
        self._views: Views = {}
        self._parts: dict[tuple[int, int], Gaussians] = {}
        """Simplified Gaussians of the context and of each target, by their rows."""

    def of(self, completion: Completion, cameras: Sequence[Camera]) -> tuple[FrozenView, ...]:
        """Freeze the scene at cameras, or reuse frozen scenes."""
        if self._scene is None or self._scene() is not completion.drawn:
            self._scene, self._views, self._parts = weakref.ref(completion.drawn), {}, {}
        views, keys = self._views, [key_of(camera) for camera in cameras]
        known = [views.get(key, (0, None)) for key in keys]
        missing = {count: self._since(completion, count) for count, _ in known}

        def up_to_date(camera: Camera, kept: tuple[int, FrozenView | None]) -> FrozenView:
            count, view = kept
            if view is None:
                return self._renderer.freeze(missing[0], camera)
            return view if count == len(completion.drawn) else view.extended(missing[count])

        frozen = tuple(each_view(completion.drawn)(up_to_date, cameras, known))
        views.update(zip(keys, ((len(completion.drawn), view) for view in frozen), strict=True))
        return frozen

    def forget(self) -> None:
        """Drop all frozen scenes to free their memory."""
        self._scene, self._views, self._parts = None, {}, {}

    def grown(self, before: Gaussians, after: Gaussians) -> None:
        """Accept `after` as the scene `before` with additions."""
        if self._scene is not None and self._scene() is before:
            self._scene = weakref.ref(after)

    def _since(self, completion: Completion, count: int) -> Gaussians:
        """Select (and simplify) the Gaussians after the first `count`."""
        if self._drawn is None:
            return completion.drawn[count:]
        added = [len(result.added) for result in completion.targets]
        bounds = [0, *accumulate(added, initial=completion.num_kept)]
        wanted = [part for part in pairwise(bounds) if part[0] >= count]
        for part in wanted:
            if part not in self._parts:
                self._parts[part] = self._drawn(completion.drawn[slice(*part)])
        parts = [self._parts[part] for part in wanted]
        return parts[0] if len(parts) == 1 else merge([completion.drawn[:0], *parts])


def key_of(camera: Camera) -> Hashable:
    """Make a key that is equal for cameras with equal images."""
    numbers = (*camera.c2w.flatten().tolist(), *camera.K.flatten().tolist())
    return (*numbers, camera.width, camera.height, camera.near_plane)
