"""Complete, remove, fill and repair a scene at a camera.

Every function takes a completion and returns a new one, so that the one before serves as undo.
Cameras are in the frame of the result, and marks are at the size of their camera.

A camera may see two kinds of holes. Places of what was removed are filled by the settings of the
removal and with full trust, which the completion has from then on. All other holes are filled by
`first`, the settings that the session began with, and with the trust that the completion keeps as
`trust_elsewhere`. `set_apart` changes from the former to the latter, and `rejoin` back.
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
    """Complete all holes that a camera sees.

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
    apart = set_apart(first, filled.completion)
    return filled.then(rejoin(filled.completion, completer.advance(apart, camera)))


def fill_marked(
    completer: GSCompleter,
    first: CompleterConfig,
    state: Completion,
    camera: Camera,
    marked: Bool[Tensor, "h w"],
) -> Filled:
    """Fill the holes that marks touch, and no others; no colours change.

    A hole is filled as a whole, also one that lies only partly in the place of a removal. If marks
    touch no hole, there are no results.
    """
    places = find_removed_places(completer, state, camera)
    holes, empty = find_holes(completer, set_apart(first, state), camera)
    if places.any():
        removal_holes, removal_empty = find_holes(completer, state, camera)
        holes = holes | removal_holes
        empty = empty | removal_empty
    touched = find_touched(holes, marked)
    filled = Filled(state)
    # Holes that are not empty are covered by what is not trusted. They would take new colours, and
    # no colours change here.
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
    apart = set_apart(first, filled.completion)
    _, empty = find_holes(completer, apart, camera)
    if not (empty & region).any():
        return filled
    return filled.then(rejoin(filled.completion, fill_region(completer, apart, camera, region)))


def fill_region(
    completer: GSCompleter, state: Completion, camera: Camera, region: Bool[Tensor, "h w"]
) -> Completion:
    """Fill the holes of a completion in a region, by its settings; no colours change.

    The result of the target is that of the region: its hole, and what was added there.
    """
    # Colours would change all over the image, not only in the region.
    config = replace(state.config, recolor=replace(state.config.recolor, iterations=0))
    completed = completer.advance(replace(state, config=config), camera)
    completed = replace(completed, config=state.config)
    result = completed.targets[-1]
    holes = result.hole_mask & region
    if not len(result.added):
        # That all of the hole stays empty, as the result says, is true of the region as well.
        return replace_last(completed, replace(result, hole_mask=holes))

    # Gaussians are added in the dilated hole mask (decision 037).
    dilated = dilate(holes, config.holes.dilation)
    new = [
        replace(part, gaussians=part.gaussians[look_up(dilated, part.gaussians, result.target)])
        for part in completed.added_parts[len(state.added_parts) :]
    ]
    parts = (*state.added_parts, *(part for part in new if len(part)))
    limited = replace(completed, added_parts=parts)
    filled = replace(
        result,
        added=merge([result.added[:0], *(part.gaussians for part in new)]),
        after=completer.scenes.freeze(limited.parts, state.with_depth_range(camera)).render,
        hole_mask=holes,
        # `look_up` finds nothing outside of the image.
        num_outside=0,
        # Other holes stay empty on purpose.
        unfilled=Unfilled(),
    )
    return replace_last(limited, filled)


def replace_last(completed: Completion, result: TargetResult) -> Completion:
    """Replace the result of the last target."""
    return replace(completed, targets=(*completed.targets[:-1], result))


def set_apart(first: CompleterConfig, state: Completion) -> Completion:
    """Return a completion with the settings and the trust that hold where nothing was removed.

    One without a removal has them already.
    """
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
    """Find the holes that a camera sees by the settings of a completion.

    Return the pixels that are empty or not trusted, and those of them that are empty.
    """
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

    What is removed of the context leaves a hole at its place, whatever stands behind. An addition
    leaves one only where nothing else covers the image.
    """
    changed, count = remove_marked(completer, state, camera, marked)
    if not count:
        return Filled(state), 0

    # The place of what was removed of the context. Where something was removed earlier is no part
    # of it, unless it is marked.
    earlier_places = find_removed_places(completer, state, camera)
    places = find_removed_places(completer, changed, camera)
    place = marked | (places & ~earlier_places)
    filled = Filled(changed)
    if (places & place).any():
        holes, _ = find_holes(completer, changed, camera)
        if not (holes & earlier_places & ~place).any():
            # The settings of a removal know no other holes, so that colours may change, too.
            filled = filled.then(completer.advance(changed, camera))
        elif (holes & place).any():
            filled = filled.then(fill_region(completer, changed, camera, place))
    if len(changed.added) == len(state.added):
        return filled, count

    # Additions were removed, too. What they leave is a hole where nothing was removed of the
    # context, also beside the marks.
    _, empty_before = find_holes(completer, set_apart(first, state), camera)
    _, empty_after = find_holes(completer, set_apart(first, changed), camera)
    region = empty_after & ~empty_before & ~places
    return fill_elsewhere(completer, first, filled, camera, region), count


def remove_marked(
    completer: GSCompleter, state: Completion, camera: Camera, marked: Bool[Tensor, "h w"]
) -> tuple[Completion, int]:
    """Remove what marks show, as `repair` does, and count it.

    The place of what is removed from the context is a hole from then on. If the marks show no
    Gaussian, the completion is the same, and the count 0; so in the functions below.
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

    The smallest and the largest `corners` are in the coordinates of the splat's file, in which the
    result begins at `origin`; `rotation` is a quaternion wxyz about the centre of the box. The box
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

    `context` and `added` are True for these, and `contains` is the region at whose border those of
    the context are cut. `config` are the settings from then on if any are of the context. Gaussians
    of the context that only the chosen ones hid go with them, and are counted.
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
    without_added = replace(state, added_parts=left, config=config if has_context else state.config)
    if not has_context and not len(state.source.removed):
        return without_added, sum(int(mask.sum()) for mask in added)
    # Called after an earlier removal, too, if only additions go: photographs are painted with them
    # at its place, and have to be painted anew.
    changed = remove_gaussians(without_added, context, contains, completer.scenes)
    gone = changed.source.gone_mask & ~state.source.gone_mask
    return changed, sum(int(mask.sum()) for mask in (gone, *added))
