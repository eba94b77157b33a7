"""Complete, remove, fill and repair a scene at a camera.

Every function takes a completion and returns a new one, so that the one before serves as undo.
Cameras and marks are in the frame of the result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.apps.inputs.removal import contain_points, widen_regions
from gscompleter.apps.requests.splat import Selection
from gscompleter.completer import GSCompleter
from gscompleter.config import CompleterConfig
from gscompleter.editing.cutting import Region
from gscompleter.editing.marking import find_marked
from gscompleter.editing.removal import remove_gaussians
from gscompleter.numerics.geometry import look_up
from gscompleter.numerics.image_ops import dilate, label_regions
from gscompleter.planning.remove import contain_nothing
from gscompleter.render.removed import mask_removed
from gscompleter.state import Completion
from gscompleter.system.progress import stage
from gscompleter.target_result import TargetResult, Unfilled
from gscompleter.types import Camera, merge

BoxNumbers = tuple[float, ...]


@dataclass(frozen=True)
class Filled:
    """A scene after targets at one camera, one for each kind of hole that it was completed for."""

    completion: Completion
    """With the targets that changed it, and no others."""
    results: tuple[TargetResult, ...] = ()
    """All results, also of targets that changed nothing."""

    def then(self, completed: Completion) -> Filled:
        """Go on with one more target, the last of `completed`."""
        result = completed.targets[-1]
        kept = completed if result.has_changed_scene else self.completion
        return Filled(kept, (*self.results, result))


def complete_at(
    completer: GSCompleter, first: CompleterConfig, state: Completion, camera: Camera
) -> Filled:
    """Complete all holes that a camera sees; `first` are the settings that the session began with.

    Places of what was removed come first, by the settings of a removal, which know no other holes.
    If the camera sees others, too, all that is left is then completed as before the removal.
    """
    places = find_removed_places(completer, state, camera)
    filled = Filled(state)
    if places.any():
        filled = filled.then(completer.advance(state, camera))
        holes, _ = find_holes(completer, set_apart(first, filled.completion), camera)
        if not (holes & ~places).any():
            return filled
    begun = set_apart(first, filled.completion)
    return filled.then(rejoin(filled.completion, completer.advance(begun, camera)))


def fill_marked(
    completer: GSCompleter,
    first: CompleterConfig,
    state: Completion,
    camera: Camera,
    marked: Bool[Tensor, "h w"],
) -> Filled:
    """Fill the holes that marks touch, and no others; no colours change.

    A hole counts as a whole, also where something was removed before a larger one. The settings are
    those of `complete_at`. Without any hole there are no results.
    """
    places = find_removed_places(completer, state, camera)
    holes, empty = find_holes(completer, set_apart(first, state), camera)
    if places.any():
        opened, opened_empty = find_holes(completer, state, camera)
        holes = holes | opened
        empty = empty | opened_empty
    touched = find_touched(holes, marked)
    filled = Filled(state)
    # What is covered without being trusted takes colours alone, and none change here.
    if not (touched & empty).any():
        return filled
    if (touched & empty & places).any():
        filled = filled.then(fill_region(completer, state, camera, touched))
    return fill_elsewhere(completer, first, filled, camera, touched & ~places)


def fill_elsewhere(
    completer: GSCompleter,
    first: CompleterConfig,
    filled: Filled,
    camera: Camera,
    region: Bool[Tensor, "h w"],
) -> Filled:
    """Fill holes of a region in which nothing was removed; no colours change."""
    begun = set_apart(first, filled.completion)
    _, empty = find_holes(completer, begun, camera)
    if not (empty & region).any():
        return filled
    return filled.then(rejoin(filled.completion, fill_region(completer, begun, camera, region)))


def fill_region(
    completer: GSCompleter, state: Completion, camera: Camera, region: Bool[Tensor, "h w"]
) -> Completion:
    """Fill the holes of a completion in a region, by its settings; no colours change."""
    # Colours would change all over the image, not only in the region.
    config = replace(state.config, recolor=replace(state.config.recolor, iterations=0))
    completed = completer.advance(replace(state, config=config), camera)
    completed = replace(completed, config=state.config)
    result = completed.targets[-1]
    if not len(result.added):
        return completed

    # Gaussians are added in the dilated hole mask (decision 037).
    holes = result.hole_mask & region
    dilated = dilate(holes, config.holes.dilation)
    new = [
        replace(part, gaussians=part.gaussians[look_up(dilated, part.gaussians, result.target)])
        for part in completed.added_parts[len(state.added_parts) :]
    ]
    parts = (*state.added_parts, *(part for part in new if len(part)))
    shown = replace(completed, added_parts=parts)
    filled = replace(
        result,
        added=merge([result.added[:0], *(part.gaussians for part in new)]),
        after=completer.scenes.freeze(shown.parts, state.with_depth_range(camera)).render,
        hole_mask=holes,
        num_outside=0,
        # Other holes stay empty on purpose.
        unfilled=Unfilled(),
    )
    return replace(shown, targets=(*completed.targets[:-1], filled))


def set_apart(first: CompleterConfig, state: Completion) -> Completion:
    """Return a completion with the settings and the trust that hold where nothing was removed."""
    if state.trust_elsewhere is None:
        return state
    return replace(state, config=first, trust=state.trust_elsewhere)


def rejoin(state: Completion, completed: Completion) -> Completion:
    """Return what was completed by `set_apart` with the settings and the trust of a removal."""
    if state.trust_elsewhere is None:
        return completed
    return replace(
        completed, config=state.config, trust=state.trust, trust_elsewhere=completed.trust
    )


def find_removed_places(
    completer: GSCompleter, state: Completion, camera: Camera
) -> Bool[Tensor, "h w"]:
    """Find the places of what was removed from the context, as a camera sees them."""
    if not len(state.source.removed):
        size = (camera.height, camera.width)
        return torch.zeros(size, dtype=torch.bool, device=state.context.means.device)
    return mask_removed(state.source, state.with_depth_range(camera), completer.renderer)


def find_holes(
    completer: GSCompleter, state: Completion, camera: Camera
) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Find the holes that a camera sees by the settings of a completion, and the empty ones."""
    view = completer.observe(state, camera)
    return view.camera.crop(view.holes), view.camera.crop(view.empty)


