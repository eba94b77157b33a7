"""A scene that Ψ made of a few photographs, made anew of more (not in the paper; decision 145).

Ψ fits a scene to its photographs, and what looks right from them may be shards from elsewhere. What
further photographs show cannot be added around shards, nor do they give way: the photographs that
they were made of would lose. So Ψ makes the scene of all photographs together. What Φ invented
stays, but where photographs show the place: where it lies before what Ψ made of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config.settings import COVERED
from gscompleter.generators.exposure import compute_median_ratio
from gscompleter.parts import EarlierWork, PartOrigin, make_part
from gscompleter.reconstructors import Reconstructor
from gscompleter.reconstructors.features.depth_range import get_depth_range, set_depth_range
from gscompleter.render.mask_sums import sum_in_mask
from gscompleter.render.protocols import Renderer
from gscompleter.stages.context import InitialContext, reconstruct_context, sort_by_frame
from gscompleter.stages.new_photos import compute_error
from gscompleter.stages.replace_contested import (
    Contested,
    drop_rows,
    mark_rendered,
    render_at_views,
)
from gscompleter.state import Completion, Photo
from gscompleter.types import SH_C0, ContextScene, Gaussians, Render, View, merge

MAX_OVERLYING_LAYERS = 8
"""Layers of invented Gaussians that give way behind each other."""
MIN_OVERLYING = 0.1
"""Least area in pixels, in all photographs together, that such a Gaussian covers."""


def remake_scene(
    reconstructor: Reconstructor,
    state: Completion,
    views: Sequence[View],
    earlier: EarlierWork,
    contested: Contested | None,
    renderer: Renderer,
    has_scene_range: bool,
) -> Completion | None:
    """Make anew what Ψ made of the scene of a begun completion, from its photographs.

    `views` are those of the context as they were given, and `has_scene_range` is that of
    `reconstruct_context`. What shows where photographs are ignored, as around what a person took
    out, stays. The `contested` Gaussians, which Φ invented, go as well, and so do those before the
    new scene. Returns None if nothing is to be made anew, or if the photographs are not nearer to
    the new scene than to the given one, in the mean of their PSNR apart from their exposures.
    """
    if earlier.remade is None:
        return None
    views = sort_by_frame(views)  # as those of `state` are
    given = list(render_at_views(merge(state.parts), views, renderer))
    made = reconstruct_context(reconstructor, views, has_scene_range=has_scene_range)
    gone = mark_rendered(state.source, earlier.remade)
    gone = gone & ~find_ignored(state, views, given, renderer)
    if contested is not None:
        gone = gone | contested.rows
    invented = mark_rendered(state.source, earlier.invented)
    if not gone.all():
        shown = list(render_at_views(made.source.gaussians, views, renderer))
        overlying = find_overlying(
            state.rendered_context, invented, gone, made.source.gaussians, views, shown, renderer
        )
        gone = gone | overlying
    if not gone.all():
        # What was invented and stays has the exposure of the given scene. Else the new one keeps
        # its own, in which no photograph is brightened until it is clipped.
        exposure = measure_exposure(given, shown, views)
        made = multiply_exposure(made, views, exposure)
    part = make_part(PartOrigin("photographs"), made.source.gaussians)
    # The scene has one exposure, which photographs of the context share from here on.
    context = tuple(Photo(view) for view in made.views)
    # All photographs share one depth range: that of the scene as it is made anew.
    others = state.photos[len(context) :]
    ranged = set_depth_range([photo.view for photo in others], *get_depth_range(made.views))
    checks = [replace(photo, view=view) for photo, view in zip(others, ranged, strict=True)]
    begun = replace(
        drop_rows(state, state, gone),
        photos=(*context, *checks),
        added_parts=(part,),
        exposure_gains=made.exposure_gains,
        context_notes=(*state.context_notes, *made.notes),
        is_remade=True,
    )
    after = list(render_at_views(merge(begun.parts), made.views, renderer))
    is_nearer = compute_psnrs(after, made.views).mean() > compute_psnrs(given, made.views).mean()
    return begun if is_nearer else None


def find_overlying(
    context: Gaussians,
    invented: Bool[Tensor, "m"],
    gone: Bool[Tensor, "m"],
    new: Gaussians,
    views: Sequence[View],
    shown: Sequence[Render],
    renderer: Renderer,
) -> Bool[Tensor, "m"]:
    """Find the invented Gaussians that photographs see before the `new` scene (decision 154).

    They fitted the given scene, and the new one shows that place itself. Those that show mostly
    where it is empty stay, and so do those that no photograph sees. `context` is the given scene,
    of which `gone` goes in any case, and `shown` are the renders of the new one at the photographs.
    """
    covered = [
        (render.alpha >= COVERED) & view.valid_mask
        for render, view in zip(shown, views, strict=True)
    ]
    overlying = torch.zeros_like(gone)
    # What goes may have hidden others.
    for _ in range(MAX_OVERLYING_LAYERS):
        candidates = invented & ~gone & ~overlying
        scene = merge([context.hide(gone | overlying), new])
        sums = sum_in_masks(scene, views, covered, renderer)[: len(context)]
        on_scene, on_holes, _ = sums.unbind(dim=1)
        found = candidates & (on_scene > on_holes) & (on_scene > MIN_OVERLYING)
        if not found.any():
            break
        overlying = overlying | found
    return overlying


def find_ignored(
    state: Completion, views: Sequence[View], given: Sequence[Render], renderer: Renderer
) -> Bool[Tensor, "m"]:
    """Find the Gaussians of the given scene that show mostly where photographs are ignored.

    There Ψ makes nothing anew. Only photographs that the given scene is right from are asked, whose
    renders are `given`: in others shards may stand before the place.
    """
    context = state.rendered_context
    right_views = [views[index] for index in choose_right_views(given, views)]
    if all(view.ignore_mask is None for view in right_views):
        return torch.zeros_like(context.opacities, dtype=torch.bool)
    masks = [view.valid_mask for view in right_views]
    # The context comes first in the scene.
    sums = sum_in_masks(merge(state.parts), right_views, masks, renderer)[: len(context)]
    valid, ignored, _ = sums.unbind(dim=1)
    return ignored > valid


def sum_in_masks(
    scene: Gaussians,
    views: Sequence[View],
    masks: Sequence[Bool[Tensor, "_ _"]],
    renderer: Renderer,
) -> Float[Tensor, "n 3"]:
    """Sum how much of each Gaussian photographs show inside and outside of masks, in pixels.

    The third sum is 0, as in `sum_in_mask`.
    """
    sums = torch.zeros_like(scene.means)
    for view, mask in zip(views, masks, strict=True):
        sums += sum_in_mask(renderer.freeze(scene, view.camera), mask.to(sums))
    return sums


def choose_right_views(given: Sequence[Render], views: Sequence[View]) -> list[int]:
    """Choose photographs that the given scene is right from: the half with the smallest errors."""
    order = compute_psnrs(given, views).argsort(descending=True)
    return order[: (len(views) + 1) // 2].tolist()


def compute_psnrs(renders: Sequence[Render], views: Sequence[View]) -> Float[Tensor, "v"]:
    """Compute the PSNR of each photograph apart from its exposure, in dB."""
    errors = [
        compute_error(render.image, view) for render, view in zip(renders, views, strict=True)
    ]
    return -10 * torch.stack(errors).clamp_min(1e-10).log10()


def measure_exposure(
    given: Sequence[Render], shown: Sequence[Render], views: Sequence[View]
) -> Float[Tensor, "3"]:
    """Measure the exposure of the given scene relative to a new one, per channel.

    They are compared where both show the photographs that the given scene is right from.
    """
    old_colors = []
    new_colors = []
    for index in choose_right_views(given, views):
        old = given[index]
        new = shown[index]
        both = (old.alpha >= COVERED) & (new.alpha >= COVERED)
        old_colors.append(old.image[both])
        new_colors.append(new.image[both])
    return compute_median_ratio(torch.cat(new_colors), torch.cat(old_colors))


def multiply_exposure(
    made: InitialContext, views: Sequence[View], factor: Float[Tensor, "3"]
) -> InitialContext:
    """Multiply the exposure of a scene, and of its photographs, by a factor per channel.

    `views` are the photographs as they were given, from which those of `made` are normalized anew.
    """
    scene = made.source.gaussians
    # A colour is a half and a sum of harmonics, of which the first is constant.
    offset = 0.5 * (factor - 1) / SH_C0
    sh = scene.sh * factor
    sh = torch.cat([sh[:, :1] + offset, sh[:, 1:]], dim=1)
    gains = factor.new_ones(len(views), 3) if made.exposure_gains is None else made.exposure_gains
    gains = gains / factor
    normalized = tuple(
        replace(view, image=raw.normalize_exposure(gain).image)
        for view, raw, gain in zip(made.views, views, gains, strict=True)
    )
    source = ContextScene.whole(replace(scene, sh=sh))
    return replace(made, source=source, views=normalized, exposure_gains=gains)
