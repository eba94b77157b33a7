"""Error budgets of photographs, and the fading of additions until all of them are met."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import pad

from gscompleter.config import PsnrGuardConfig
from gscompleter.numerics.geometry import project_mask
from gscompleter.numerics.image_ops import SSIM_RADIUS, dilate, ssim_map
from gscompleter.render.protocols import FrozenScene, OpacityRender
from gscompleter.render.view_map import get_view_map
from gscompleter.system.threads import use_one_torch_thread
from gscompleter.types import ErrorBudget, Gaussians, View

NUM_HALVINGS = 16
"""Rounds of halving opacities before Gaussians at the worst pixels are removed."""
NUM_QUARTERINGS = NUM_HALVINGS // 2
"""Rounds of quartering in their place, after which as little is left of an opacity."""
NUM_REMOVALS = 12
"""Rounds of removal before a photograph loses all generated Gaussians that it sees."""
MIN_PSNR_LOSS = 1e-4
"""Smallest tolerated loss of PSNR in dB, for rounding."""
PIXEL_RADIUS = 2
"""Radius around the worst pixels within which Gaussians are removed, in pixels."""


def set_error_budgets(
    photograph: View,
    image: Float[Tensor, "h w 3"],
    holes: Bool[Tensor, "h w"],
    config: PsnrGuardConfig = PsnrGuardConfig(),
) -> tuple[ErrorBudget, ...]:
    """Set the error budgets of a photograph from the render and holes of the context there.

    The first limits the mean squared error outside of the holes. If there are holes, the second
    limits it over the whole photograph. Both allow a loss of PSNR of `max_drop`, and any loss above
    `invisible_psnr`. The last allows a loss of SSIM of `max_ssim_drop`.
    """

    def set_budget(view: View, metric: Literal["mse", "dssim"]) -> ErrorBudget:
        unlimited = ErrorBudget(view, metric, 0.0)
        error = compute_pixel_errors(image.clamp(0, 1), unlimited).sum().item()
        return ErrorBudget(view, metric, limit_error(metric, error, config))

    # The part without holes has a budget of its own. A closed hole lowers the error of the whole
    # image, and could pay for an error elsewhere: a photograph of 33 dB lost 1.3 dB where its
    # border was filled (decision 009).
    without_holes = replace(photograph, ignore_mask=holes | ~photograph.valid_mask)
    budgets = [set_budget(without_holes, "mse")]
    if holes.any():
        budgets.append(set_budget(photograph, "mse"))

    # Equal PSNR does not exclude visible structure, such as a thin floater over an even wall
    # (decision 010). An image that no window of SSIM fits into has no such budget.
    if min(photograph.image.shape[:2]) > 2 * SSIM_RADIUS:
        budgets.append(set_budget(photograph, "dssim"))
    return tuple(budgets)


def limit_error(metric: Literal["mse", "dssim"], error: float, config: PsnrGuardConfig) -> float:
    """Compute the largest error after the loss that the settings allow of this error."""
    if metric == "dssim":
        return error + config.max_ssim_drop
    # Relative to its error, a photograph that the scene shows perfectly could lose nothing.
    invisible = 10 ** (-config.invisible_psnr / 10)
    return max(add_psnr_loss(error, max(config.max_drop, MIN_PSNR_LOSS)), invisible)


def set_total_budgets(
    photograph: View,
    image: Float[Tensor, "h w 3"],
    holes: Bool[Tensor, "h w"],
    config: PsnrGuardConfig = PsnrGuardConfig(),
) -> tuple[ErrorBudget, ...]:
    """Set the error budgets of a photograph for all targets together, as `set_error_budgets`."""
    total = replace(
        config,
        max_drop=max(config.max_total_drop, 2 * config.max_drop),
        max_ssim_drop=max(config.max_total_ssim_drop, 2 * config.max_ssim_drop),
    )
    return set_error_budgets(photograph, image, holes, total)


def share_budgets(
    budgets: Sequence[ErrorBudget],
    image: Float[Tensor, "h w 3"],
    config: PsnrGuardConfig = PsnrGuardConfig(),
) -> tuple[ErrorBudget, ...]:
    """Limit what one target may use of the error budgets for all targets.

    `image` is the render of the scene at the photograph, before that target.
    """
    if not budgets:
        return ()
    clipped = image.clamp(0, 1)
    sums = [compute_pixel_errors(clipped, budget).sum() for budget in budgets]
    errors = torch.stack(sums).tolist()  # read from a GPU once for all budgets
    return tuple(
        share_budget(budget, error, config) for budget, error in zip(budgets, errors, strict=True)
    )


def share_budget(budget: ErrorBudget, error: float, config: PsnrGuardConfig) -> ErrorBudget:
    """Limit what one target may add to an `error`, within the budget for all targets."""
    own = limit_error(budget.metric, error, config)
    # Of an image without any error, all that may be lost is what is invisible.
    invisible = limit_error("mse", 0.0, config) if budget.metric == "mse" else 0.0
    # Half of what is left: a later target is not refused because an earlier one took all. Before
    # that, the fourth target in a row often was (decision 058).
    half = error + max(budget.limit - error, 0.0) / 2
    limit = max(min(own, half), min(invisible, budget.limit))
    return replace(budget, limit=limit)


def compute_pixel_errors(
    image: Float[Tensor, "h w 3"], budget: ErrorBudget
) -> Float[Tensor, "h w"]:
    """Compute what each pixel adds to the error that a budget limits; differentiable.

    The sum over all pixels is the mean squared error, or 1 - SSIM.
    """
    view = budget.view
    masked = view.fill_ignored(image)
    if budget.metric == "mse":
        return (masked - view.image).square().mean(dim=-1) / view.valid_mask.numel()

    # At the border the window of SSIM reaches into the black around the image, so the mean is over
    # the inner pixels, and the border adds nothing.
    inner = slice(SSIM_RADIUS, -SSIM_RADIUS)
    dissimilar = (1 - ssim_map(masked, view.image).mean(dim=(0, 1)))[inner, inner]
    return pad(dissimilar / dissimilar.numel(), (SSIM_RADIUS,) * 4)


@use_one_torch_thread()
def meet_error_budgets(
    added: Gaussians,
    frozen_views: Sequence[FrozenScene],
    budgets: Sequence[Sequence[ErrorBudget]],
    plans: Sequence[OpacityRender],
    config: PsnrGuardConfig = PsnrGuardConfig(),
    regions: Int64[Tensor, "n"] | None = None,
    is_quick: bool = False,
) -> Gaussians:
    """Fade added Gaussians until every photograph is within its error budgets.

    In a photograph over budget, opacities with a harmful gradient are halved, the most harmful
    first and no more than needed. If that fails, Gaussians at the worst pixels are removed, finally
    all that the photograph sees. Only a photograph that is over budget with none stays so.
    `regions` are numbers from 0 of parts that stand or fall alone, by default one for all: a region
    that loses more than `max_opacity_loss` of its opacity is dropped. If `is_quick`, opacities are
    quartered, in half as many rounds.
    """
    if len(added) == 0:
        return added
    if regions is None:
        regions = torch.zeros_like(added.opacities, dtype=torch.long)
    opacity_before = torch.bincount(regions, weights=added.opacities)
    is_dropped = torch.zeros_like(opacity_before, dtype=torch.bool)

    checks = make_checks(budgets, frozen_views, plans)
    opacities = added.opacities
    active = checks
    num_fadings = NUM_QUARTERINGS if is_quick else NUM_HALVINGS
    faded = 0.25 if is_quick else 0.5
    for trial in count():
        worse = find_over_budget(active, opacities)
        # While opacities fade, only photographs that were over budget are rendered. A
        # Gaussian that faded may have occluded another one in the rest, so that all of them have
        # to be within budget at the end.
        if not worse and len(active) < len(checks):
            worse = find_over_budget(checks, opacities)
        if not worse:
            break

        # A Gaussian that one photograph objects to gives way, whatever it improves in others.
        objections = [render.choose_fading(added, num_fadings - trial) for render in worse]
        is_lowered = torch.stack(objections).any(dim=0)
        # Whatever one photograph loses may have hidden something in another, so this goes on as
        # long as there is something to lose.
        if trial >= num_fadings + NUM_REMOVALS and not (is_lowered & (opacities > 0)).any():
            break
        factor = faded if trial < num_fadings else 0.0
        opacities = torch.where(is_lowered, factor * opacities, opacities)
        # What is left of a region that faded for the most part would be fog.
        opacity_lost = opacity_before - torch.bincount(regions, weights=opacities)
        is_dropped |= opacity_lost > config.max_opacity_loss * opacity_before
        if is_dropped[regions].all():
            return added[:0]
        opacities = opacities.where(~is_dropped[regions], 0.0)
        active = [render.check for render in worse] if trial + 1 < num_fadings else checks
    return replace(added, opacities=opacities, encoded=None)[~is_dropped[regions]]


def find_exceeding(
    budgets: Sequence[Sequence[ErrorBudget]],
    frozen_views: Sequence[FrozenScene],
    plans: Sequence[OpacityRender],
    added: Gaussians,
) -> list[int]:
    """Find the photographs that added Gaussians take over their budgets; return their indices."""
    if len(added) == 0:
        return []
    checks = make_checks(budgets, frozen_views, plans)
    rendered = render_checks(checks, added.opacities)
    return [index for index, render in enumerate(rendered) if render.excess > 0]


def make_checks(
    budgets: Sequence[Sequence[ErrorBudget]],
    frozen_views: Sequence[FrozenScene],
    plans: Sequence[OpacityRender],
) -> list[Check]:
    """Make the check of each photograph."""
    images_before = [frozen.render.image for frozen in frozen_views]
    return [Check(*parts) for parts in zip(budgets, images_before, plans, strict=True)]


@dataclass(frozen=True)
class Check:
    """A photograph with its error budgets."""

    budgets: Sequence[ErrorBudget]
    image_before: Float[Tensor, "h w 3"]
    plan: OpacityRender
    """Differentiable in the opacities of the added Gaussians."""


@dataclass(frozen=True)
class CheckedRender:
    """A photograph's render with given opacities."""

    check: Check
    opacities: Float[Tensor, "n"]
    image: Float[Tensor, "h w 3"]
    worst_budget: ErrorBudget
    """The budget that is exceeded most, relative to its limit."""
    excess: float
    """Error above the limit of that budget."""

    def choose_fading(self, added: Gaussians, num_left: int) -> Bool[Tensor, "n"]:
        """Choose the Gaussians that lose opacity in a round.

        `num_left` is the number of rounds of fading with this one; 0 in the first round of removal,
        and negative after it. In rounds of fading, the gradient chooses those whose fading lowers
        the squared error. SSIM is not linear in opacities, so for it Gaussians at the worst pixels
        are chosen from the first round on.
        """
        uses_gradient = self.worst_budget.metric == "mse" and num_left > 0
        # Two Gaussians that occlude each other both have a helpful gradient, so fading never
        # reaches the budget. Those at the worst pixels go before everything does, or else a hole
        # loses its whole rim (decision 011).
        if not uses_gradient and num_left > -NUM_REMOVALS:
            return self.find_at_worst_pixels(added)

        gradient = compute_gradient(self.image, self.worst_budget, self.opacities)
        # To first order, an error falls by gradient * o / 2 if the opacity o is halved, and by more
        # if it is quartered, which leaves a margin.
        if uses_gradient:
            return select_fewest(gradient * self.opacities.detach() / 2, self.excess)
        # What the photograph does not see has no gradient.
        return gradient != 0

    def find_at_worst_pixels(self, added: Gaussians) -> Bool[Tensor, "n"]:
        """Find Gaussians at the fewest pixels that account for the excess."""
        image_after = self.image.detach().clamp(0, 1)
        image_before = self.check.image_before.clamp(0, 1)
        after = compute_pixel_errors(image_after, self.worst_budget)
        before = compute_pixel_errors(image_before, self.worst_budget)
        relief = after - before
        pixels = select_fewest(relief.flatten(), self.excess).view(relief.shape)
        return project_mask(dilate(pixels, PIXEL_RADIUS), added, self.worst_budget.view.camera)


