"""Guard of stage 4: additions make no photograph worse, by the error budgets in PSNR and SSIM."""

from __future__ import annotations

from dataclasses import replace

from gscompleter.guards import Attempt, Guard
from gscompleter.numerics.geometry import look_up
from gscompleter.numerics.image_ops import label_regions
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.fit_colors import RELAXATION, fit_colors
from gscompleter.stages.error_budgets import (
    find_exceeding,
    meet_error_budgets,
    set_total_budgets,
)
from gscompleter.stages.hole_masks import compute_hole_mask
from gscompleter.state import Completion
from gscompleter.types import Gaussians

WORSE_COLOR_ROUNDS = 4
"""Rounds in which colours are fitted to photographs that additions make worse."""


class PsnrGuard(Guard):
    """Let no photograph get worse than its error budgets."""

    name = "psnr"
    loss = "a filling would make given photographs worse"

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
        """Fade added Gaussians until every photograph is within its budgets.

        Each connected part of the hole is judged by itself: one wrong corner is no reason to drop
        what is added elsewhere.
        """
        view = attempt.view
        state = view.state
        budgets = view.budgets

        # What a photograph sees of the additions takes the colours of the photograph first, so that
        # less of it has to fade. At the target the image counts as much as each photograph.
        worsened = find_exceeding(budgets, view.frozen_photos, attempt.refined.plans, added)
        if not worsened:
            return added
        frozen = [view.frozen, *(view.frozen_photos[index] for index in worsened)]
        images = [attempt.reference, *(state.photos[index].view for index in worsened)]
        # Where a photograph is ignored, the render with the additions is wanted, so that they keep
        # their colours there. A render without them would ask for the black of the holes.
        wanted = [
            image
            if image.ignore_mask is None
            else image.paint_ignored(scene.composite(added).image)
            for image, scene in zip(images, frozen, strict=True)
        ]
        added = fit_colors(added, frozen, wanted, [RELAXATION] * WORSE_COLOR_ROUNDS)
        plans = [scene.vary_opacities(added) for scene in view.frozen_photos]

        labels, _ = label_regions(view.addition_mask)
        regions = look_up(labels, added, view.camera.padded)
        # Gaps beside a filled target are narrow, and looked for from five cameras: fine steps are
        # most of the time there, and gain nothing.
        return meet_error_budgets(
            added,
            view.frozen_photos,
            budgets,
            plans,
            state.config.psnr_guard,
            regions,
            is_quick=state.filled_target is not None,
        )

    def explain_rejection(self, attempt: Attempt) -> str:
        """Name the photographs as the reason."""
        return "Most of the Gaussians that were generated for the target make photographs worse."
