"""Removal of floaters and superfluous Gaussians from a trained splat.

An image is linear in the opacity of one Gaussian, so its squared error is quadratic, and one render
predicts the error without each. A Gaussian is removable if some photographs gain several times the
loss of others, or hardly any loses. A second pass with these faded protects walls behind floaters.
Finally they are removed together; those that a photograph needs at full or half size return.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from gscompleter.config import CleaningConfig
from gscompleter.render.protocols import OpacityRender, Renderer
from gscompleter.stages.error_budgets import (
    add_psnr_loss,
    compute_mse_and_gradient,
    compute_squared_error,
    select_fewest,
)
from gscompleter.system.progress import track
from gscompleter.types import Gaussians, View

FADED_OPACITY = 0.02
"""Largest opacity of a faded Gaussian; at zero it would have no gradient."""
MIN_REFERENCE_ERROR = 1e-12
"""Smallest mean squared error that fractions refer to."""
MAX_RETURN_ROUNDS = 16
"""Rounds of putting back what a photograph needs most, before it gets back all that it sees."""
GRADIENT_OPACITY = 0.1
"""Opacity factor at which gradients of missing Gaussians are evaluated; at 0 there are none."""


def find_superfluous(
    scene: Gaussians,
    views: Sequence[View],
    renderer: Renderer,
    config: CleaningConfig = CleaningConfig(),
) -> Bool[Tensor, "n"]:
    """Find Gaussians that can be removed together; generated and unobserved ones stay."""
    none = torch.zeros_like(scene.generated, dtype=torch.bool)
    removable = find_removable(scene, none, views, renderer, config) & (scene.generated == 0)
    # A wall behind floaters is hidden, and looks superfluous. With the floaters faded, photographs
    # need it.
    removable &= find_removable(scene, removable, views, renderer, config)

    # One at a time they are superfluous; together they may not be. Photographs are compared at half
    # size as well.
    checks = [*views, *(halve_view(view) for view in views)]
    max_errors = limit_errors(scene, checks, config.tolerance, renderer)
    return exclude_needed(scene, removable, checks, max_errors, renderer)


def limit_errors(
    scene: Gaussians, views: Sequence[View], tolerance: float, renderer: Renderer
) -> list[float]:
    """Compute the mean squared error of each photograph after a loss of PSNR, in dB."""
    limits = []
    for view in views:
        image = view.fill_ignored(renderer.render(scene, view.camera).image)
        error = compute_squared_error(image, view.image).item()
        limits.append(add_psnr_loss(error, tolerance))
    return limits


def find_removable(
    scene: Gaussians,
    faded: Bool[Tensor, "n"],
    views: Sequence[View],
    renderer: Renderer,
    config: CleaningConfig,
) -> Bool[Tensor, "n"]:
    """Find Gaussians that can be removed one at a time while the others in `faded` are faint."""
    generator = torch.Generator().manual_seed(0)
    # Relative changes of the photographs' errors without each Gaussian, summed by their sign.
    gained = torch.zeros_like(scene.opacities)
    lost = torch.zeros_like(scene.opacities)
    equal_share = 0.0
    for view in track(views, "Comparing photographs"):
        change = predict_error_change(scene, faded, view, renderer, config.probes, generator)
        gained += (-change).clamp_min(0)
        lost += change.clamp_min(0)
        # What a Gaussian would lose if all that a photograph shows were equally important.
        equal_share += 1 / max(int((change != 0).sum()), 1) / len(views)
    is_observed = gained + lost > 0
    return is_observed & (lost < gained / config.min_ratio + config.idle * equal_share)


def predict_error_change(
    scene: Gaussians,
    faded: Bool[Tensor, "n"],
    view: View,
    renderer: Renderer,
    probes: int,
    generator: torch.Generator,
) -> Float[Tensor, "n"]:
    """Predict the relative change of a photograph's squared error without each Gaussian."""
    plan = renderer.freeze(scene[:0], view.camera).vary_opacities(scene)
    full = scene.opacities
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


def halve_view(view: View) -> View:
    """Reduce a photograph to half its size; a pixel with an ignored part is ignored."""
    image = avg_pool2d(view.image.permute(2, 0, 1), 2).permute(1, 2, 0)
    # Pixel coordinates are halved as they are, since they count from the corner of the image.
    K = view.camera.K * view.camera.K.new_tensor([[0.5], [0.5], [1.0]])
    camera = replace(view.camera, K=K, height=image.shape[0], width=image.shape[1])
    ignored = None
    if view.ignore_mask is not None:
        ignored = max_pool2d(view.ignore_mask[None].float(), 2)[0] > 0
    return View(image, camera, view.frame, ignore_mask=ignored)


def exclude_needed(
    scene: Gaussians,
    removable: Bool[Tensor, "n"],
    views: Sequence[View],
    max_errors: Sequence[float],
    renderer: Renderer,
) -> Bool[Tensor, "n"]:
    """Remove needed Gaussians from a mask until every photograph is within its MSE limit.

    Restored Gaussians may change other photographs, so all are checked until nothing changes.
    """
    candidates = scene[removable]
    rest = scene[~removable]
    missing = torch.ones_like(candidates.opacities, dtype=torch.bool)
    while True:
        missing_before = missing
        for view, max_error in zip(views, max_errors, strict=True):
            plan = renderer.freeze(rest, view.camera).vary_opacities(candidates)
            missing = missing & ~find_needed_by_photographs(
                plan, candidates.opacities, missing, view, max_error
            )
        if torch.equal(missing, missing_before):
            return removable.masked_scatter(removable, missing)


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