def find_over_budget(checks: Sequence[Check], opacities: Float[Tensor, "n"]) -> list[CheckedRender]:
    """Render all photographs and return those over budget."""
    return [render for render in render_checks(checks, opacities) if render.excess > 0]


def render_checks(
    checks: Sequence[Check], opacities: Float[Tensor, "n"]
) -> Iterable[CheckedRender]:
    """Render the scene at all photographs, and compare it with their error budgets."""
    return get_view_map(opacities)(partial(render_check, opacities=opacities), checks)


def render_check(check: Check, opacities: Float[Tensor, "n"]) -> CheckedRender:
    """Render the scene at a photograph and compare it with the error budgets.

    Opacities [n] are those of the added Gaussians. The image keeps its gradient, since the same
    render decides which of them fade.
    """
    variable, image = render_with_gradient(check.plan, opacities)
    clipped = image.detach().clamp(0, 1)
    sums = [compute_pixel_errors(clipped, budget).sum() for budget in check.budgets]
    errors = torch.stack(sums).tolist()  # read from a GPU once for all budgets

    # Squared errors and 1 - SSIM have no common unit, so errors are compared relative to limits.
    used = [
        error / max(budget.limit, 1e-12)
        for budget, error in zip(check.budgets, errors, strict=True)
    ]
    worst = used.index(max(used))
    budget = check.budgets[worst]
    return CheckedRender(check, variable, image, budget, errors[worst] - budget.limit)


