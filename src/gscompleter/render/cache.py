"""A cache of frozen scenes; as a scene grows, they are extended by what was added."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

from jaxtyping import Bool
from torch import Tensor
from torch.nn.functional import pad

from gscompleter.render.lod import MAX_PREVIEW_GAUSSIANS, thin_gaussians
from gscompleter.render.protocols import FilingScene, FrozenScene, HidingScene, Renderer
from gscompleter.render.view_map import get_view_map
from gscompleter.system.files.mapping import find_changed_rows, is_mapped
from gscompleter.types import Camera, Gaussians

Parts = tuple[Gaussians, ...]
"""Gaussians to render: the context, then what was added, part by part."""


class SceneRenderer:
    """Freezes scenes at cameras and remembers them; the results equal scenes frozen anew.

    A scene is a tuple of parts, which are compared by identity.
    """

    def __init__(self, renderer: Renderer) -> None:
        self.renderer = renderer
        self._views: dict[Hashable, tuple[Parts, FrozenScene]] = {}
        self._thinned: list[tuple[Gaussians, Gaussians]] = []

    def clear(self) -> None:
        """Forget all frozen scenes, which take the most memory of a completion."""
        self._views.clear()
        self._thinned = []

    def freeze(self, parts: Parts, camera: Camera) -> FrozenScene:
        """Freeze a scene at a camera that is not visited again."""
        return self._update(parts, camera, (), None)

    def freeze_at(self, parts: Parts, cameras: Sequence[Camera]) -> tuple[FrozenScene, ...]:
        """Freeze a scene at cameras, or reuse and extend what was frozen there before."""

        def update(camera: Camera) -> FrozenScene:
            # What was frozen before is taken out of the cache, so that each view takes memory once
            # and not twice until all are done. No thread waits for another: a view that is not
            # there is frozen anew, with the same result.
            key = make_camera_key(camera)
            known, before = self._views.pop(key, ((), None))
            frozen = self._update(parts, camera, known, before)
            # Of a scene whose harmonics lie in a file, frozen views would be most of the memory.
            if frozen is not before and is_mapped(parts[0].sh) and isinstance(frozen, FilingScene):
                frozen = frozen.move_beside(parts[0].sh)
            self._views[key] = (parts, frozen)
            return frozen

        return tuple(get_view_map(parts[0].means)(update, cameras))

    def freeze_small(self, parts: Parts, cameras: Sequence[Camera]) -> tuple[FrozenScene, ...]:
        """Freeze a simplified scene at cameras of small images."""
        self._thinned = [self._thin(part) for part in parts]
        return self.freeze_at(tuple(thin for _, thin in self._thinned), cameras)

    def _update(
        self, parts: Parts, camera: Camera, known: Parts, frozen: FrozenScene | None
    ) -> FrozenScene:
        """Extend what was `frozen` of the parts `known` to `parts`, or freeze these anew.

        Parts are immutable, so that an identical object is an equal part. Only the first one may be
        another than before.
        """
        # Nothing can be taken out of a frozen scene but by freezing it anew.
        is_grown = has_first_parts(parts[1:], known[1:])
        updated = (
            replace_first(frozen, known, parts[0]) if frozen is not None and is_grown else None
        )
        if updated is None:
            updated = self.renderer.freeze(parts[0], camera)
            known = parts[:1]
        for part in parts[len(known) :]:
            updated = updated.extend(part)
        return updated

    def _thin(self, part: Gaussians) -> tuple[Gaussians, Gaussians]:
        """Simplify a part, or find it among those simplified before."""
        for pair in self._thinned:
            if pair[0] is part:
                return pair
        return part, thin_gaussians(part, MAX_PREVIEW_GAUSSIANS)


def replace_first(frozen: FrozenScene, known: Parts, first: Gaussians) -> FrozenScene | None:
    """Replace the first of the parts `known` that were frozen; None if all has to be frozen anew.

    One that was only recoloured is repainted, and one of which some were hidden is drawn again
    where it showed them.
    """
    before, *later = known
    if before is first:
        return frozen
    hidden = find_hidden(before, first)
    if hidden is not None and isinstance(frozen, HidingScene):
        # Of the later parts nothing is hidden.
        return frozen.hide(pad(hidden, (0, sum(map(len, later)))), (first, *later))
    if not differ_in_color(before, first):
        return None
    rows = find_changed_rows(before.sh, first.sh).nonzero()[:, 0]
    return frozen.repaint(rows, first[rows])


def differ_in_color(one: Gaussians, other: Gaussians) -> bool:
    """Check whether two scenes are the same Gaussians in other colours."""
    names = ("means", "quats", "scales", "opacities")
    is_same = all(getattr(one, name) is getattr(other, name) for name in names)
    has_same_form = one.sh.shape == other.sh.shape and one.is_antialiased == other.is_antialiased
    return is_same and has_same_form


def find_hidden(one: Gaussians, other: Gaussians) -> Bool[Tensor, "n"] | None:
    """Find what is transparent in another scene alone; None if these differ in anything else."""
    names = ("means", "quats", "scales", "sh")
    is_same = all(getattr(one, name) is getattr(other, name) for name in names)
    if not is_same or one.is_antialiased != other.is_antialiased:
        return None
    hidden = one.opacities != other.opacities
    return None if other.opacities[hidden].any() else hidden


def has_first_parts(parts: Parts, first: Parts) -> bool:
    """Check whether `parts` begin with all of `first`, the same objects."""
    return len(parts) >= len(first) and all(
        part is other for part, other in zip(parts, first, strict=False)
    )


def make_camera_key(camera: Camera) -> Hashable:
    """Make a key that is equal for cameras with equal images."""
    # Not the far plane, which no renderer uses, and of the near one what renderers make of it.
    camera = camera.on_cpu
    numbers = (*camera.c2w.flatten().tolist(), *camera.K.flatten().tolist())
    size = camera.width, camera.height
    return (*numbers, *size, *camera.padding, camera.near_plane, camera.blur)
