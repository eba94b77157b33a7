"""Complete, remove, fill and repair a scene at a camera.

Every function takes a completion and returns a new one, so that the one before serves as undo.
Cameras and marks are in the frame of the result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
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
from gscompleter.system.errors import InputError
from gscompleter.system.progress import stage
from gscompleter.target_result import Unfilled
from gscompleter.types import Camera, merge

NOTHING_MARKED = "The marks show no Gaussian; paint over what the picture shows."
EMPTY_BOX = "The box contains nothing; drag it, or make it larger."

BoxNumbers = tuple[float, ...]


def complete_at(
    completer: GSCompleter, first: CompleterConfig, state: Completion, camera: Camera
) -> Completion:
    """Complete all holes that a camera sees; `first` are the settings that the session began with.

    After a removal only its own hole is filled where the camera sees it. Elsewhere all is as it
    was before the removal.
    """
    if not len(state.source.removed) or sees_removed(completer, state, camera):
        return completer.advance(state, camera)
    config = replace(state.config, guards=first.guards, holes=first.holes)
    completed = completer.advance(replace(state, config=config), camera)
    return replace(completed, config=state.config)


def sees_removed(completer: GSCompleter, state: Completion, camera: Camera) -> bool:
    """Return True if a camera sees the place of something that was removed."""
    ranged = state.with_depth_range(camera)
    return bool(mask_removed(state.source, ranged, completer.renderer).any())


def fill_marked(
    completer: GSCompleter, state: Completion, camera: Camera, marked: Bool[Tensor, "h w"]
) -> Completion:
    """Fill the holes that marks touch, and no others; no colours change."""
    # Colours would change all over the image, not only in the marks.
    config = replace(state.config, recolor=replace(state.config.recolor, iterations=0))
    completed = completer.advance(replace(state, config=config), camera)
    result = completed.targets[-1]
    if not len(result.added):
        return replace(completed, config=state.config)

    # Gaussians are added in the dilated hole mask (decision 037).
    touched = find_touched(result.hole_mask, marked)
    region = dilate(touched, config.holes.dilation)
    new = [
        replace(part, gaussians=part.gaussians[look_up(region, part.gaussians, result.target)])
        for part in completed.added_parts[len(state.added_parts) :]
    ]
    parts = (*state.added_parts, *(part for part in new if len(part)))
    shown = replace(completed, config=state.config, added_parts=parts)
    filled = replace(
        result,
        added=merge([result.added[:0], *(part.gaussians for part in new)]),
        after=completer.scenes.freeze(shown.parts, state.with_depth_range(camera)).render,
        hole_mask=touched,
        # Other holes stay empty on purpose.
        unfilled=Unfilled(),
    )
    targets = (*completed.targets[:-1], filled)
    return replace(shown, targets=targets)


def find_touched(holes: Bool[Tensor, "h w"], marked: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Find the connected parts of a hole mask that marks touch."""
    labels, _ = label_regions(holes)
    # Label 0 is no hole.
    return holes & torch.isin(labels, labels[marked])


def remove_marked(
    completer: GSCompleter, state: Completion, camera: Camera, marked: Bool[Tensor, "h w"]
) -> tuple[Completion, int]:
    """Remove what marks show, as `repair` does, and count it; its place is a hole from then on."""
    ranged = state.with_depth_range(camera)
    with stage("removing"):
        chosen = find_marked(state.scene, [ranged], [marked], completer.renderer)
        # The scene is what is left of the context, then each part that was added.
        counts = [len(state.kept_context), *map(len, state.parts[1:])]
        kept, *added = chosen.split(counts)
        context = torch.zeros_like(state.source.gone_mask)
        context[~state.source.gone_mask] = kept
        config = state.config.for_marks()
        return remove_chosen(
            completer, state, config, context, added, contain_nothing, NOTHING_MARKED
        )


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
        return remove_chosen(completer, state, config, context, added, contains, EMPTY_BOX)


def remove_chosen(
    completer: GSCompleter,
    state: Completion,
    config: CompleterConfig,
    context: Bool[Tensor, "n"],
    added: Sequence[Bool[Tensor, "_m"]],
    contains: Region,
    nothing: str,
) -> tuple[Completion, int]:
    """Remove chosen Gaussians of the context and of each added part; `nothing` refuses none.

    Gaussians of the context that only they hid go with them, and are counted.
    """
    if not any(bool(mask.any()) for mask in (context, *added)):
        raise InputError(nothing)

    # What is removed from the context is marked, so that its hole may be filled. What was added is
    # simply taken out.
    left = tuple(
        replace(part, gaussians=part.gaussians[~mask])
        for part, mask in zip(state.added_parts, added, strict=True)
    )
    begun = replace(state, added_parts=left, config=config)
    changed = remove_gaussians(begun, context, contains, completer.scenes)
    gone = changed.source.gone_mask & ~state.source.gone_mask
    count = sum(int(mask.sum()) for mask in (gone, *added))
    return changed, count
