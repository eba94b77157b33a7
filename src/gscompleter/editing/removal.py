"""Removal of chosen Gaussians from a begun completion, so that their hole can be completed.

A Gaussian that reaches out of the chosen place is cut at its border. Behind an object a trained
splat has Gaussians that no photograph ever showed. They are removed with it, or else they would
fill its hole; at the end those return that photographs need elsewhere. The photographs still show
the object, so their pixels are ignored there. From then on the scene has full trust: only its holes
are completed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gscompleter.editing.cleaning import exclude_needed, limit_errors
from gscompleter.editing.cutting import Region, cut
from gscompleter.guards import prepare_guards
from gscompleter.guards.psnr import meet_error_budgets, set_error_budgets
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.fit_colors import RELAXATION, fit_colors
from gscompleter.render.protocols import FrozenScene, Renderer
from gscompleter.render.removed import mask_removed
from gscompleter.state import NEW_PHOTO_ID, Completion, Photo
from gscompleter.system.errors import InputError
from gscompleter.trust import Trust
from gscompleter.trust.photometric import PhotoObservations, gather_observations
from gscompleter.types import REMOVED, REVEALED, ContextScene, Gaussians, Render, View, merge

TOLERANCE = 0.003
"""Largest loss of PSNR of a photograph, in dB, by revealed Gaussians that do not return."""
MIN_REVEALED = 0.5
"""Share of a Gaussian, in some photograph, that has to come to light for it to be revealed."""
MIN_CONFIRMED = 0.25
"""Share of it that a photograph has to show, before the removal, for it to stay."""
MIN_OUTSIDE = 0.05
"""Share of a revealed Gaussian that has to be seen outside of the hole for it to return."""
MAX_ROUNDS = 8
"""Layers of unseen Gaussians that are removed behind each other."""
COLOR_ROUNDS = 8
"""Rounds of fitting colours of additions to the photographs around the hole."""


def remove_gaussians(
    state: Completion, chosen: Bool[Tensor, "n"], contains: Region, scenes: SceneRenderer
) -> Completion:
    """Remove chosen Gaussians of the context, and those that no photograph showed behind them.

    Those in a region are removed as far as it reaches, and the rest of them is added.
    A rendered Gaussian that stands for several goes with the last of them.
    """
    source, first = state.source, state.parts[0]
    asked = find_unused(source, chosen)
    inner, outer = cut(source.gaussians[chosen], contains)
    gone, hidden = find_revealed(state, asked, inner, outer, scenes)
    if gone.all():
        raise InputError("Nothing would be left of the splat; choose fewer Gaussians.")
    left = replace(
        source,
        rendered=source.rendered[~gone],
        proxy_index=number_left(source, chosen, asked, gone),
        removed=merge([source.removed, replace(inner, sh=inner.sh[:, :1])]),
    )
    context = left.rendered if first is source.rendered else first[~gone]
    rest = replace(outer, generated=torch.full_like(outer.generated, NEW_PHOTO_ID))[~hidden]
    parts = (context, *state.parts[1:], *([rest] if len(rest) else []))
    changed = replace(state, source=left, parts=parts, trust=Trust())
    photos = hide_in_photographs(changed, scenes)
    return prepare_guards(replace(changed, photos=photos), scenes)


def find_unused(source: ContextScene, chosen: Bool[Tensor, "n"]) -> Bool[Tensor, "m"]:
    """Find the rendered Gaussians that stand for none but chosen ones."""
    used = source.stand_ins[~chosen & ~source.gone_mask]
    unused = torch.ones(len(source.rendered), dtype=torch.bool, device=used.device)
    return unused.index_fill(0, used, False)


def number_left(
    source: ContextScene,
    chosen: Bool[Tensor, "n"],
    asked: Bool[Tensor, "m"],
    gone: Bool[Tensor, "m"],
) -> Int64[Tensor, "n"]:
    """Compute the `proxy_index` of what is left: rendered Gaussians are numbered anew."""
    number = torch.where(asked, REMOVED, torch.where(gone, REVEALED, (~gone).cumsum(0) - 1))
    before = torch.arange(REVEALED, 0, device=chosen.device)  # numbers of those already gone
    return torch.cat([number, before])[source.stand_ins.where(~chosen, REMOVED)]


def restore_surroundings(state: Completion, renderer: Renderer) -> Completion:
    """Let photographs be as good as before where they do not show what was removed.

    What was generated is faded until none is worse than with all revealed Gaussians behind it. Of
    these, the needed return. At last the colours of all additions are fitted.
    """
    source, views = state.source, [photo.view for photo in state.photos]
    if len(source.removed) == 0:
        return state
    is_rest, back = state.added.generated == NEW_PHOTO_ID, source.stand_ins == REVEALED
    revealed, rest = source.gaussians[back], state.added[is_rest]
    known = merge([state.parts[0], rest])
    added = fade_harmful(state.added[~is_rest], merge([known, revealed]), state, renderer)
    needed = find_needed(revealed, known, added, views, renderer)
    back, returned = back.masked_scatter(back, needed), revealed[needed]
    numbers = len(source.rendered) + torch.arange(len(returned), device=back.device)
    rendered = merge([source.rendered, returned])
    first = rendered if state.parts[0] is source.rendered else merge([state.parts[0], returned])
    index = source.stand_ins.masked_scatter(back, numbers)
    return replace(
        state,
        source=replace(source, rendered=rendered, proxy_index=index),
        parts=(first, fit_to_photographs(merge([rest, added]), first, views, renderer)),
    )


def find_needed(
    revealed: Gaussians,
    known: Gaussians,
    added: Gaussians,
    views: Sequence[View],
    renderer: Renderer,
) -> Bool[Tensor, "n"]:
    """Find the revealed Gaussians that photographs need where they do not show the removed ones.

    What shows hardly anywhere but in the hole is not needed.
    """
    found = find_outside(revealed, merge([known, added]), views, renderer)
    whole = merge([known, revealed[found]])
    missing = torch.arange(len(whole) + len(added), device=found.device)
    missing = (missing >= len(known)) & (missing < len(whole))
    limits = limit_errors(whole, views, TOLERANCE, renderer)
    missing = exclude_needed(merge([whole, added]), missing, views, limits, renderer)
    return found.masked_scatter(found, ~missing[len(known) : len(whole)])


def find_outside(
    revealed: Gaussians, others: Gaussians, views: Sequence[View], renderer: Renderer
) -> Bool[Tensor, "n"]:
    """Find the revealed Gaussians that photographs see outside of the hole as well."""
    scene, sums = merge([others, revealed]), torch.zeros_like(revealed.means)
    for view in views:
        frozen = renderer.freeze(scene, view.camera)
        sums += sum_in_mask(frozen, view.valid_mask.to(sums))[len(others) :]
    return sums[:, 0] > MIN_OUTSIDE * sums.sum(dim=1)


def sum_in_mask(frozen: FrozenScene, inside: Float[Tensor, "h w"]) -> Float[Tensor, "n 3"]:
    """Sum how much of each Gaussian is shown inside and outside of a mask; the third sum is 0."""
    return frozen.backproject(torch.stack([inside, 1 - inside, torch.zeros_like(inside)], dim=-1))


def fit_to_photographs(
    added: Gaussians, context: Gaussians, views: Sequence[View], renderer: Renderer
) -> Gaussians:
    """Fit the colours of additions to photographs, and leave them as they are in the hole."""
    frozen = [renderer.freeze(context, view.camera) for view in views]
    images = [
        paint_over(view, scene.composite(added)) for view, scene in zip(views, frozen, strict=True)
    ]
    return fit_colors(added, frozen, images, [RELAXATION] * COLOR_ROUNDS)


def fade_harmful(
    added: Gaussians, context: Gaussians, state: Completion, renderer: Renderer
) -> Gaussians:
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
    plans = [scene.vary_opacities(added) for scene in frozen]
    return meet_error_budgets(added, frozen, budgets, plans, config)


def find_revealed(
    state: Completion,
    asked: Bool[Tensor, "m"],
    inner: Gaussians,
    outer: Gaussians,
    scenes: SceneRenderer,
) -> tuple[Bool[Tensor, "m"], Bool[Tensor, "o"]]:
    """Add to those `asked` for, of `state.parts[0]`, what only becomes visible without them.

    Also returns which `outer` pieces do. With `inner` ones they stand for those asked for.
    """
    first = state.parts[0]
    others = replace(first, opacities=first.opacities.masked_fill(asked, 0.0), encoded=None)
    state = replace(state, parts=(merge([others, inner, outer]), *state.parts[1:]))
    gone = torch.cat([asked, asked.new_ones(len(inner)), asked.new_zeros(len(outer))])
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
    return gone[: len(first)], gone[len(gone) - len(outer) :]


def observe(state: Completion, left: Bool[Tensor, "m"], scenes: SceneRenderer) -> PhotoObservations:
    """Observe the Gaussians of the first part that are left in all photographs."""
    views, context = [photo.view for photo in state.photos], state.parts[0][left]
    frozen = scenes.freeze_at((context, *state.parts[1:]), [view.camera for view in views])
    return gather_observations(context, views, frozen, state.config.trust_settings)


def hide_in_photographs(state: Completion, scenes: SceneRenderer) -> tuple[Photo, ...]:
    """Ignore the pixels of photographs that show something removed, and paint them over."""
    views = [hide_removed(photo.view, state.source, scenes.renderer) for photo in state.photos]
    shown = scenes.freeze_at(state.parts, [view.camera for view in views])
    return tuple(
        replace(photo, view=paint_over(view, scene.render))
        for photo, view, scene in zip(state.photos, views, shown, strict=True)
    )


def hide_removed(view: View, source: ContextScene, renderer: Renderer) -> View:
    """Ignore the pixels of a photograph that show something removed."""
    if len(source.removed) == 0:
        return view
    mask = mask_removed(source, view.camera, renderer)
    return replace(view, ignore_mask=mask | ~view.valid_mask)


def paint_over(view: View, render: Render) -> View:
    """Replace the ignored pixels of a photograph by a render, so that no model copies from them."""
    shown = render.image.clamp(0, 1)
    return replace(view, image=torch.where(view.valid_mask[..., None], view.image, shown))
