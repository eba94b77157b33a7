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
from gscompleter.guards.psnr import (
    add_psnr_loss,
    compute_mse_and_gradient,
    compute_squared_error,
    select_fewest,
)
from gscompleter.render.protocols import OpacityRender, Renderer
from gscompleter.system.progress import track
from gscompleter.types import Gaussians, View

FADED_OPACITY = 0.02
"""Largest opacity of a faded Gaussian; at zero it would have no gradient."""
MIN_ERROR = 1e-12
"""Smallest mean squared error that fractions refer to."""
MAX_TRIALS = 16
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
    removable = torch.zeros_like(scene.generated, dtype=torch.bool)
    removable = find_removable(scene, removable, views, renderer, config) & (scene.generated == 0)
    removable = find_removable(scene, removable, views, renderer, config) & removable
    checks = [*views, *map(halve_view, views)]
    allowed = limit_errors(scene, checks, config.tolerance, renderer)
    return exclude_needed(scene, removable, checks, allowed, renderer)


def limit_errors(
    scene: Gaussians, views: Sequence[View], tolerance: float, renderer: Renderer
) -> list[float]:
    """Compute the mean squared error of each photograph after a loss of PSNR, in dB."""
    allowed = []
    for view in views:
        image = view.fill_ignored(renderer.render(scene, view.camera).image)
        error = compute_squared_error(image, view.image).item()
        allowed.append(add_psnr_loss(error, tolerance))
    return allowed


def find_removable(
    scene: Gaussians,
    faded: Bool[Tensor, "n"],
    views: Sequence[View],
    renderer: Renderer,
    config: CleaningConfig,
) -> Bool[Tensor, "n"]:
    """Find Gaussians that can be removed one at a time while the others in `faded` are faint."""
    generator = torch.Generator().manual_seed(0)
    gained, lost = torch.zeros_like(scene.opacities), torch.zeros_like(scene.opacities)
    equal_share = 0.0
    for view in track(views, "Comparing photographs"):
        change = predict_error_change(scene, faded, view, renderer, config.probes, generator)
        gained += (-change).clamp_min(0)
        lost += change.clamp_min(0)
        equal_share += 1 / max(int((change != 0).sum()), 1) / len(views)
    shown = gained + lost > 0
    return shown & (lost < gained / config.min_ratio + config.idle * equal_share)


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
    left = torch.where(faded, full.clamp_max(FADED_OPACITY), full)
    error, gradient = compute_mse_and_gradient(plan, view, left)
    square = estimate_squared_gradient(plan, left, view.valid_mask, probes, generator)
    # Difference of the parabola between zero and full opacity, expanded at `left`.
    return (square * (left**2 - (full - left) ** 2) - gradient * full) / max(error, MIN_ERROR)


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
    candidates, rest = scene[removable], scene[~removable]
    missing, before = torch.ones_like(candidates.opacities, dtype=torch.bool), None
    while before is None or not torch.equal(missing, before):
        before = missing
        for view, error in zip(views, max_errors, strict=True):
            plan = renderer.freeze(rest, view.camera).vary_opacities(candidates)
            missing = missing & ~find_needed(plan, candidates.opacities, missing, view, error)
    return removable.masked_scatter(removable, missing)


def find_needed(
    plan: OpacityRender,
    opacities: Float[Tensor, "n"],
    missing: Bool[Tensor, "n"],
    view: View,
    max_error: float,
) -> Bool[Tensor, "n"]:
    """Find the missing Gaussians that a photograph needs back to be within its limit."""
    back = torch.zeros_like(missing)
    for _ in range(MAX_TRIALS):
        absent = missing & ~back
        image = view.fill_ignored(plan(torch.where(absent, 0.0, opacities)).image)
        error = compute_squared_error(image, view.image).item()
        if error <= max_error or not absent.any():
            return back
        _, gradient = compute_mse_and_gradient(
            plan, view, torch.where(absent, GRADIENT_OPACITY, 1.0) * opacities
        )
        back = back | select_fewest(
            torch.where(absent, -gradient * opacities, 0.0), error - max_error
        )
    return back | (missing & (gradient != 0))
