"""Removal of chosen Gaussians from a begun completion, so that their hole can be completed.

Behind an object a trained splat has Gaussians that no photograph ever showed. They are removed
with it, or else they would fill its hole; at the end those return that photographs need elsewhere.
The photographs still show the object, so their pixels are ignored there. From then on the scene has
full trust: only its holes are completed.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.cleaning import exclude_needed, limit_errors
from gscompleter.errors import InputError
from gscompleter.guards import prepare_guards
from gscompleter.guards.psnr import meet_error_budgets, set_error_budgets
from gscompleter.guards.removal import mask_removed
from gscompleter.render import Renderer
from gscompleter.render.cache import SceneRenderer
from gscompleter.state import Completion
from gscompleter.trust import Trust
from gscompleter.trust.photometric import PhotoObservations, gather_observations
from gscompleter.types import REMOVED, REVEALED, ContextScene, Gaussians, Render, View, merge

TOLERANCE = 0.005
"""Largest loss of PSNR of a photograph, in dB, by revealed Gaussians that do not return."""
MIN_REVEALED = 0.5
"""Share of a Gaussian, in some photograph, that has to come to light for it to be revealed."""
MIN_CONFIRMED = 0.25
"""Share of it that a photograph has to show, before the removal, for it to stay."""
MAX_ROUNDS = 8
"""Layers of unseen Gaussians that are removed behind each other."""


def remove_gaussians(
    state: Completion, chosen: Bool[Tensor, "n"], scenes: SceneRenderer
) -> Completion:
    """Remove chosen Gaussians of the context, and those that no photograph showed behind them.

    A rendered Gaussian that stands for several goes with the last of them.
    """
    source, count = state.source, len(state.parts[0])
    stays = source.stand_ins.where(~chosen, -1)
    asked = torch.ones(count, dtype=torch.bool, device=chosen.device)
    asked = asked.index_fill(0, stays[stays >= 0], False)
    gone = find_revealed(state, asked, scenes)
    if gone.all():
        raise InputError("Nothing would be left of the splat; choose fewer Gaussians.")
    number = torch.where(asked, REMOVED, torch.where(gone, REVEALED, (~gone).cumsum(0) - 1))
    before = torch.arange(REVEALED, 0, device=chosen.device)  # numbers of those already gone
    rendered = source.rendered[~gone]
    context = rendered if state.parts[0] is source.rendered else state.parts[0][~gone]
    changed = replace(
        state,
        source=ContextScene(source.gaussians, rendered, torch.cat([number, before])[stays]),
        parts=(context, *state.parts[1:]),
        trust=Trust(),
    )
    masked = [
        hide_removed(photo.view, state.parts[0], asked, scenes.renderer) for photo in state.photos
    ]
    shown = scenes.freeze_at(changed.parts, [view.camera for view in masked])
    photos = [
        replace(photo, view=paint_over(view, frozen.render))
        for photo, view, frozen in zip(state.photos, masked, shown, strict=True)
    ]
    return prepare_guards(replace(changed, photos=tuple(photos)), scenes)


def restore_needed(state: Completion, renderer: Renderer) -> Completion:
    """Put back revealed Gaussians that photographs need where they do not show what was removed.

    What was generated in the hole stands in front of them by now. It is faded first, until no
    photograph is worse than with all of them.
    """
    source, views = state.source, [photo.view for photo in state.photos]
    revealed = source.stand_ins == REVEALED
    if not revealed.any():
        return state
    hidden = source.gaussians[revealed]
    whole = merge([state.parts[0], hidden])
    added = fade_harmful(state, whole, renderer)
    is_hidden = torch.arange(len(whole), device=revealed.device) >= len(state.parts[0])
    missing = torch.cat([is_hidden, is_hidden.new_zeros(len(added))])
    limits = limit_errors(whole, views, TOLERANCE, renderer)
    missing = exclude_needed(merge([whole, added]), missing, views, limits, renderer)
    back = revealed.masked_scatter(revealed, ~missing[len(state.parts[0]) : len(whole)])
    returned = source.gaussians[back]
    numbers = len(source.rendered) + torch.arange(len(returned), device=revealed.device)
    rendered = merge([source.rendered, returned])
    first = rendered if state.parts[0] is source.rendered else merge([state.parts[0], returned])
    return replace(
        state,
        source=ContextScene(
            source.gaussians, rendered, source.stand_ins.masked_scatter(back, numbers)
        ),
        parts=(first, added),
    )


def fade_harmful(state: Completion, context: Gaussians, renderer: Renderer) -> Gaussians:
    """Fade what was generated until no photograph is worse than `context` alone."""
    config, views = state.config.psnr_guard, [photo.view for photo in state.photos]
    frozen = [renderer.freeze(context, view.camera) for view in views]
    budgets = [
        set_error_budgets(
            view,
            scene.render.image,
            ~view.valid_mask,
            max(config.max_drop, TOLERANCE),
            config.max_ssim_drop,
        )
        for view, scene in zip(views, frozen, strict=True)
    ]
    plans = [scene.vary_opacities(state.added) for scene in frozen]
    return meet_error_budgets(state.added, frozen, budgets, plans, config)


def find_revealed(
    state: Completion, gone: Bool[Tensor, "m"], scenes: SceneRenderer
) -> Bool[Tensor, "m"]:
    """Add to the `gone` those of `state.parts[0]` that only become visible without them."""
    before = observe(state, ~torch.zeros_like(gone), scenes)
    confirmed = (before.areas * before.agreement).amax(dim=0)
    for _ in range(MAX_ROUNDS):
        after = torch.zeros_like(before.areas)
        after[:, ~gone] = observe(state, ~gone, scenes).areas
        most = after.amax(dim=0)
        revealed = (after - before.areas).amax(dim=0) > MIN_REVEALED * most
        revealed &= confirmed < MIN_CONFIRMED * most
        if not revealed.any():
            break
        gone = gone | revealed
    return gone


def observe(state: Completion, left: Bool[Tensor, "m"], scenes: SceneRenderer) -> PhotoObservations:
    """Observe the Gaussians of the first part that are left in all photographs."""
    views, context = [photo.view for photo in state.photos], state.parts[0][left]
    frozen = scenes.freeze_at((context, *state.parts[1:]), [view.camera for view in views])
    return gather_observations(context, views, frozen, state.config.trust_settings)


def hide_removed(
    view: View, scene: Gaussians, removed: Bool[Tensor, "n"], renderer: Renderer
) -> View:
    """Ignore the pixels of a photograph that show Gaussians of `scene` that are removed from it."""
    if not removed.any():
        return view
    mask = mask_removed(scene, removed, view.camera, renderer)
    return replace(view, ignore_mask=mask | ~view.valid_mask)


def paint_over(view: View, render: Render) -> View:
    """Replace the ignored pixels of a photograph by a render, so that no model copies from them."""
    shown = render.image.clamp(0, 1)
    return replace(view, image=torch.where(view.valid_mask[..., None], view.image, shown))
