"""What photographs do not need: Gaussians by which they lose, or without which they lose nothing.

An image is linear in the opacity of one Gaussian, so its squared error is quadratic, and one render
predicts the error without each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import CleaningConfig
from gscompleter.render.protocols import FrozenScene, OpacityRender, Renderer
from gscompleter.stages.error_budgets import (
    add_psnr_loss,
    compute_mse_and_gradient,
    compute_squared_error,
    select_fewest,
)
from gscompleter.trust.photometric import sum_weights
from gscompleter.types import Gaussians, View

FADED_OPACITY = 0.02
"""Largest opacity of a faded Gaussian; at zero it would have no gradient."""
MIN_REFERENCE_ERROR = 1e-12
"""Smallest mean squared error that fractions refer to."""
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
    """Sum the error changes of Gaussians that are added to a scene, which is frozen at the views.

    A plan for each view renders the scene with them, at other opacities than their own ones [n].
    Those in `faded` are faint meanwhile.
    """
    generator = torch.Generator().manual_seed(0)
    gained = torch.zeros_like(opacities)
    lost = torch.zeros_like(opacities)
    equal_share = 0.0
    for view, scene, plan in zip(views, frozen, plans, strict=True):
        change = predict_error_change(plan, opacities, faded, view, config.probes, generator)
        gained += (-change).clamp_min(0)
        lost += change.clamp_min(0)
        num_shown = int((change != 0).sum()) + int((sum_weights(scene) > 0).sum())
        equal_share += 1 / max(num_shown, 1) / len(views)
    return ErrorChanges(gained, lost, equal_share)


def predict_error_change(
    plan: OpacityRender,
    full: Float[Tensor, "n"],
    faded: Bool[Tensor, "n"],
    view: View,
    probes: int,
    generator: torch.Generator,
) -> Float[Tensor, "n"]:
    """Predict the relative change of a photograph's squared error without each Gaussian.

    `plan` renders them with other opacities than their `full` ones; those in `faded` are faint.
    """
    current = torch.where(faded, full.clamp_max(FADED_OPACITY), full)
    error, gradient = compute_mse_and_gradient(plan, view, current)
    square = estimate_squared_gradient(plan, current, view.valid_mask, probes, generator)
    # A pixel is linear in the opacity of one Gaussian, so the error is a parabola in it:
    # E(o) = E + gradient (o - current) + square (o - current)², and this is E(0) - E(full).
    change = square * (current**2 - (full - current) ** 2) - gradient * full
    return change / max(error, MIN_REFERENCE_ERROR)


def estimate_squared_gradient(
    plan: OpacityRender,
    opacities: Float[Tensor, "n"],
    counted: Bool[Tensor, "h w"],
    probes: int,
    generator: torch.Generator,
) -> Float[Tensor, "n"]:
    """Estimate the mean squared gradient of the counted pixels' colours in each opacity.

    The mean is over the whole image. The estimate is unbiased: with random signs, products of
    different pixels cancel on average.
    """
    with torch.enable_grad():
        variable = opacities.detach().clone().requires_grad_()
        image = plan(variable).image
        squares = torch.zeros_like(opacities)
        for _ in range(probes):
            signs = torch.randint(0, 2, image.shape, generator=generator).to(image) * 2 - 1
            signs = signs * counted[..., None]
            (gradient,) = torch.autograd.grad((signs * image).sum(), variable, retain_graph=True)
            squares += gradient**2
    return squares / probes / image.numel()


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


def exclude_needed(
    scene: Gaussians,
    removable: Bool[Tensor, "n"],
    views: Sequence[View],
    max_errors: Sequence[float],
    renderer: Renderer,
) -> Bool[Tensor, "n"]:
    """Remove needed Gaussians from a mask until every photograph is within its MSE limit.

    The rest of the scene is frozen anew in each pass: for all photographs it would take too much
    memory. Additions to a scene that is frozen already have `exclude_needed_additions`.
    """
    candidates = scene[removable]
    rest = scene.hide(removable)

    def iterate_plans() -> Iterator[OpacityRender]:
        for view in views:
            yield renderer.freeze(rest, view.camera).vary_opacities(candidates)

    everything = torch.ones_like(candidates.opacities, dtype=torch.bool)
    missing = exclude_needed_additions(
        iterate_plans, candidates.opacities, everything, views, max_errors
    )
    return removable.masked_scatter(removable, missing)


def exclude_needed_additions(
    iterate_plans: Callable[[], Iterable[OpacityRender]],
    opacities: Float[Tensor, "n"],
    removable: Bool[Tensor, "n"],
    views: Sequence[View],
    max_errors: Sequence[float],
) -> Bool[Tensor, "n"]:
    """Remove needed ones of n additions from a mask until every photograph is within its MSE limit.

    One at a time they are superfluous; together they may not be. A plan for each photograph renders
    the scene with the additions, at other opacities than their own ones [n].
    """
    missing = removable
    # What returns for one photograph may change others, so all are checked until nothing changes.
    while True:
        missing_before = missing
        for plan, view, max_error in zip(iterate_plans(), views, max_errors, strict=True):
            missing = missing & ~find_needed_by_photographs(
                plan, opacities, missing, view, max_error
            )
        if torch.equal(missing, missing_before):
            return missing


def find_needed_by_photographs(
    plan: OpacityRender,
    opacities: Float[Tensor, "n"],
    missing: Bool[Tensor, "n"],
    view: View,
    max_error: float,
) -> Bool[Tensor, "n"]:
    """Find the missing Gaussians that a photograph needs back to be within its limit.

    Opacities [n] are those that the Gaussians have if they are not missing. After
    `MAX_RETURN_ROUNDS` rounds the photograph gets back all that it sees.
    """
    back = torch.zeros_like(missing)
    for _ in range(MAX_RETURN_ROUNDS):
        absent = missing & ~back
        image = view.fill_ignored(plan(torch.where(absent, 0.0, opacities)).image)
        error = compute_squared_error(image, view.image).item()
        if error <= max_error or not absent.any():
            return back

        # To first order, the error falls by -gradient * opacity if a Gaussian returns.
        faint = torch.where(absent, GRADIENT_OPACITY, 1.0) * opacities
        _, gradient = compute_mse_and_gradient(plan, view, faint)
        relief = torch.where(absent, -gradient * opacities, 0.0)
        back = back | select_fewest(relief, error - max_error)
    return back | (missing & (gradient != 0))
