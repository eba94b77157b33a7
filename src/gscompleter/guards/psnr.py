"""Guard of stage 4: additions make no photograph, and no completed target, worse.

Error budgets limit what each image may lose, in PSNR and SSIM.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from gscompleter.config import PsnrGuardConfig
from gscompleter.guards import Attempt, Guard
from gscompleter.numerics.geometry import look_up
from gscompleter.numerics.image_ops import label_regions
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.fit_colors import RELAXATION, fit_colors
from gscompleter.stages.error_budgets import (
    find_exceeding,
    meet_error_budgets,
    set_error_budgets,
    set_total_budgets,
)
from gscompleter.stages.hole_masks import compute_hole_mask
from gscompleter.state import Completion
from gscompleter.types import ErrorBudget, Gaussians, View

WORSE_COLOR_ROUNDS = 4
"""Rounds in which colours are fitted to photographs that additions make worse."""


class PsnrGuard(Guard):
    """Let no photograph and no completed target get worse than its error budgets."""

    name = "psnr"
    loss = "a filling would make photographs, or targets before, worse"

    def begin(self, state: Completion, scenes: SceneRenderer) -> Completion:
        """Set the error budgets of all photographs for all targets, before any of them.

        Budgets that were set earlier hold as well.
        """
        config = state.config
        frozen = scenes.freeze_at(state.parts, [photo.view.camera for photo in state.photos])
        budgets = [
            set_total_budgets(
                photo.view,
                scene.render.image,
                compute_hole_mask(scene.render.alpha, config.holes),
                config.psnr_guard,
            )
            for photo, scene in zip(state.photos, frozen, strict=True)
        ]
        photos = tuple(
            replace(photo, budgets=(*photo.budgets, *limits))
            for photo, limits in zip(state.photos, budgets, strict=True)
        )
        return replace(state, photos=photos)

    def verify(self, added: Gaussians, attempt: Attempt) -> Gaussians:
        """Fade added Gaussians until every photograph and target is within its budgets.

        Each connected part of the hole is judged by itself: one wrong corner is no reason to drop
        what is added elsewhere.
        """
        view = attempt.view
        state = view.state

        # The images of completed targets are evidence as photographs are: what is added for this
        # one may hang before them, where no photograph sees it.
        completed = view.completed_views
        views = [*(photo.view for photo in state.photos), *(image for image, _ in completed)]
        scenes = [*view.frozen_photos, *(frozen for _, frozen in completed)]
        settings = state.config.psnr_guard
        budgets = [*view.budgets, *(keep_image(image, settings) for image, _ in completed)]
        plans = [*attempt.refined.plans, *(frozen.vary_opacities(added) for _, frozen in completed)]

        # What a photograph sees of the additions takes the colours of the photograph first, so that
        # less of it has to fade. At the target the image counts as much as each photograph.
        worsened = find_exceeding(budgets, scenes, plans, added)
        if not worsened:
            return added
        frozen = [view.frozen, *(scenes[index] for index in worsened)]
        images = [attempt.reference, *(views[index] for index in worsened)]
        # Where a photograph is ignored, the render with the additions is wanted, so that they keep
        # their colours there. A render without them would ask for the black of the holes.
        wanted = [
            image
            if image.ignore_mask is None
            else image.paint_ignored(scene.composite(added).image)
            for image, scene in zip(images, frozen, strict=True)
        ]
        added = fit_colors(added, frozen, wanted, [RELAXATION] * WORSE_COLOR_ROUNDS)
        plans = [scene.vary_opacities(added) for scene in scenes]

        labels, _ = label_regions(view.addition_mask)
        regions = look_up(labels, added, view.camera.padded)
        return meet_error_budgets(added, scenes, budgets, plans, settings, regions)

    def explain_rejection(self, attempt: Attempt) -> str:
        """Name the images as the reason."""
        return (
            "Most of the Gaussians that were generated for the target make photographs, or targets "
            "before it, worse."
        )


def keep_image(view: View, config: PsnrGuardConfig) -> tuple[ErrorBudget, ...]:
    """Set the error budgets of an image that the scene shows without an error."""
    nothing = torch.zeros_like(view.valid_mask)
    return set_error_budgets(view, view.image, nothing, config)
