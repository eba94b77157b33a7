"""Agreement guards (not in the paper): reject images and depths that contradict the scene."""

from __future__ import annotations

from gscompleter.guards import Attempt, Guard
from gscompleter.types import Gaussians

MIN_TARGET_COVERAGE = 0.01
"""Fraction of its image that the target must see of the scene for its depths to be judged."""


class ImageAgreement(Guard):
    """Reject a synthesized image that contradicts the photographs."""

    name = "image-agreement"
    loss = "the generated image contradicts the photographs"

    def verify(self, added: Gaussians, attempt: Attempt) -> Gaussians:
        """Drop everything if Φ found its image inconsistent with the photographs."""
        return added[:0] if attempt.reference.is_inconsistent else added


class DepthAgreement(Guard):
    """Reject lifted depths with which hardly any of the visible scene agrees."""

    name = "depth-agreement"
    loss = "its depths contradict the scene"

    def verify(self, added: Gaussians, attempt: Attempt) -> Gaussians:
        """Drop everything if too few depths at the target agree with the affine correction."""
        affine = attempt.affine
        min_agreement = attempt.view.state.config.depth_agreement.reject_below
        # Over hardly any pixels, the share that agrees says nothing.
        is_checked = affine.coverage >= MIN_TARGET_COVERAGE
        if is_checked and (affine.agreement or 0.0) < min_agreement:
            return added[:0]
        return added

    def explain_rejection(self, attempt: Attempt) -> str:
        """Name the share that agrees."""
        agreement = attempt.affine.agreement or 0.0
        return (
            f"Only {agreement:.0%} of the scene that the target sees agrees with the depths of the "
            "synthesized image, and no other fit is better."
        )
