"""Stage 4: what is added makes no photograph worse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from gscompleter.config import PsnrGuardConfig
from gscompleter.masks import dilate
from gscompleter.render import FrozenView, OpacityImage, image_of
from gscompleter.ssim import RADIUS, ssim_map
from gscompleter.stages.integration import falling_on
from gscompleter.threads import torch_on_one_thread
from gscompleter.types import ErrorBudget, Gaussians, View

HALVINGS = 16
"""How often harmful Gaussians lose half of their opacity, before a view that still does not hold
loses those at its worst pixels."""
REMOVALS = 12
"""How often it does, before it loses all that it sees of them."""
ROUNDING = 1e-4
"""Decibels that a photograph may lose where it may lose nothing."""
REACH = 2
"""Pixels around the worst ones within which Gaussians are lost."""


def error_budgets(
    photograph: View,
    image: Float[Tensor, "h w 3"],
    holes: Bool[Tensor, "h w"],
    tolerance: float,
    ssim_tolerance: float,
) -> tuple[ErrorBudget, ...]:
    """Set how far the render of a photograph may be off, whatever is added.

    The mean squared error counts over the whole photograph, and once more without the holes of the
    context: what closes a hole must not make up for what was good. SSIM counts over all of it.

    Args:
        photograph: What the scene is held against.
        image: The context as its camera sees it.
        holes: Where the context has a hole there.
        tolerance: Largest loss of PSNR, in dB.
        ssim_tolerance: Largest loss of SSIM.

    Returns:
        The budgets, that without the holes first.
    """

    def budget(view: View, metric: Literal["mse", "dssim"]) -> ErrorBudget:
        error = errors(image.clamp(0, 1), ErrorBudget(view, metric, 0.0)).sum().item()
        if metric == "mse":
            return ErrorBudget(view, metric, error_with_loss(error, max(tolerance, ROUNDING)))
        return ErrorBudget(view, metric, error + ssim_tolerance)

    budgets = [budget(replace(photograph, ignored=holes | ~photograph.counted), "mse")]
    if holes.any():
        budgets.append(budget(photograph, "mse"))
    if min(photograph.image.shape[:2]) > 2 * RADIUS:
        budgets.append(budget(photograph, "dssim"))
    return tuple(budgets)


def errors(image: Float[Tensor, "h w 3"], budget: ErrorBudget) -> Float[Tensor, "h w"]:
    """Compute what each pixel adds to the error that a budget limits; differentiable.

    `mse` is the mean squared error, `dssim` is 1 - SSIM, whose windows lie within the image.
    """
    view = budget.view
    compared = view.compared(image)
    if budget.metric == "mse":
        return (compared - view.image).square().mean(dim=-1) / view.counted.numel()
    inner = slice(RADIUS, -RADIUS)
    dissimilar = (1 - ssim_map(compared, view.image).mean(dim=(0, 1)))[inner, inner]
    return pad(dissimilar / dissimilar.numel(), (RADIUS,) * 4)


@torch_on_one_thread()
def do_no_harm(
    added: Gaussians,
    frozen_views: Sequence[FrozenView],
    budgets: Sequence[Sequence[ErrorBudget]],
    config: PsnrGuardConfig = PsnrGuardConfig(),
    drawings: Sequence[OpacityImage] | None = None,
) -> Gaussians:
    """Lower the opacities of `added` until every photograph is within its error budgets.

    Returns nothing of it where that takes so much that the photographs contradict all of it.

    In a view that got worse, a Gaussian is harmful where less opacity would bring the view nearer
    to its photograph. The most harmful ones are halved, no more of them than it takes. Where that
    does not help, as of two that hide each other, those at the pixels that got worse most are
    removed; and in the end every generated Gaussian that the view sees, which restores it. Once all
    that got worse hold, every view is asked anew.

    Args:
        added: Generated Gaussians.
        frozen_views: The scene frozen at the camera of each photograph.
        budgets: The budgets of each photograph.
        config: How it is checked.
        drawings: What draws each of the photographs with other opacities of `added`, where that is
            known already.
    """
    if config.max_drop is None or len(added) == 0:
        return added
    if drawings is None:
        drawings = [image_of(frozen.plan(added)) for frozen in frozen_views]
    before = [frozen.context.image for frozen in frozen_views]
    checks = [Check(*each) for each in zip(budgets, before, drawings, strict=True)]
    opacities, asked = added.opacities, checks
    for trial in range(HALVINGS + REMOVALS + 1):
        worse = those_over(asked, opacities)
        if not worse and len(asked) < len(checks):  # What gave way may have been in front.
            worse = those_over(checks, opacities)
        if not worse:
            break
        lowered = [seen.to_lower(trial, added) for seen in worse]
        left = 0.5 if trial < HALVINGS else 0.0
        opacities = torch.where(torch.stack(lowered).any(dim=0), left * opacities, opacities)
        if is_undone(added.opacities, opacities, config):
            return added[:0]
        asked = [seen.check for seen in worse] if trial + 1 < HALVINGS else checks
    return replace(added, opacities=opacities, encoded=None)


@dataclass(frozen=True)
class Check:
    """A photograph that may not be matched worse than allowed."""

    budgets: Sequence[ErrorBudget]
    before: Float[Tensor, "h w 3"]
    """What it sees of the scene without what is added."""
    draw: OpacityImage
    """What it sees with it."""


@dataclass(frozen=True)
class Drawn:
    """A photograph that is checked, and what is seen there."""

    check: Check
    opacities: Float[Tensor, "n"]
    """Those that are drawn, which `image` has gradients in."""
    image: Float[Tensor, "h w 3"]

    @staticmethod
    def of(check: Check, opacities: Float[Tensor, "n"]) -> Drawn:
        """What `check` sees with these opacities."""
        return Drawn(check, *drawn_with(check.draw, opacities))

    @cached_property
    def broken(self) -> ErrorBudget:
        """The budget that is exceeded most, relative to its limit."""
        return max(self.check.budgets, key=lambda one: self.error(one) / max(one.limit, 1e-12))

    @cached_property
    def excess(self) -> float:
        """Error of the image above the limit of that budget."""
        return self.error(self.broken) - self.broken.limit

    def error(self, budget: ErrorBudget) -> float:
        """Compute the error of the image that `budget` limits."""
        return errors(self.image.detach().clamp(0, 1), budget).sum().item()

    def to_lower(self, trial: int, added: Gaussians) -> Bool[Tensor, "n"]:
        """Choose which of `added` give way.

        SSIM is not linear in opacities: where it is broken, Gaussians at the worst pixels give way
        from the first trial on.
        """
        is_first_order = self.broken.metric == "mse" and trial < HALVINGS
        if not is_first_order and trial < HALVINGS + REMOVALS:
            return self.at_worst(added)
        gradient = gradient_of(self.image, self.broken, self.opacities)
        if is_first_order:
            return fewest(gradient * self.opacities.detach() / 2, self.excess)
        return gradient != 0

    def at_worst(self, added: Gaussians) -> Bool[Tensor, "n"]:
        """Those of `added` at the fewest pixels of the image that make up for its excess."""
        images = (self.image.detach(), self.check.before)
        after, before = (errors(image.clamp(0, 1), self.broken) for image in images)
        relief = after - before
        pixels = fewest(relief.flatten(), self.excess).view(relief.shape)
        return falling_on(dilate(pixels, REACH), added, self.broken.view.camera)


def those_over(checks: Sequence[Check], opacities: Float[Tensor, "n"]) -> list[Drawn]:
    """What the photographs see that are matched worse than allowed with these opacities."""
    drawn = (Drawn.of(check, opacities) for check in checks)
    return [seen for seen in drawn if seen.excess > 0]


def is_undone(
    added: Float[Tensor, "n"], left: Float[Tensor, "n"], config: PsnrGuardConfig = PsnrGuardConfig()
) -> bool:
    """Whether of the opacities of what was `added` so little is `left` that the photographs
    contradict all of it."""
    if config.max_opacity_loss is None or len(added) == 0:
        return False
    return 1 - (left.sum() / added.sum().clamp_min(1e-12)).item() > config.max_opacity_loss


def fewest(relief: Float[Tensor, "n"], needed: float) -> Bool[Tensor, "n"]:
    """The fewest entries whose `relief` adds up to `needed`, or to half of all relief there is.

    Relief is a promise of first order. Where it cannot be enough, the worst go first and the rest
    are judged anew without them.
    """
    helpful = (relief > 0).nonzero()[:, 0]
    most_first, order = relief[helpful].sort(descending=True, stable=True)
    enough = min(needed, most_first.sum().item() / 2)
    taken = helpful[order[most_first.cumsum(0) - most_first < enough]]
    return torch.zeros_like(relief, dtype=torch.bool).index_fill(0, taken, True)


def error_slope(
    draw: OpacityImage, view: View, opacities: Float[Tensor, "n"]
) -> tuple[float, Float[Tensor, "n"]]:
    """Error against the photograph, and how it grows with each opacity."""
    variable, image = drawn_with(draw, opacities)
    gradient = gradient_of(image, ErrorBudget(view, "mse", 0.0), variable)
    return squared_error(view.compared(image.detach()), view.image).item(), gradient


def drawn_with(
    draw: OpacityImage, opacities: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "h w 3"]]:
    """The opacities as what varies, and the image that is drawn with them, which has slopes in
    them."""
    with torch.enable_grad():
        variable = opacities.detach().clone().requires_grad_()
        return variable, draw(variable)


def gradient_of(
    image: Float[Tensor, "h w 3"], budget: ErrorBudget, variable: Float[Tensor, "n"]
) -> Float[Tensor, "n"]:
    """Differentiate the error that a budget limits with respect to what `image` was drawn with."""
    with torch.enable_grad():
        error = errors(image, budget).sum()
    return torch.autograd.grad(error, variable)[0]


def squared_error(image: Float[Tensor, "h w 3"], photograph: Float[Tensor, "h w 3"]) -> Tensor:
    """Mean squared error of the image as it is shown, clipped to [0, 1]."""
    return (image.clamp(0, 1) - photograph).square().mean()


def error_with_loss(error: float, decibel: float) -> float:
    """The mean squared error whose PSNR is `decibel` lower than that of `error`."""
    return error * 10 ** (decibel / 10)
