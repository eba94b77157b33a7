"""Stage 4: what is added makes no photograph worse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import HarmConfig
from gscompleter.masks import dilate
from gscompleter.render import FrozenView, OpacityImage, image_of
from gscompleter.stages.integration import falling_on
from gscompleter.threads import torch_on_one_thread
from gscompleter.types import Gaussians, View

HALVINGS = 16
"""How often harmful Gaussians lose half of their opacity, before a view that still does not hold
loses those at its worst pixels."""
REMOVALS = 12
"""How often it does, before it loses all that it sees of them."""
REACH = 2
"""Pixels around the worst ones within which Gaussians are lost."""


@torch_on_one_thread()
def do_no_harm(
    added: Gaussians,
    frozen_views: Sequence[FrozenView],
    views: Sequence[View],
    allowed_errors: Sequence[float],
    config: HarmConfig = HarmConfig(),
    drawings: Sequence[OpacityImage] | None = None,
) -> Gaussians:
    """`added` with opacities lowered until no photograph is matched worse than allowed; nothing of
    it where that takes so much that the photographs contradict all of it.

    In a view that got worse, a Gaussian is harmful where less opacity would bring the view nearer
    to its photograph. The most harmful ones are halved, no more of them than it takes. Where that
    does not help, as of two that hide each other, those at the pixels that got worse most are
    removed; and in the end every generated Gaussian that the view sees, which restores it. Once all
    that got worse hold, every view is asked anew.

    Args:
        added: Generated Gaussians.
        frozen_views: The scene frozen at the camera of each of `views`.
        views: The photographs.
        allowed_errors: Largest mean squared error allowed in each view.
        config: How it is checked.
        drawings: What draws each of the views with other opacities of `added`, where that is known
            already.
    """
    if config.tolerance is None or len(added) == 0:
        return added
    if drawings is None:
        drawings = [image_of(frozen.plan(added)) for frozen in frozen_views]
    before = [frozen.context.image for frozen in frozen_views]
    checks = [Check(*each) for each in zip(views, before, drawings, allowed_errors, strict=True)]
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

    view: View
    before: Float[Tensor, "h w 3"]
    """What it sees of the scene without what is added."""
    draw: OpacityImage
    """What it sees with it."""
    allowed: float
    """Largest mean squared error."""


@dataclass(frozen=True)
class Drawn:
    """A photograph that is checked, and what is seen there."""

    check: Check
    opacities: Float[Tensor, "n"]
    """Those that are drawn, which `image` has slopes in."""
    image: Float[Tensor, "h w 3"]

    @staticmethod
    def of(check: Check, opacities: Float[Tensor, "n"]) -> Drawn:
        """What `check` sees with these opacities."""
        return Drawn(check, *drawn_with(check.draw, opacities))

    @cached_property
    def excess(self) -> float:
        """How far the mean squared error of the image lies over what is allowed."""
        view = self.check.view
        seen = view.compared(self.image.detach())
        return squared_error(seen, view.image).item() - self.check.allowed

    def to_lower(self, trial: int, added: Gaussians) -> Bool[Tensor, "n"]:
        """Which of `added` are to give way."""
        if HALVINGS <= trial < HALVINGS + REMOVALS:
            return self.at_worst(added)
        slope = slope_of(self.image, self.check.view, self.opacities)
        if trial < HALVINGS:
            return fewest(slope * self.opacities.detach() / 2, self.excess)
        return slope != 0

    def at_worst(self, added: Gaussians) -> Bool[Tensor, "n"]:
        """Those of `added` at the fewest pixels of the image that make up for its excess."""
        view = self.check.view
        compared = map(view.compared, (self.image.detach(), self.check.before))
        errors, before = (squared_errors(image, view.image) for image in compared)
        relief = (errors - before) / errors.numel()
        pixels = fewest(relief.flatten(), self.excess).view(relief.shape)
        return falling_on(dilate(pixels, REACH), added, view.camera)


def those_over(checks: Sequence[Check], opacities: Float[Tensor, "n"]) -> list[Drawn]:
    """What the photographs see that are matched worse than allowed with these opacities."""
    drawn = (Drawn.of(check, opacities) for check in checks)
    return [seen for seen in drawn if seen.excess > 0]


def is_undone(
    added: Float[Tensor, "n"], left: Float[Tensor, "n"], config: HarmConfig = HarmConfig()
) -> bool:
    """Whether of the opacities of what was `added` so little is `left` that the photographs
    contradict all of it."""
    if config.max_loss is None or len(added) == 0:
        return False
    return 1 - (left.sum() / added.sum().clamp_min(1e-12)).item() > config.max_loss


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
    slope = slope_of(image, view, variable)
    return squared_error(view.compared(image.detach()), view.image).item(), slope


def drawn_with(
    draw: OpacityImage, opacities: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "h w 3"]]:
    """The opacities as what varies, and the image that is drawn with them, which has slopes in
    them."""
    with torch.enable_grad():
        variable = opacities.detach().clone().requires_grad_()
        return variable, draw(variable)


def slope_of(
    image: Float[Tensor, "h w 3"], view: View, variable: Float[Tensor, "n"]
) -> Float[Tensor, "n"]:
    """How the error of `image` against the photograph grows with each of what it was drawn with."""
    with torch.enable_grad():
        error = (view.compared(image) - view.image).square().mean()
    return torch.autograd.grad(error, variable)[0]


def squared_error(image: Float[Tensor, "h w 3"], photograph: Float[Tensor, "h w 3"]) -> Tensor:
    """Mean squared error of the image as it is shown, clipped to [0, 1]."""
    return (image.clamp(0, 1) - photograph).square().mean()


def squared_errors(
    image: Float[Tensor, "h w 3"], photograph: Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w"]:
    """The same of each pixel."""
    return (image.clamp(0, 1) - photograph).square().mean(dim=-1)


def error_with_loss(error: float, decibel: float) -> float:
    """The mean squared error whose PSNR is `decibel` lower than that of `error`."""
    return error * 10 ** (decibel / 10)
