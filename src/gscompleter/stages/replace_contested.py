"""Replacement of what earlier commands made by what photographs show (not in the paper).

Φ invents where no photograph looks. Photographs of that place may come later, and show something
else: what was invented then stands in front of it, or in its place. What Ψ lifted from few
photographs may be as wrong: where one of them shows a door alone, its depth is a guess. So
Gaussians that photographs contest step aside while photographs are added (`add_observed`). Then
those return that the photographs need, by the rule of the cleaning, or that are hidden by what they
show. Gaussians of a user never step aside.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import CleaningConfig
from gscompleter.numerics.image_ops import average_box
from gscompleter.parts import EarlierWork, PartOrigin, make_part
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.protocols import FrozenScene, OpacityRender, Renderer
from gscompleter.render.view_map import get_view_map
from gscompleter.stages.add_observed import (
    MIN_ADDED_SHARE,
    compare_colors,
    find_usable,
    keep_large_regions,
)
from gscompleter.stages.error_budgets import MIN_PSNR_LOSS, add_psnr_loss, meet_error_budgets
from gscompleter.stages.hole_masks import compute_hole_mask
from gscompleter.stages.superfluous import (
    FADED_OPACITY,
    exclude_needed_additions,
    limit_errors,
    sum_error_changes,
)
from gscompleter.state import Completion
from gscompleter.trust.photometric import sum_weights
from gscompleter.types import ContextScene, ErrorBudget, Gaussians, Render, View, merge

MAX_ROUNDS = 8
"""Most layers of Gaussians that step aside, one behind the other."""
MIN_LAYER = 0.01
"""Smallest layer, as a share of those that stepped aside before, behind which a further one is
looked for. Of a fountain and a room five rounds after the third found 0.1 %."""
MIN_WEIGHT = 0.5
"""Compositing weight of invented Gaussians from which on a pixel shows them."""
MIN_SUM = 1e-3
"""Compositing weight, summed over pixels, from which on a photograph shows a Gaussian."""
MIN_VISIBLE = 0.5
"""Share of an invented Gaussian that is not hidden by others, from which on it is in their way."""
ERROR_RADIUS = 2
"""Radius in pixels over which errors with and without invented Gaussians are compared."""
ROUNDING_ERROR = 1e-7
"""Mean squared error that may come of rounding alone (70 dB)."""


@dataclass(frozen=True)
class Contested:
    """Gaussians that photographs contest, and the scene with them."""

    given: Completion
    rows: Bool[Tensor, "m"]
    """Those among the rendered Gaussians of `given`."""

    def place(self, values: Bool[Tensor, "c"]) -> Bool[Tensor, "m"]:
        """Place values of the contested Gaussians at their rows; all other rows are False."""
        return self.rows.masked_scatter(self.rows, values)


@dataclass(frozen=True)
class ContestedPixels:
    """The pixels of a photograph in which it contests what earlier commands made."""

    of_invented: Bool[Tensor, "h w"]
    """Without what was invented the scene is empty or fits the photograph better; or the photograph
    shows something else than the scene."""
    of_lifted: Bool[Tensor, "h w"]
    """The photograph shows something else than the scene, in regions that are large enough."""


def find_contested(
    state: Completion, earlier: EarlierWork, scenes: SceneRenderer
) -> Contested | None:
    """Find Gaussians of a begun scene that stand where photographs show something else.

    They are among those that Φ invented, and that Ψ lifted from photographs. Returns None if none
    are contested, and without `add_observed`, as in the paper: nothing that photographs show would
    take their place.
    """
    if not state.config.add_observed or (earlier.invented is None and earlier.lifted is None):
        return None
    is_invented = mark_rendered(state.source, earlier.invented)
    is_lifted = mark_rendered(state.source, earlier.lifted) & ~is_invented
    if not (is_invented | is_lifted).any():
        return None

    rendered = state.source.rendered
    pixels = find_contested_pixels(state, rendered[~is_invented], scenes)
    gone = torch.zeros_like(is_invented)
    # A round lets the next layer step aside: what is behind the first was hidden until then.
    for _ in range(MAX_ROUNDS):
        there = ~gone
        found = find_contested_rows(
            rendered[there], is_invented[there], is_lifted[there], state, pixels, scenes.renderer
        )
        num_before = int(gone.sum())
        gone = gone.masked_scatter(there, found)
        if int(found.sum()) <= MIN_LAYER * num_before:
            break
    return Contested(state, gone) if gone.any() else None


def mark_rendered(source: ContextScene, rows: Bool[Tensor, "n"] | None) -> Bool[Tensor, "m"]:
    """Mark the rendered Gaussians that stand for some of the context alone; none for None."""
    marked = torch.zeros(
        len(source.rendered), dtype=torch.bool, device=source.rendered.means.device
    )
    return marked if rows is None else ~marked.index_fill(0, source.stand_ins[~rows], True)


def find_contested_pixels(
    state: Completion, others: Gaussians, scenes: SceneRenderer
) -> list[ContestedPixels]:
    """Find the pixels of photographs in which they contest what earlier commands made.

    `others` is the scene without what was invented.
    """
    views = [photo.view for photo in state.photos]
    frozen = scenes.freeze_at(state.parts, [view.camera for view in views])
    renders = [scene.render for scene in frozen]
    differences, limit = compare_colors(views, renders)

    def find(view: View, render: Render, difference: Float[Tensor, "h w"]) -> ContestedPixels:
        rest = scenes.renderer.render(others, view.camera)
        is_empty = compute_hole_mask(rest.alpha, state.config.holes)
        is_worse = measure_error(render, view) > measure_error(rest, view)
        is_usable = find_usable(view)
        is_other = (difference > limit) & is_usable
        return ContestedPixels(
            of_invented=((is_empty | is_worse) & is_usable) | is_other,
            of_lifted=keep_large_regions(is_other),
        )

    return list(get_view_map(others.means, len(others))(find, views, renders, differences))


def measure_error(render: Render, view: View) -> Float[Tensor, "h w"]:
    """Measure the squared error of a render, averaged over a few pixels."""
    error = (view.fill_ignored(render.image.clamp(0, 1)) - view.image).square().mean(dim=-1)
    return average_box(error, ERROR_RADIUS)


def find_contested_rows(
    scene: Gaussians,
    is_invented: Bool[Tensor, "m"],
    is_lifted: Bool[Tensor, "m"],
    state: Completion,
    pixels: Sequence[ContestedPixels],
    renderer: Renderer,
) -> Bool[Tensor, "m"]:
    """Find the Gaussians that photographs show mostly in the pixels in which they contest them."""

    def sum_shown(view: View, contested: ContestedPixels) -> Float[Tensor, "m 3"]:
        frozen = renderer.freeze(scene, view.camera)
        shown = contested.of_invented & (frozen.splat(is_invented.to(scene.means)) > MIN_WEIGHT)
        # Along its borders every photograph shows a little of what was added beside it.
        if shown.float().mean() < MIN_ADDED_SHARE:
            shown = torch.zeros_like(shown)
        layers = torch.stack([shown, contested.of_lifted, torch.ones_like(shown)], dim=-1)
        return frozen.backproject(layers.to(scene.means))

    sums = torch.zeros_like(scene.means)
    views = [photo.view for photo in state.photos]
    for part in get_view_map(scene.means, len(scene))(sum_shown, views, pixels):
        sums += part
    in_invented, in_lifted, total = sums.unbind(dim=1)
    contested = torch.where(is_invented, in_invented, in_lifted)
    return (is_invented | is_lifted) & (contested > total / 2) & (contested > MIN_SUM)


def let_step_aside(state: Completion, contested: Contested | None) -> Completion:
    """Return the scene without the contested Gaussians; the same if there are none."""
    return state if contested is None else drop_rows(state, state, contested.rows)


def drop_rows(state: Completion, given: Completion, rows: Bool[Tensor, "m"]) -> Completion:
    """Return a state whose context is that of the given scene without some rendered Gaussians."""
    source = given.source
    if rows.any():
        source = replace(source.leave_out(rows), replaced_mask=source.expand(rows))
    return replace(state, source=source, rendered_context=source.rendered)


def return_needed(
    state: Completion,
    contested: Contested | None,
    scenes: SceneRenderer,
    config: CleaningConfig = CleaningConfig(),
) -> Completion:
    """Let contested Gaussians return that photographs need, or that these hide.

    `state` is the scene without them, with what photographs show. The others gave way.
    """
    if contested is None:
        return state
    given = contested.given
    candidates = given.source.rendered[contested.rows]
    views = [photo.view for photo in state.photos]
    frozen = scenes.freeze_at(state.parts, [view.camera for view in views])
    plans = [scene.vary_opacities(candidates, is_fading=True) for scene in frozen]
    is_dropped = find_unneeded_candidates(candidates, views, frozen, plans, scenes.renderer, config)

    # No photograph may be worse than it was with all of them.
    limits = limit_errors(render_all(given, views, scenes.renderer), views, config.tolerance)
    dropped = exclude_needed_additions(plans, candidates.opacities, is_dropped, views, limits)
    faded = fade_before_returned(
        drop_rows(state, given, contested.place(dropped)), views, limits, scenes
    )
    if are_within(limits, faded, views, scenes.renderer):
        return faded

    # Candidates gave way to what photographs added, and that has faded: all of it, if most had to.
    # A photograph of 42 dB ended at 17 dB. Without it, at most all of them return: the scene as it
    # was.
    bare = replace(state, added_parts=())
    frozen = scenes.freeze_at(bare.parts, [view.camera for view in views])
    plans = [scene.vary_opacities(candidates, is_fading=True) for scene in frozen]
    dropped = exclude_needed_additions(plans, candidates.opacities, dropped, views, limits)
    return drop_rows(bare, given, contested.place(dropped))


def are_within(
    limits: Sequence[float], state: Completion, views: Sequence[View], renderer: Renderer
) -> bool:
    """Check whether all photographs are within limits of their mean squared error in a scene."""
    errors = limit_errors(render_all(state, views, renderer), views, tolerance=0.0)
    return all(
        error <= add_psnr_loss(limit, MIN_PSNR_LOSS) + ROUNDING_ERROR
        for error, limit in zip(errors, limits, strict=True)
    )


def render_all(
    state: Completion, views: Sequence[View], renderer: Renderer
) -> Iterator[Float[Tensor, "_ _ 3"]]:
    """Render the whole scene at each photograph."""
    for render in render_at_views(merge(state.parts), views, renderer):
        yield render.image


def render_at_views(
    scene: Gaussians, views: Sequence[View], renderer: Renderer
) -> Iterator[Render]:
    """Render a scene at the cameras of photographs."""
    for view in views:
        yield renderer.render(scene, view.camera)


def fade_before_returned(
    state: Completion, views: Sequence[View], limits: Sequence[float], scenes: SceneRenderer
) -> Completion:
    """Fade what photographs added until each photograph is within a mean squared error, if it can.

    Some of it stands before Gaussians that returned, by which the photographs that these were
    lifted from lose: 0.3 dB of 36 at a fountain.
    """
    if not state.added_parts:
        return state
    added = merge([part.gaussians for part in state.added_parts])
    frozen = scenes.freeze_at((state.rendered_context,), [view.camera for view in views])
    budgets = [[ErrorBudget(view, "mse", limit)] for view, limit in zip(views, limits, strict=True)]
    plans = [scene.vary_opacities(added) for scene in frozen]
    kept = meet_error_budgets(added, frozen, budgets, plans, state.config.psnr_guard)
    parts = (make_part(PartOrigin("photographs"), kept),) if len(kept) else ()
    return replace(state, added_parts=parts)


def find_unneeded_candidates(
    candidates: Gaussians,
    views: Sequence[View],
    frozen: Sequence[FrozenScene],
    plans: Sequence[OpacityRender],
    renderer: Renderer,
    config: CleaningConfig,
) -> Bool[Tensor, "c"]:
    """Find candidates by which photographs lose, or that stand needlessly before what they show.

    `frozen` is the scene without them, and `plans` render it with them at other opacities. All of
    them are faint in the comparison: otherwise those that are behind others look needless.
    """
    are_faint = torch.ones_like(candidates.opacities, dtype=torch.bool)
    changes = sum_error_changes(candidates.opacities, are_faint, views, frozen, plans, config)

    # What photographs do not show, since something is before it, contradicts none of them.
    faint = replace(candidates, opacities=candidates.opacities.clamp_max(FADED_OPACITY))
    visible = torch.zeros_like(candidates.opacities)
    alone = torch.zeros_like(candidates.opacities)
    for view, scene in zip(views, frozen, strict=True):
        visible += sum_weights(scene.extend(faint))[-len(candidates) :]
        alone += sum_weights(renderer.freeze(faint, view.camera))
    is_in_the_way = visible > MIN_VISIBLE * alone
    can_go = is_in_the_way | changes.find_harmful(config)
    return changes.are_observed & changes.find_removable(config) & can_go
