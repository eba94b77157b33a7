"""Removal of floaters and superfluous Gaussians from a trained splat.

A Gaussian is removable if some photographs gain several times the loss of others, or hardly any
loses (`stages/superfluous.py`). A second pass with these faded protects walls behind floaters.
Finally they are removed together; those that a photograph needs at full or half size return.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from gscompleter.config import CleaningConfig
from gscompleter.render.protocols import Renderer
from gscompleter.stages.error_budgets import add_psnr_loss
from gscompleter.stages.superfluous import (
    ErrorChanges,
    exclude_needed,
    limit_errors,
    sum_error_changes,
)
from gscompleter.system.progress import track
from gscompleter.types import Gaussians, View


def find_superfluous(
    scene: Gaussians,
    views: Sequence[View],
    renderer: Renderer,
    config: CleaningConfig = CleaningConfig(),
) -> dict[str, Bool[Tensor, "n"]]:
    """Find Gaussians that can be removed together, by reason; generated and unobserved ones stay.

    Each has one reason: photographs are better without `harmful` ones, and as good without those
    that are `not needed`.
    """
    none = torch.zeros_like(scene.generated, dtype=torch.bool)
    changes = rate_by_photographs(scene, none, views, renderer, config)
    removable = changes.are_observed & changes.find_removable(config) & (scene.generated == 0)
    is_harmful = changes.find_harmful(config)
    # A wall behind floaters is hidden, and looks superfluous. With the floaters faded, photographs
    # need it.
    removable &= find_removable(scene, removable, views, renderer, config)

    # One at a time they are superfluous; together they may not be. Photographs are compared at half
    # size as well.
    halves = [halve_view(view) for view in views]
    images = (renderer.render(scene, view.camera).image for view in halves)
    limits = [add_psnr_loss(error, config.tolerance) for error in changes.errors]
    limits += limit_errors(images, halves, config.tolerance)
    removed = exclude_needed(scene, removable, [*views, *halves], limits, renderer)
    return {"harmful": removed & is_harmful, "not needed": removed & ~is_harmful}


def find_removable(
    scene: Gaussians,
    faded: Bool[Tensor, "n"],
    views: Sequence[View],
    renderer: Renderer,
    config: CleaningConfig,
) -> Bool[Tensor, "n"]:
    """Find Gaussians that can be removed one at a time while the others in `faded` are faint."""
    changes = rate_by_photographs(scene, faded, views, renderer, config)
    return changes.are_observed & changes.find_removable(config)


def rate_by_photographs(
    scene: Gaussians,
    faded: Bool[Tensor, "n"],
    views: Sequence[View],
    renderer: Renderer,
    config: CleaningConfig,
) -> ErrorChanges:
    """Rate each Gaussian of a scene by how photographs change without it."""
    nothing = [renderer.freeze(scene[:0], view.camera) for view in views]
    # One after the other, since the plan of a large scene takes memory.
    plans = (
        empty.vary_opacities(scene, is_fading=True)
        for empty in track(nothing, "Comparing photographs")
    )
    return sum_error_changes(scene.opacities, faded, views, nothing, plans, config)


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
