"""What photographs do not need: Gaussians by which they lose, or without which they lose nothing.

An image is linear in the opacity of one Gaussian, so its squared error is quadratic, and one render
predicts the error without each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import CleaningConfig
from gscompleter.render.protocols import (
    Backpropagation,
    FrozenScene,
    JointOpacityRender,
    OpacityRender,
    Renderer,
)
from gscompleter.stages.error_budgets import (
    add_psnr_loss,
    compute_mse_and_derivative,
    compute_squared_error,
    render_with_gradient,
    select_fewest,
)
from gscompleter.trust.photometric import sum_weights
from gscompleter.types import Gaussians, View

FADED_OPACITY = 0.02
"""Largest opacity of a faded Gaussian; at zero it would have no gradient."""
MIN_REFERENCE_ERROR = 1e-12
"""Smallest mean squared error that its changes are divided by."""
MAX_RETURN_ROUNDS = 16
"""Rounds of putting back what a photograph needs most, before it gets back all that it sees."""
GRADIENT_OPACITY = 0.1
"""Opacity factor at which gradients of missing Gaussians are evaluated; at 0 there are none."""


@dataclass(frozen=True)
class ErrorChanges:
    """Relative changes of the photographs' squared errors without each of n Gaussians."""

    gained: Float[Tensor, "n"]
    """By how much errors fall, summed over the photographs in which they do."""
    lost: Float[Tensor, "n"]
    """By how much errors rise, likewise."""
    equal_share: float
    """What a Gaussian would lose if all that a photograph shows were equally important."""
    errors: Sequence[float]
    """Mean squared error of each photograph with all of them."""

    @property
    def are_observed(self) -> Bool[Tensor, "n"]:
        """True for Gaussians that any photograph shows."""
        return self.gained + self.lost > 0

    def find_removable(self, config: CleaningConfig) -> Bool[Tensor, "n"]:
        """Find Gaussians that can be removed one at a time."""
        return self.lost < self.gained / config.min_ratio + config.idle * self.equal_share

    def find_harmful(self, config: CleaningConfig) -> Bool[Tensor, "n"]:
        """Find Gaussians without which photographs are better."""
        return self.gained > config.idle * self.equal_share


def sum_error_changes(
    opacities: Float[Tensor, "n"],
    faded: Bool[Tensor, "n"],
    views: Sequence[View],
    frozen: Sequence[FrozenScene],
    plans: Iterable[OpacityRender],
    config: CleaningConfig,
) -> ErrorChanges:
    """Sum what photographs gain and lose without each of n Gaussians that are added to a scene.

    `frozen` is the scene without them at each view, and a plan renders it with them, at whatever
    opacities [n]. `opacities` are their own, but those in `faded` are faint in the comparison.
    """
    generator = torch.Generator().manual_seed(0)
    gained = torch.zeros_like(opacities)
    lost = torch.zeros_like(opacities)
    equal_share = 0.0
    errors = []
    for view, scene, plan in zip(views, frozen, plans, strict=True):
        change, error = predict_error_change(plan, opacities, faded, view, config.probes, generator)
        errors.append(error)
        gained += (-change).clamp_min(0)
        lost += change.clamp_min(0)
        num_shown = int((change != 0).sum()) + int((sum_weights(scene) > 0).sum())
        equal_share += 1 / max(num_shown, 1) / len(views)
    return ErrorChanges(gained, lost, equal_share, errors)


def predict_error_change(
    plan: OpacityRender,
    full: Float[Tensor, "n"],
    faded: Bool[Tensor, "n"],
    view: View,
    probes: int,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "n"], float]:
    """Predict the relative change of a photograph's squared error without each Gaussian.

    `plan` renders them at whatever opacities: here their `full` ones, but those in `faded` are
    faint. Also returns the mean squared error with all of them.
    """
    current = torch.where(faded, full.clamp_max(FADED_OPACITY), full)
    image, backpropagate = begin_gradients(plan, current)
    error, d_image = compute_mse_and_derivative(view, image)
    # Unbiased: with random signs, products of different pixels cancel on average.
    signs = [
        torch.randint(0, 2, image.shape, generator=generator).to(image) * 2 - 1
        for _ in range(probes)
    ]
    probed = [sign * view.valid_mask[..., None] for sign in signs]
    gradient, *probed_gradients = backpropagate(torch.stack([d_image, *probed]))
    # Mean squared gradient of the pixels' colours in each opacity, over the whole image.
    square = torch.zeros_like(full)
    for probed_gradient in probed_gradients:
        square += probed_gradient**2
    square = square / probes / image.numel()
    # A pixel is linear in the opacity of one Gaussian, so the error is a parabola in it:
    # E(o) = E + gradient (o - current) + square (o - current)², and this is E(0) - E(full).
    change = square * (current**2 - (full - current) ** 2) - gradient * full
    return change / max(error, MIN_REFERENCE_ERROR), error


def begin_gradients(
    plan: OpacityRender, opacities: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "h w 3"], Backpropagation]:
    """Render an image once, for several gradients in the opacities; at once where possible."""
    if isinstance(plan, JointOpacityRender):
        render, backpropagate = plan.begin(opacities)
        return render.image, backpropagate
    variable, image = render_with_gradient(plan, opacities)

    def backpropagate_one_by_one(
        images: Float[Tensor, "images h w 3"],
    ) -> list[Float[Tensor, "n"]]:
        return [
            torch.autograd.grad(image, variable, d_image, retain_graph=True)[0]
            for d_image in images
        ]

    return image.detach(), backpropagate_one_by_one


