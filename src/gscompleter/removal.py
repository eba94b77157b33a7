"""Removal of chosen Gaussians from a begun completion, so that their hole can be completed.

Behind an object a trained splat has Gaussians that no photograph ever showed. They are removed
with it, or else they would fill its hole; at the end those return that photographs need elsewhere.
The photographs still show the object, so their pixels are ignored there. From then on the scene has
full trust: only its holes are completed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.cleaning import exclude_needed, limit_errors
from gscompleter.errors import InputError
from gscompleter.guards import prepare_guards
from gscompleter.guards.removal import mask_removed
from gscompleter.render import Renderer, get_view_map
from gscompleter.render.cache import Parts, SceneRenderer
from gscompleter.state import Completion
from gscompleter.trust import Trust
from gscompleter.trust.photometric import compute_color_difference, compute_pixel_areas
from gscompleter.types import ContextScene, Gaussians, Render, View, merge

REMOVED, REVEALED = -1, -2
"""Values of `ContextScene.proxy_index` for Gaussians that were chosen, and for those behind."""
TOLERANCE = 0.01
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
        hide_removed(photo.view, state.parts[0], gone, scenes.renderer) for photo in state.photos
    ]
    shown = scenes.freeze_at(changed.parts, [view.camera for view in masked])
    photos = [
        replace(photo, view=paint_over(view, frozen.render))
        for photo, view, frozen in zip(state.photos, masked, shown, strict=True)
    ]
    return prepare_guards(replace(changed, photos=tuple(photos)), scenes)


def restore_needed(state: Completion, renderer: Renderer) -> Completion:
    """Put back revealed Gaussians that photographs need where they do not show what was removed.

    What was generated in the hole stands in front of them by now.
    """
    source, views = state.source, [photo.view for photo in state.photos]
    revealed = source.stand_ins == REVEALED
    if not revealed.any():
        return state
    hidden, count = source.gaussians[revealed], len(source.rendered)
    limits = limit_errors(merge([state.parts[0], hidden]), views, TOLERANCE, renderer)
    scene = merge([*state.parts, hidden])
    missing = torch.arange(len(scene), device=revealed.device) >= len(scene) - len(hidden)
    missing = exclude_needed(scene, missing, views, limits, renderer)[-len(hidden) :]
    back = revealed.masked_scatter(revealed, ~missing)
    index = source.stand_ins.masked_scatter(
        back, count + torch.arange(len(missing)).to(missing.device)
    )
    returned = source.gaussians[back]
    rendered = merge([source.rendered, returned])
    first = rendered if state.parts[0] is source.rendered else merge([state.parts[0], returned])
    return replace(
        state,
        source=ContextScene(source.gaussians, rendered, index),
        parts=(first, *state.parts[1:]),
    )


def find_revealed(
    state: Completion, gone: Bool[Tensor, "m"], scenes: SceneRenderer
) -> Bool[Tensor, "m"]:
    """Add to the `gone` those of `state.parts[0]` that only become visible without them."""
    views, sigma = [photo.view for photo in state.photos], state.config.trust_settings.color_sigma
    before, confirmed = measure_visibility(state.parts, views, scenes, sigma)
    for _ in range(MAX_ROUNDS):
        parts = (state.parts[0][~gone], *state.parts[1:])
        after = torch.zeros_like(before)
        after[:, ~gone] = measure_visibility(parts, views, scenes, sigma)[0]
        most = after.amax(dim=0)
        revealed = (after - before).amax(dim=0) > MIN_REVEALED * most
        revealed &= confirmed.amax(dim=0) < MIN_CONFIRMED * most
        if not revealed.any():
            break
        gone = gone | revealed
    return gone


def measure_visibility(
    parts: Parts, views: Sequence[View], scenes: SceneRenderer, sigma: float
) -> Float[Tensor, "2 v m"]:
    """Measure how much of each Gaussian of the first part photographs show, in scene units².

    These are visible areas, then those that have the photograph's colour, up to about `sigma`.
    """

    def measure(view: View) -> Float[Tensor, "n 2"]:
        frozen = scenes.freeze(parts, view.camera)
        agrees = torch.exp(-((compute_color_difference(frozen.render, view) / sigma) ** 2))
        layers = torch.stack([torch.ones_like(agrees), agrees, agrees], dim=-1)
        areas = compute_pixel_areas(parts[0].means, view.camera)[:, None]
        return areas * frozen.backproject(layers)[: len(parts[0]), :2]

    return torch.stack(list(get_view_map(parts[0].means)(measure, views)), dim=-1).permute(1, 2, 0)


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
