"""Refinement for input splats: appearance of added Gaussians under error budgets.

A trained splat fits its photographs so well that any addition makes them worse. So opacity and SH
of added Gaussians are fitted to the image in the holes, with a penalty on exceeded error budgets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from gscompleter.config import ReconcileConfig
from gscompleter.cpu_threads import use_one_torch_thread
from gscompleter.optim import Adam
from gscompleter.progress import track
from gscompleter.render import AppearanceError, AppearanceRender, FrozenScene
from gscompleter.types import SH_C0, ErrorBudget, Gaussians, View

Appearance = tuple[Float[Tensor, "n"], Float[Tensor, "n k 3"]]
"""Opacities and spherical harmonics."""

INITIAL_OPACITY = 0.2
"""Initial opacity as a fraction; growing harms photographs less than fading."""
TARGET_ERROR = 0.99
"""Fraction of the allowed error that the fit aims at, as a reserve."""
MAX_SH_COEFFICIENT = 0.2
"""Largest view-dependent SH coefficient."""


@use_one_torch_thread()
def refine_appearance(
    added: Gaussians,
    frozen_target: FrozenScene,
    reference: View,
    holes: Bool[Tensor, "h w"],
    plans: Sequence[AppearanceRender],
    budgets: Sequence[ErrorBudget],
    config: ReconcileConfig = ReconcileConfig(),
) -> tuple[Gaussians, tuple[float, ...]]:
    """Fit opacity and SH of added Gaussians to the holes within the photographs' error budgets.

    Returns:
        The Gaussians and the loss per iteration. `meet_error_budgets` then enforces the budgets.
    """
    if config.iterations == 0 or len(added) == 0:
        return added, ()
    fit = AppearanceFit(added, config)
    plan = frozen_target.vary_appearance(added, holes)
    at_target = plan.make_error(reference.image, compute_pixel_weights(holes))
    before = compute_hole_error(frozen_target.render.image, reference, holes).clamp_min(1e-12)
    photos = [BudgetedPhoto.from_budget(*each) for each in zip(plans, budgets, strict=True)]
    with torch.no_grad():
        appearance = fit.compute_appearance()
        turns = PhotoSchedule(
            [photograph.compute_excess(appearance).item() for photograph in photos]
        )
    weight = config.photograph_weight / config.views_per_step
    losses = []
    for _ in track(range(config.iterations), "Refining"):
        appearance = fit.compute_appearance()
        loss = at_target(*appearance) / before
        for over in compute_excesses(appearance, photos, turns, config.views_per_step):
            loss = loss + weight * over
        fit.step(loss)
        losses.append(loss.item())
    return fit.build_gaussians(), tuple(losses)


def compute_excesses(
    appearance: Appearance, photos: Sequence[BudgetedPhoto], schedule: PhotoSchedule, count: int
) -> list[Float[Tensor, ""]]:
    """Compute the excess of the next `count` photographs, and return the positive ones."""
    chosen = schedule.take(count)
    found = [photos[k].compute_excess(appearance) for k in chosen]
    for k, over in zip(chosen, found, strict=True):
        schedule.excess[k] = over.item()
    return [over for over in found if over > 0]


@dataclass(frozen=True)
class BudgetedPhoto:
    """A photograph with the largest error that it may have."""

    error: AppearanceError
    """Mean squared error of its render, differentiable."""
    max_error: float

    @staticmethod
    def from_budget(plan: AppearanceRender, budget: ErrorBudget) -> BudgetedPhoto:
        """Create it from a budget and a differentiable image."""
        view = budget.view
        return BudgetedPhoto(
            plan.make_error(view.image, compute_pixel_weights(view.valid_mask)),
            max(budget.limit, 1e-12),
        )

    def compute_excess(self, appearance: Appearance) -> Float[Tensor, ""]:
        """Compute the error above its goal, relative to the largest error."""
        return (self.error(*appearance) / self.max_error - TARGET_ERROR).clamp_min(0.0)


class AppearanceFit:
    """Optimizer of the appearance of added Gaussians."""

    def __init__(self, added: Gaussians, config: ReconcileConfig) -> None:
        self._added = added
        self._sh = resize_sh(added.sh, (config.sh_degree + 1) ** 2).requires_grad_()
        self._logits = (INITIAL_OPACITY * added.opacities).logit(eps=1e-4).requires_grad_()
        rates = [(self._logits, config.opacity_step), (self._sh, config.color_step)]
        self._optimizer = Adam(rates, (config.beta1, config.beta2))

    def compute_appearance(self) -> Appearance:
        """Return the current opacities and SH; differentiable."""
        return self._logits.sigmoid(), self._sh

    def step(self, loss: Float[Tensor, ""]) -> None:
        """Take one gradient step and clamp colours."""
        self._optimizer.step(loss)
        clamp_colors(self._sh)

    def build_gaussians(self) -> Gaussians:
        """Return the fitted Gaussians."""
        opacities, sh = self._logits.detach().sigmoid(), self._sh.detach()
        return replace(self._added, opacities=opacities, sh=sh, encoded=None)


def resize_sh(sh: Float[Tensor, "n k 3"], count: int) -> Float[Tensor, "n l 3"]:
    """Copy spherical harmonics with `count` coefficients, truncated or padded with zeros."""
    return pad(sh[:, :count], (0, 0, 0, max(count - sh.shape[1], 0))).clone()


class PhotoSchedule:
    """Schedule of photographs: the worst ones first, the others in turn."""

    def __init__(self, excess: Sequence[float]) -> None:
        self.excess = list(excess)
        self._waiting = list(range(len(self.excess)))

    def take(self, count: int) -> list[int]:
        """Return the next `count` photographs."""
        over = [k for k in self._waiting if self.excess[k] > 0]
        worst = sorted(over, key=self.excess.__getitem__, reverse=True)[: count // 2]
        others = [k for k in self._waiting if k not in worst]
        chosen = [*worst, *others[: count - count // 2]]
        self._waiting = [*others[count - count // 2 :], *chosen]
        return chosen


@torch.no_grad()
def clamp_colors(sh: Float[Tensor, "n k 3"]) -> None:
    """Clamp base colours to [0, 1] and view dependence to `MAX_SH_COEFFICIENT`, in place.

    Gaussians seen from few directions would otherwise glitter from others.
    """
    sh[:, 0].clamp_(-0.5 / SH_C0, 0.5 / SH_C0)
    sh[:, 1:].clamp_(-MAX_SH_COEFFICIENT, MAX_SH_COEFFICIENT)


def compute_hole_error(
    image: Float[Tensor, "h w 3"], reference: View, holes: Bool[Tensor, "h w"]
) -> Float[Tensor, ""]:
    """Compute the mean squared difference to the synthesized image in holes."""
    return (compute_pixel_weights(holes) * (image - reference.image).square().sum(dim=-1)).sum()


def compute_pixel_weights(where: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Return the weight of each pixel and channel in a mean over the image."""
    return where.float() / (3 * where.numel())
