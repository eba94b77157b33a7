"""Removal of chosen Gaussians from a begun completion, so that their hole can be completed.

A Gaussian that reaches out of the chosen place is cut at its border. Behind an object a trained
splat has Gaussians that no photograph ever showed. They are removed with it, or else they would
fill its hole; at the end those return that photographs need elsewhere. The photographs still show
the object, so their pixels are ignored there. From then on the scene has full trust: only its holes
are completed. The trust from before is kept for holes elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.editing.cutting import Region, cut
from gscompleter.guards import prepare_guards
from gscompleter.parts import Part, PartOrigin, make_part, split_into_parts
from gscompleter.render.cache import Parts, SceneRenderer
from gscompleter.render.fit_colors import RELAXATION, fit_colors
from gscompleter.render.mask_sums import sum_in_mask
from gscompleter.render.protocols import FrozenScene, Renderer
from gscompleter.render.removed import mask_removed
from gscompleter.render.view_map import get_view_map
from gscompleter.stages.error_budgets import meet_error_budgets, set_error_budgets
from gscompleter.stages.superfluous import (
    PhotographCheck,
    exclude_needed_by_photographs,
    limit_errors,
)
from gscompleter.state import Completion, Photo
from gscompleter.system.errors import InputError
from gscompleter.trust import Trust
from gscompleter.trust.photometric import gather_observations, load_trust, measure_agreement
from gscompleter.types import ContextScene, Gaussians, View, merge

REVEALED_TOLERANCE = 0.003
"""Largest loss of PSNR of a photograph, in dB, by revealed Gaussians that do not return."""
MIN_REVEALED = 0.5
"""Share of a Gaussian, in some photograph, that has to come to light for it to be revealed."""
MIN_SHOWN_BEFORE = 0.25
"""Share of it that a photograph has to show, before the removal, for it to stay."""
MIN_OUTSIDE = 0.05
"""Share of a revealed Gaussian that has to be seen outside of the hole for it to return."""
MAX_LAYERS = 8
"""Layers of unseen Gaussians that are removed behind each other."""
HOLE_COLOR_ROUNDS = 8
"""Rounds of fitting colours of additions to the photographs around the hole."""


def remove_gaussians(
    state: Completion, chosen: Bool[Tensor, "n"], contains: Region, scenes: SceneRenderer
) -> Completion:
    """Remove chosen Gaussians of the context, and those that no photograph showed behind them.

    `chosen` has all n Gaussians of the context, of which m are rendered. Those whose centres lie in
    the region that `contains` tells are removed as far as it reaches, and the rest of them is
    added. A rendered Gaussian that stands for several goes with the last of them. Raises InputError
    if nothing would be left.
    """
    source = state.source
    rendered = state.rendered_context
    # What went earlier, or gave way to photographs, is not there any more.
    chosen = chosen & ~source.gone_mask

    # Rendered Gaussians go if they stand for none but chosen ones.
    used = source.stand_ins[~chosen & ~source.gone_mask]
    unused = torch.ones(len(source.rendered), dtype=torch.bool, device=used.device)
    unused = unused.index_fill(0, used, False)

    inner, outer = cut(source.gaussians[chosen], contains)
    gone, is_outer_revealed = find_revealed(state, unused, inner, outer, scenes)
    # Frozen views of what is not all there any more would be held until they are replaced.
    scenes.clear()
    if gone.all():
        raise InputError("Nothing would be left of the splat; choose fewer Gaussians.")

    is_revealed = source.revealed_mask | source.expand(gone & ~unused)
    remaining = replace(
        source.leave_out(gone),
        chosen_mask=source.chosen_mask | chosen,
        revealed_mask=is_revealed & ~chosen,
        removed=merge([source.removed, replace(inner, sh=inner.sh[:, :1])]),
    )
    # As long as nothing is recoloured, the context of a state is the very object of its source, by
    # which `recolored_mask` knows it.
    left = remaining.rendered if rendered is source.rendered else rendered[~gone]
    # Outer pieces are no Gaussians of the file: they are added to it. Those that come to light only
    # now go for good, as parts of a chosen Gaussian that no photograph showed.
    rest = make_part(PartOrigin("piece"), outer[~is_outer_revealed])
    parts = (*state.added_parts, rest) if len(rest) else state.added_parts
    kept = (~gone).nonzero()[:, 0]
    trust = state.trust if state.trust_elsewhere is None else state.trust_elsewhere
    changed = replace(
        state,
        source=remaining,
        rendered_context=left,
        added_parts=parts,
        trust=Trust(),
        trust_elsewhere=trust.thin(kept, torch.ones_like(left.opacities)),
        is_restored=False,
    )
    changed = replace(changed, photos=paint_photos_over(changed, scenes))
    holes = state.config.holes
    if holes.forces_removed and holes.keeps_confirmed:
        # As a trained splat is trusted: a part of the hole may show a wall that photographs know.
        config = replace(state.config, trust="photometric")
        painted = [photo.view for photo in changed.photos]
        confirmation = load_trust(config, changed.parts, painted, scenes)
        changed = replace(changed, confirmation=confirmation)
    return prepare_guards(changed, scenes)


def paint_photos_over(state: Completion, scenes: SceneRenderer) -> tuple[Photo, ...]:
    """Ignore the pixels of photographs that show what was removed, and paint the scene there.

    They are painted so that no model copies from ignored pixels. Error budgets are dropped: those
    of the photographs with the object would forbid what fills its place.
    """
    views = [hide_removed(photo.view, state.source, scenes.renderer) for photo in state.photos]
    shown = scenes.freeze_at(state.parts, [view.camera for view in views])
    return tuple(
        replace(photo, view=view.paint_ignored(scene.render.image.clamp(0, 1)), budgets=())
        for photo, view, scene in zip(state.photos, views, shown, strict=True)
    )


def restore_surroundings(state: Completion, scenes: SceneRenderer) -> Completion:
    """Let photographs be as good as before where they do not show what was removed.

    What was generated is faded until none is worse than with all revealed Gaussians behind it. Of
    these, the needed return. At last the colours of all additions are fitted. A state without a
    removal, or that is restored already, is returned as it is: colours that are fitted again change
    again.
    """
    source = state.source
    if len(source.removed) == 0 or state.is_restored:
        return state

    # Outer pieces of what was cut, and what photographs showed before, are among the additions, but
    # were not invented.
    views = [photo.view for photo in state.photos]
    known_parts = [part for part in state.added_parts if not part.origin.is_invented]
    invented = [part for part in state.added_parts if part.origin.is_invented]
    rendered = state.rendered_context
    # The empty part in front stands for all of these where there are none.
    known = merge([rendered[:0], *(part.gaussians for part in known_parts)])
    is_revealed = source.revealed_mask
    revealed = source.gaussians[is_revealed]
    invented = fade_harmful(invented, (rendered, known, revealed), state, scenes)

    # The context is frozen once. What is compared with it is added, since it is much smaller; at
    # one photograph at a time, to save memory.
    cameras = [view.camera for view in views]
    scenes.clear()
    context = scenes.freeze_at((rendered,), cameras)
    added = merge([rendered[:0], *(part.gaussians for part in invented)])
    is_needed = find_needed_revealed(revealed, context, known, added, views)

    # Revealed Gaussians that return follow those that are rendered, as rows of their own. No trust
    # has values for these: it takes them for added ones.
    remaining = source
    if is_needed.any():
        returned = revealed[is_needed]
        is_returned = is_revealed.masked_scatter(is_revealed, is_needed)
        rows = len(source.rendered) + torch.arange(len(returned), device=is_returned.device)
        remaining = replace(
            source,
            rendered=merge([source.rendered, returned]),
            proxy_index=source.stand_ins.masked_scatter(is_returned, rows),
            revealed_mask=is_revealed & ~is_returned,
        )
        # Names of what was frozen would hold it in memory beside what replaces it.
        del context
        context = scenes.freeze_at((rendered, returned), cameras)
        is_recolored = rendered is not source.rendered
        rendered = merge([rendered, returned]) if is_recolored else remaining.rendered

    # Additions reach beyond the hole, where photographs tell their colours. Ignored pixels show the
    # scene itself, so that colours stay as they are in the hole.
    parts = [*known_parts, *invented]
    added = merge([rendered[:0], *(part.gaussians for part in parts)])
    images = [
        view.paint_ignored(scene.composite(added).image.clamp(0, 1))
        for view, scene in zip(views, context, strict=True)
    ]
    fitted = fit_colors(added, context, images, [RELAXATION] * HOLE_COLOR_ROUNDS)
    scenes.clear()
    return replace(
        state,
        source=remaining,
        rendered_context=rendered,
        added_parts=tuple(split_into_parts(fitted, parts)),
        is_restored=True,
    )


def find_needed_revealed(
    revealed: Gaussians,
    context: Sequence[FrozenScene],
    known: Gaussians,
    added: Gaussians,
    views: Sequence[View],
) -> Bool[Tensor, "n"]:
    """Find the revealed Gaussians that photographs need where they do not show the removed ones.

    `context` is frozen at the views; `known` and `added` belong to the scene as well. What shows
    hardly anywhere but in the hole is not needed.
    """
    others = merge([known, added])
    is_outside = find_outside(revealed, (scene.extend(others) for scene in context), views)
    candidates = revealed[is_outside]

    # The scene with all candidates, but without additions, sets the limit of each photograph.
    images = (scene.extend(known).extend(candidates).render.image for scene in context)
    limits = limit_errors(images, views, REVEALED_TOLERANCE)

    def check(scene: FrozenScene, view: View, max_error: float) -> PhotographCheck:
        # Extended anew each time: for all photographs it would take too much memory.
        return PhotographCheck(
            view,
            max_error,
            lambda missing: scene.extend(others).composite(candidates.hide(missing)).image,
            lambda: scene.extend(others).vary_opacities(candidates, is_fading=True),
        )

    everything = torch.ones_like(candidates.opacities, dtype=torch.bool)
    checks = [check(*parts) for parts in zip(context, views, limits, strict=True)]
    superfluous = exclude_needed_by_photographs(checks, candidates.opacities, everything)
    return is_outside.masked_scatter(is_outside, ~superfluous)


def find_outside(
    revealed: Gaussians, others: Iterable[FrozenScene], views: Sequence[View]
) -> Bool[Tensor, "n"]:
    """Find the revealed Gaussians that photographs see outside of the hole as well.

    `others` is the scene without them, frozen at the views.
    """
    # Their weights in valid pixels, in ignored ones, and a column of zeros. Valid pixels are those
    # outside of the hole, since those in it are ignored.
    sums = torch.zeros_like(revealed.means)
    for scene, view in zip(others, views, strict=True):
        shown = sum_in_mask(scene.extend(revealed), view.valid_mask.to(sums))
        # Those by which a frozen scene is extended are its last rows.
        sums += shown[len(shown) - len(revealed) :]
    return sums[:, 0] > MIN_OUTSIDE * sums.sum(dim=1)


def fade_harmful(
    parts: Sequence[Part], scene: Parts, state: Completion, scenes: SceneRenderer
) -> list[Part]:
    """Fade what was invented until no photograph is clearly worse than with `scene` alone.

    Clearly is beyond `psnr_guard.max_drop`, or what revealed Gaussians may cost that stay away, if
    that is more. Those that faded stay, but all go if they lose more than `max_opacity_loss`.
    """
    if not parts:
        return []
    added = merge([scene[0][:0], *(part.gaussians for part in parts)])
    config = state.config.psnr_guard
    config = replace(config, max_drop=max(config.max_drop, REVEALED_TOLERANCE))
    views = [photo.view for photo in state.photos]
    frozen = scenes.freeze_at(scene, [view.camera for view in views])
    budgets = [
        set_error_budgets(view, shown.render.image, ~view.valid_mask, config)
        for view, shown in zip(views, frozen, strict=True)
    ]
    plans = [shown.vary_opacities(added) for shown in frozen]
    faded = meet_error_budgets(added, frozen, budgets, plans, config)
    return list(split_into_parts(faded, parts)) if len(faded) else []


def find_revealed(
    state: Completion,
    unused: Bool[Tensor, "m"],
    inner: Gaussians,
    outer: Gaussians,
    scenes: SceneRenderer,
) -> tuple[Bool[Tensor, "m"], Bool[Tensor, "o"]]:
    """Find what goes: the `unused` Gaussians of the context, and those that only they hid.

    In place of the unused ones, the scene before the removal has their `inner` and `outer` pieces.
    Returns masks of the m rendered Gaussians that go, and of the outer pieces that come to light.
    """
    # One set of rows for all that may go: the context, in which the unused Gaussians are invisible,
    # then their pieces. Of these, the inner ones go in any case.
    rendered = state.rendered_context
    others = rendered.hide(unused)
    gone = torch.cat([unused, unused.new_ones(len(inner)), unused.new_zeros(len(outer))])
    # Areas do not depend on colours by direction. Those that are left lie in a file as they did, so
    # that frozen views do, too.
    uncolored = merge([replace(part, sh=part.sh[:, :1]) for part in (others, inner, outer)])

    added = state.parts[1:]
    views = [photo.view for photo in state.photos]
    frozen = scenes.freeze_at((others, inner, outer, *added), [view.camera for view in views])
    before = gather_observations(uncolored, views, frozen, state.config.trust_settings)
    # Each photograph may hold a million sorted Gaussians; the rounds below make others.
    del frozen
    confirmed_area = (before.areas * before.agreement).amax(dim=0)
    areas_before = before.areas
    del before
    # A round reveals the next layer: what is behind it was hidden until then.
    for _ in range(MAX_LAYERS):
        areas = measure_areas((uncolored.hide(gone), *added), views, scenes)
        largest = areas.amax(dim=0)
        # In place, since there is a number for each Gaussian in each photograph.
        revealed = areas.sub_(areas_before).amax(dim=0) > MIN_REVEALED * largest
        # What a photograph showed before, in the right colours, was trained on and stays.
        revealed &= confirmed_area < MIN_SHOWN_BEFORE * largest
        if not revealed.any():
            break
        gone = gone | revealed.to(gone.device)
    return gone[: len(rendered)], gone[len(gone) - len(outer) :]


def measure_areas(
    parts: Parts, views: Sequence[View], scenes: SceneRenderer
) -> Float[Tensor, "k m"]:
    """Measure the visible area of each Gaussian of the first part in photographs, on the CPU."""
    means = parts[0].means
    areas = torch.zeros((len(views), len(means)), dtype=means.dtype)
    frozen = scenes.freeze_at(parts, [view.camera for view in views])

    def measure(k: int) -> None:
        # The area is wanted alone, which no agreement changes.
        nothing = torch.zeros_like(views[k].image[..., 0])
        areas[k], _ = measure_agreement(frozen[k], means, views[k], nothing)

    # The map is lazy on a GPU: each photograph is measured when its result is asked for.
    for _ in get_view_map(means)(measure, range(len(views))):
        pass
    return areas


def hide_removed(view: View, source: ContextScene, renderer: Renderer) -> View:
    """Ignore the pixels of a photograph that show something removed."""
    if len(source.removed) == 0:
        return view
    mask = mask_removed(source, view.camera, renderer)
    return replace(view, ignore_mask=mask | ~view.valid_mask)