def find_touched(holes: Bool[Tensor, "h w"], marked: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Find the connected parts of a hole mask that marks touch."""
    labels, _ = label_regions(holes)
    # Label 0 is no hole.
    return holes & torch.isin(labels, labels[marked])


def repair_marked(
    completer: GSCompleter,
    first: CompleterConfig,
    state: Completion,
    camera: Camera,
    marked: Bool[Tensor, "h w"],
) -> tuple[Filled, int]:
    """Remove what marks show, count it, and fill its place, but no hole that was there before.

    The place of an addition is what it alone had covered: before a surface that is none.
    """
    changed, count = remove_marked(completer, state, camera, marked)
    if not count:
        return Filled(state), 0
    before, places = (find_removed_places(completer, one, camera) for one in (state, changed))
    place = marked | (places & ~before)
    filled = Filled(changed)
    if (places & place).any():
        holes, _ = find_holes(completer, changed, camera)
        if not (holes & before & ~place).any():
            filled = filled.then(completer.advance(changed, camera))
        elif (holes & place).any():
            filled = filled.then(fill_region(completer, changed, camera, place))
    if len(changed.added) == len(state.added):
        return filled, count
    # Additions were removed, too, and so may have been elsewhere.
    covered, opened = (
        find_holes(completer, set_apart(first, one), camera)[1] for one in (state, changed)
    )
    return fill_elsewhere(completer, first, filled, camera, opened & ~covered & ~places), count


def remove_marked(
    completer: GSCompleter, state: Completion, camera: Camera, marked: Bool[Tensor, "h w"]
) -> tuple[Completion, int]:
    """Remove what marks show, as `repair` does, and count it.

    The place of what is removed from the context is a hole from then on.
    """
    ranged = state.with_depth_range(camera)
    with stage("removing"):
        chosen = find_marked(state.scene, [ranged], [marked], completer.renderer)
        # The scene is what is left of the context, then each part that was added.
        counts = [len(state.kept_context), *map(len, state.parts[1:])]
        kept, *added = chosen.split(counts)
        context = torch.zeros_like(state.source.gone_mask)
        context[~state.source.gone_mask] = kept
        config = state.config.for_marks()
        return remove_chosen(completer, state, config, context, added, contain_nothing)


def remove_in_box(
    completer: GSCompleter,
    state: Completion,
    corners: BoxNumbers,
    rotation: BoxNumbers,
    origin: Float[np.ndarray, "3"],
) -> tuple[Completion, int]:
    """Remove all Gaussians in a box, as `remove` does, and count them.

    The box is in the coordinates of the splat's file, in which the result begins at `origin`. It
    reaches farther by one Gaussian, as that of `remove`.
    """
    given = Selection(corners, rotation)
    selection = widen_regions(given, state.context[~state.source.gone_mask], origin)
    contains = partial(contain_points, selection, origin)
    with stage("removing"):
        context = contains(state.context.means) & ~state.source.gone_mask
        added = [contains(part.means) for part in state.parts[1:]]
        config = state.config.for_removal()
        return remove_chosen(completer, state, config, context, added, contains)


def remove_chosen(
    completer: GSCompleter,
    state: Completion,
    config: CompleterConfig,
    context: Bool[Tensor, "n"],
    added: Sequence[Bool[Tensor, "_m"]],
    contains: Region,
) -> tuple[Completion, int]:
    """Remove chosen Gaussians of the context and of each added part, and count them.

    Gaussians of the context that only they hid go with them, and are counted.
    """
    if not any(bool(mask.any()) for mask in (context, *added)):
        return state, 0

    # What is removed from the context is marked, so that its hole may be filled. What was added is
    # simply taken out: its place is as it was before, and has no settings of a removal.
    left = tuple(
        replace(part, gaussians=part.gaussians[~mask])
        for part, mask in zip(state.added_parts, added, strict=True)
    )
    has_context = bool(context.any())
    begun = replace(state, added_parts=left, config=config if has_context else state.config)
    if not has_context and not len(state.source.removed):
        return begun, sum(int(mask.sum()) for mask in added)
    changed = remove_gaussians(begun, context, contains, completer.scenes)
    gone = changed.source.gone_mask & ~state.source.gone_mask
    count = sum(int(mask.sum()) for mask in (gone, *added))
    return changed, count
