"""Frozen views that are kept from target to target.

A scene only grows while it is completed, and most of its cameras are looked from again at every
target. What they see of it is frozen once and then extended by what was added since.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Hashable, Sequence
from itertools import accumulate, pairwise

from gscompleter.render import FrozenView, Renderer, each_view
from gscompleter.types import Camera, Completion, Gaussians, merge

Views = dict[Hashable, tuple[int, FrozenView]]
"""By camera, how many Gaussians of the scene are frozen in a view, and the view."""

Drawn = Callable[[Gaussians], Gaussians]
"""What is drawn in place of some of a scene: of its context, or of what a target added."""


class KeptViews:
    """What cameras see of the scene that was looked at last.

    Nothing but time depends on whether a view was kept: it is the same as one that is frozen anew.
    """

    def __init__(self, renderer: Renderer, drawn: Drawn | None = None) -> None:
        """
        Args:
            renderer: Freezes and extends the views.
            drawn: What is drawn in place of the context, and of what each target added; None for
                themselves.
        """
        self._renderer, self._drawn = renderer, drawn
        self._scene: weakref.ref[Gaussians] | None = None
        self._views: Views = {}
        self._parts: dict[tuple[int, int], Gaussians] = {}
        """What is drawn of the context, and of what each target added, by their rows."""

    def of(self, completion: Completion, cameras: Sequence[Camera]) -> tuple[FrozenView, ...]:
        """The scene as it stands, frozen at each of `cameras`."""
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

        found = tuple(each_view(completion.drawn)(up_to_date, cameras, known))
        views.update(zip(keys, ((len(completion.drawn), view) for view in found), strict=True))
        return found

    def forget(self) -> None:
        """Let go of all views, whose memory is needed."""
        self._scene, self._views, self._parts = None, {}, {}

    def grown(self, before: Gaussians, after: Gaussians) -> None:
        """Be told that the scene `after` is `before`, and something that was added to it."""
        if self._scene is not None and self._scene() is before:
            self._scene = weakref.ref(after)

    def _since(self, completion: Completion, count: int) -> Gaussians:
        """What is drawn of a scene behind its first `count` Gaussians, as many as it had once."""
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
    """What two cameras that draw the same image have in common."""
    numbers = (*camera.c2w.flatten().tolist(), *camera.K.flatten().tolist())
    return (*numbers, camera.width, camera.height, camera.near_plane)