def limit_errors(
    images: Iterable[Float[Tensor, "_ _ 3"]], views: Sequence[View], tolerance: float
) -> list[float]:
    """Compute the mean squared error of each photograph after a loss of PSNR, in dB.

    `images` are the renders at their cameras now.
    """
    limits = []
    for image, view in zip(images, views, strict=True):
        error = compute_squared_error(view.fill_ignored(image), view.image).item()
        limits.append(add_psnr_loss(error, tolerance))
    return limits


@dataclass(frozen=True)
class PhotographCheck:
    """A photograph that may lose no more than some error by what is taken out of a scene."""

    view: View
    max_error: float
    """Largest mean squared error of the photograph."""
    draw_without: Callable[[Bool[Tensor, "n"]], Float[Tensor, "h w 3"]]
    """Draws the scene without some of its n Gaussians."""
    make_plan: Callable[[], OpacityRender]
    """Makes the render of the scene in which those that may go have other opacities [n]."""


def exclude_needed(
    scene: Gaussians,
    removable: Bool[Tensor, "n"],
    views: Sequence[View],
    max_errors: Sequence[float],
    renderer: Renderer,
) -> Bool[Tensor, "n"]:
    """Remove needed Gaussians from a mask until every photograph is within its MSE limit.

    A plan is made anew each time that a photograph needs it: for all photographs they would take
    too much memory. Nothing is copied but opacities.
    """
    rest = scene.hide(removable)
    candidates = scene.hide(~removable)

    def check(view: View, max_error: float) -> PhotographCheck:
        camera = view.camera
        return PhotographCheck(
            view,
            max_error,
            lambda missing: renderer.render(scene.hide(missing), camera).image,
            lambda: renderer.freeze(rest, camera).vary_opacities(candidates, is_fading=True),
        )

    checks = [check(view, limit) for view, limit in zip(views, max_errors, strict=True)]
    return exclude_needed_by_photographs(checks, scene.opacities, removable)


def exclude_needed_additions(
    plans: Sequence[OpacityRender],
    opacities: Float[Tensor, "n"],
    removable: Bool[Tensor, "n"],
    views: Sequence[View],
    max_errors: Sequence[float],
) -> Bool[Tensor, "n"]:
    """Remove needed ones of n additions to a scene from a mask, as `exclude_needed`.

    A plan for each photograph renders the scene with them, at whatever opacities [n]; `opacities`
    are those of additions that stay.
    """

    def check(plan: OpacityRender, view: View, max_error: float) -> PhotographCheck:
        return PhotographCheck(
            view,
            max_error,
            lambda missing: plan(torch.where(missing, 0.0, opacities)).image,
            lambda: plan,
        )

    checks = [check(*parts) for parts in zip(plans, views, max_errors, strict=True)]
    return exclude_needed_by_photographs(checks, opacities, removable)


def exclude_needed_by_photographs(
    checks: Sequence[PhotographCheck],
    opacities: Float[Tensor, "n"],
    removable: Bool[Tensor, "n"],
) -> Bool[Tensor, "n"]:
    """Remove needed Gaussians from a mask until every photograph is within its MSE limit.

    One at a time they are superfluous; together they may not be.
    """
    missing = removable
    # What returns for one photograph may change others, so all are checked until each one was
    # within its limit after the last return.
    returns = 0
    returns_at_check = [-1] * len(checks)
    while any(number < returns for number in returns_at_check):
        for index, check in enumerate(checks):
            if returns_at_check[index] == returns:
                continue
            needed = find_needed_by_photograph(check, opacities, missing)
            # A GPU is asked only about photographs that were above their limits.
            if needed is None or not needed.any():
                returns_at_check[index] = returns
            else:
                missing = missing & ~needed
                returns += 1
    return missing


def find_needed_by_photograph(
    check: PhotographCheck, opacities: Float[Tensor, "n"], missing: Bool[Tensor, "n"]
) -> Bool[Tensor, "n"] | None:
    """Find the missing Gaussians that a photograph needs back; None if it is within its limit.

    Opacities [n] are those that the Gaussians have if they are not missing. After
    `MAX_RETURN_ROUNDS` rounds the photograph gets back all that it sees.
    """
    view = check.view
    back = torch.zeros_like(missing)
    image = check.draw_without(missing)
    plan = None
    for _ in range(MAX_RETURN_ROUNDS):
        absent = missing & ~back
        if plan is not None:
            image = plan(torch.where(absent, 0.0, opacities)).image
        error = compute_squared_error(view.fill_ignored(image), view.image).item()
        if error <= check.max_error or not absent.any():
            return None if plan is None else back

        # Most photographs are within their limits after the first pass, and need no plan.
        if plan is None:
            plan = check.make_plan()
        # To first order, the error falls by -gradient * opacity if a Gaussian returns.
        faint = torch.where(absent, GRADIENT_OPACITY, 1.0) * opacities
        image, backpropagate = begin_gradients(plan, faint)
        (gradient,) = backpropagate(compute_mse_and_derivative(view, image)[1][None])
        relief = torch.where(absent, -gradient * opacities, 0.0)
        back = back | select_fewest(relief, error - check.max_error)
    return back | (missing & (gradient != 0))
