"""Stage 4 in a scene that somebody trained: what is added agrees with every photograph.

Such a scene matches the photographs it was trained on almost exactly, with whatever stands where.
Anything new that they see would make them worse, however right it is at the target. So colours and
opacities of what is added are fitted together: to the synthesized image in the holes, as in the
paper's Eq. 13, on the condition that no photograph gets worse. The scene stays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from gscompleter.config import ReconcileConfig
from gscompleter.descent import Adam
from gscompleter.progress import track
from gscompleter.render import AppearanceRender, FrozenView, LooksError
from gscompleter.threads import torch_on_one_thread
from gscompleter.types import SH_C0, ErrorBudget, Gaussians, View

Looks = tuple[Float[Tensor, "n"], Float[Tensor, "n k 3"]]
"""Opacities and spherical harmonics."""

FAINT = 0.2
"""Share of its opacity with which something new begins. It grows where it is welcome, which harms
less on the way than fading does where it is not."""
GOAL = 0.99
"""Share of its allowed error that a photograph is brought to, so that it holds once all is done."""
MAX_BAND = 0.2
"""Largest coefficient of spherical harmonics beyond the constant."""


@torch_on_one_thread()
def reconcile(
    added: Gaussians,
    frozen_target: FrozenView,
    reference: View,
    holes: Bool[Tensor, "h w"],
    plans: Sequence[AppearanceRender],
    budgets: Sequence[ErrorBudget],
    config: ReconcileConfig = ReconcileConfig(),
) -> tuple[Gaussians, tuple[float, ...]]:
    """`added` with opacities and view-dependent colours that the photographs agree with.

    Args:
        added: Generated Gaussians.
        frozen_target: The scene frozen at the target.
        reference: The synthesized image there.
        holes: Where the scene is to look like it.
        plans: What draws each photograph with other looks of `added`.
        budgets: Limit of the mean squared error of each photograph.
        config: How long, and how freely.

    Returns:
        The Gaussians, and the loss of each iteration. The photographs are nearly as well matched as
        allowed, or better; what is left is for `do_no_harm`.
    """
    if config.iterations == 0 or len(added) == 0:
        return added, ()
    fit = Fit(added, config)
    planned = frozen_target.plan_appearance(added, holes)
    at_target = planned.compared(reference.image, shares_of(holes))
    before = hole_error(frozen_target.context.image, reference, holes).clamp_min(1e-12)
    asked = [Asked.by(*each) for each in zip(plans, budgets, strict=True)]
    with torch.no_grad():
        looks = fit.looks()
        turns = Turns([photograph.excess(looks).item() for photograph in asked])
    weight = config.photograph_weight / config.views_per_step
    losses = []
    for _ in track(range(config.iterations), "Reconciling"):
        looks = fit.looks()
        loss = at_target(*looks) / before
        for over in objections(looks, asked, turns, config.views_per_step):
            loss = loss + weight * over
        fit.step(loss)
        losses.append(loss.item())
    return fit.fitted(), tuple(losses)


def objections(
    looks: Looks, asked: Sequence[Asked], turns: Turns, count: int
) -> list[Float[Tensor, ""]]:
    """The excess of those of the `count` photographs whose turn it is that have any; `turns` learns
    it."""
    chosen = turns.take(count)
    found = [asked[k].excess(looks) for k in chosen]
    for k, over in zip(chosen, found, strict=True):
        turns.excess[k] = over.item()
    return [over for over in found if over > 0]


@dataclass(frozen=True)
class Asked:
    """A photograph that is asked whether it agrees."""

    error: LooksError
    """The mean squared error of what its camera sees."""
    allowed: float
    """The largest that is allowed."""

    @staticmethod
    def by(plan: AppearanceRender, budget: ErrorBudget) -> Asked:
        """The photograph of a budget, whose camera sees what `plan` draws."""
        view = budget.view
        return Asked(plan.compared(view.image, shares_of(view.counted)), max(budget.limit, 1e-12))

    def excess(self, looks: Looks) -> Float[Tensor, ""]:
        """By how much the error is above its goal, relative to what is allowed."""
        return (self.error(*looks) / self.allowed - GOAL).clamp_min(0.0)


class Fit:
    """Opacities and colours of what is added, as far as they are fitted."""

    def __init__(self, added: Gaussians, config: ReconcileConfig) -> None:
        self._added = added
        self._sh = widened(added.sh, (config.sh_degree + 1) ** 2).requires_grad_()
        self._logits = (FAINT * added.opacities).logit(eps=1e-4).requires_grad_()
        rates = [(self._logits, config.opacity_step), (self._sh, config.color_step)]
        self._optimizer = Adam(rates, (config.beta1, config.beta2))

    def looks(self) -> Looks:
        """As they are by now; differentiable."""
        return self._logits.sigmoid(), self._sh

    def step(self, loss: Float[Tensor, ""]) -> None:
        """One step down the slope of `loss`; colours stay colours."""
        self._optimizer.step(loss)
        keep_colours(self._sh)

    def fitted(self) -> Gaussians:
        """What is added, as it was fitted."""
        opacities, sh = self._logits.detach().sigmoid(), self._sh.detach()
        return replace(self._added, opacities=opacities, sh=sh, encoded=None)


def widened(sh: Float[Tensor, "n k 3"], count: int) -> Float[Tensor, "n l 3"]:
    """A copy of spherical harmonics with `count` coefficients: the first of them, and zeros."""
    return pad(sh[:, :count], (0, 0, 0, max(count - sh.shape[1], 0))).clone()


class Turns:
    """Which photographs are asked next: those that are matched worst, and the others in turn."""

    def __init__(self, excess: Sequence[float]) -> None:
        self.excess = list(excess)
        """By how much each was above its goal when it was asked last, relative to it."""
        self._waiting = list(range(len(self.excess)))

    def take(self, count: int) -> list[int]:
        """The next `count` of them."""
        over = [k for k in self._waiting if self.excess[k] > 0]
        worst = sorted(over, key=self.excess.__getitem__, reverse=True)[: count // 2]
        others = [k for k in self._waiting if k not in worst]
        chosen = [*worst, *others[: count - count // 2]]
        self._waiting = [*others[count - count // 2 :], *chosen]
        return chosen


@torch.no_grad()
def keep_colours(sh: Float[Tensor, "n k 3"]) -> None:
    """Bring colours back into [0, 1], and what they change by with the direction to less than that.

    What is seen from few sides would else glitter from the others.
    """
    sh[:, 0].clamp_(-0.5 / SH_C0, 0.5 / SH_C0)
    sh[:, 1:].clamp_(-MAX_BAND, MAX_BAND)


def hole_error(
    image: Float[Tensor, "h w 3"], reference: View, holes: Bool[Tensor, "h w"]
) -> Float[Tensor, ""]:
    """Mean squared difference from the synthesized image within the holes."""
    return (shares_of(holes) * (image - reference.image).square().sum(dim=-1)).sum()


def shares_of(where: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """What each pixel and channel counts in a mean over all of an image of what is `where`."""
    return where.float() / (3 * where.numel())
