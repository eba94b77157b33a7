"""Stage 4 in a scene that somebody trained: what is added agrees with every photograph.

Such a scene matches the photographs it was trained on almost exactly, with whatever stands where.
Anything new that they see would make them worse, however right it is at the target. So colours and
opacities of what is added are fitted together: to the synthesized image in the holes, as in the
paper's Eq. 13, on the condition that no photograph gets worse. The scene stays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from gscompleter.config import ReconcileConfig
from gscompleter.progress import track
from gscompleter.render import FrozenView
from gscompleter.types import SH_C0, Gaussians, Render, View

FAINT = 0.2
"""Share of its opacity with which something new begins. It grows where it is welcome, which harms
less on the way than fading does where it is not."""
GOAL = 0.99
"""Share of its allowed error that a photograph is brought to, so that it holds once all is done."""
MAX_BAND = 0.2
"""Largest coefficient of spherical harmonics beyond the constant."""


def reconcile(
    added: Gaussians,
    frozen_target: FrozenView,
    reference: View,
    holes: Bool[Tensor, "h w"],
    frozen_views: Sequence[FrozenView],
    views: Sequence[View],
    allowed_errors: Sequence[float],
    config: ReconcileConfig = ReconcileConfig(),
) -> tuple[Gaussians, tuple[float, ...]]:
    """`added` with opacities and view-dependent colours that the photographs agree with.

    Args:
        added: Generated Gaussians.
        frozen_target: The scene frozen at the target.
        reference: The synthesized image there.
        holes: Where the scene is to look like it.
        frozen_views: The scene frozen at the camera of each of `views`.
        views: The photographs.
        allowed_errors: Largest mean squared error allowed in each of them.
        config: How long, and how freely.

    Returns:
        The Gaussians, and the loss of each iteration. The photographs are nearly as well matched as
        allowed, or better; what is left is for `do_no_harm`.
    """
    if config.iterations == 0 or len(added) == 0:
        return added, ()
    k = (config.sh_degree + 1) ** 2
    sh = pad(added.sh[:, :k], (0, 0, 0, max(k - added.sh.shape[1], 0))).clone().requires_grad_()
    logits = (FAINT * added.opacities).logit(eps=1e-4).requires_grad_()
    steps = [(logits, config.opacity_step), (sh, config.colour_step)]
    optimizer = torch.optim.Adam([{"params": [part], "lr": step} for part, step in steps])
    before = hole_error(frozen_target.context, reference, holes).clamp_min(1e-12)

    def drawn(frozen: FrozenView) -> Render:
        return frozen.composite(replace(added, opacities=logits.sigmoid(), sh=sh, encoded=None))

    def excess(k: int) -> Tensor:
        error = (drawn(frozen_views[k]).image - views[k].image).square().mean()
        return (error / max(allowed_errors[k], 1e-12) - GOAL).clamp_min(0.0)

    with torch.no_grad():
        turns = Turns([excess(k).item() for k in range(len(views))])
    losses = []
    for _ in track(range(config.iterations), "Reconciling"):
        loss = hole_error(drawn(frozen_target), reference, holes) / before
        for k in turns.take(config.views_per_step):
            over = excess(k)
            turns.excess[k] = over.item()
            loss = loss + config.photograph_weight / config.views_per_step * over
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        keep_colours(sh)
        losses.append(loss.item())
    fitted = replace(added, opacities=logits.sigmoid().detach(), sh=sh.detach(), encoded=None)
    return fitted, tuple(losses)


class Turns:
    """Which photographs are asked next: those that are matched worst, and the others in turn."""

    def __init__(self, excess: Sequence[float]) -> None:
        self.excess = list(excess)
        """By how much each was above its goal when it was asked last, relative to it."""
        self._waiting = list(range(len(self.excess)))

    def take(self, count: int) -> list[int]:
        """The next `count` of them."""
        worst = sorted(self._waiting, key=self.excess.__getitem__, reverse=True)[: count // 2]
        others = [k for k in self._waiting if k not in worst]
        chosen = [*worst, *others[: count - len(worst)]]
        self._waiting = [*others[count - len(worst) :], *chosen]
        return chosen


@torch.no_grad()
def keep_colours(sh: Float[Tensor, "n k 3"]) -> None:
    """Bring colours back into [0, 1], and what they change by with the direction to less than that.

    What is seen from few sides would else glitter from the others.
    """
    sh[:, 0].clamp_(-0.5 / SH_C0, 0.5 / SH_C0)
    sh[:, 1:].clamp_(-MAX_BAND, MAX_BAND)


def hole_error(drawn: Render, reference: View, holes: Bool[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Mean squared difference from the synthesized image within the holes."""
    return ((drawn.image - reference.image).square().mean(dim=-1) * holes).mean()