def select_fewest(relief: Float[Tensor, "n"], needed: float) -> Bool[Tensor, "n"]:
    """Select the fewest entries whose relief sums to `needed`, or to half of all relief.

    The relief of an entry is what the error falls by if it changes. It is a first-order estimate,
    so the other half is re-evaluated after the change.
    """
    helpful = (relief > 0).nonzero()[:, 0]
    # Stable, so that the result does not depend on how equal entries are sorted.
    most_first, order = relief[helpful].sort(descending=True, stable=True)
    enough = min(needed, most_first.sum().item() / 2)
    # An entry is taken as long as those before it do not suffice.
    relief_before = most_first.cumsum(0) - most_first
    taken = helpful[order[relief_before < enough]]
    return torch.zeros_like(relief, dtype=torch.bool).index_fill(0, taken, True)


def compute_mse_and_derivative(
    view: View, image: Float[Tensor, "h w 3"]
) -> tuple[float, Float[Tensor, "h w 3"]]:
    """Compute the mean squared error against a photograph and its derivative in the image.

    The error is that of the clipped image, as it is shown. The derivative is that of the image as
    it is rendered, since a clipped value has none.
    """
    variable = image.detach().requires_grad_()
    derivative = compute_gradient(variable, ErrorBudget(view, "mse", 0.0), variable)
    error = compute_squared_error(view.fill_ignored(image.detach()), view.image).item()
    return error, derivative


def render_with_gradient(
    plan: OpacityRender, opacities: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "h w 3"]]:
    """Render with opacities as the variable of gradients."""
    with torch.enable_grad():
        variable = opacities.detach().clone().requires_grad_()
        return variable, plan(variable).image


def compute_gradient(
    image: Float[Tensor, "h w 3"], budget: ErrorBudget, variable: Float[Tensor, "*shape"]
) -> Float[Tensor, "*shape"]:
    """Differentiate the error that a budget limits."""
    with torch.enable_grad():
        error = compute_pixel_errors(image, budget).sum()
    return torch.autograd.grad(error, variable)[0]


def compute_squared_error(
    image: Float[Tensor, "h w 3"], photograph: Float[Tensor, "h w 3"]
) -> Tensor:
    """Compute the mean squared error of an image clipped to [0, 1]."""
    return (image.clamp(0, 1) - photograph).square().mean()


def add_psnr_loss(error: float, decibel: float) -> float:
    """Compute the mean squared error after a loss of PSNR in dB."""
    return error * 10 ** (decibel / 10)
