"""The agreement guards: an image or depths that contradict the scene add nothing."""

from dataclasses import replace

import pytest
import torch

from gscompleter.guards import Attempt
from gscompleter.guards.agreement import DepthAgreement, ImageAgreement
from gscompleter.stages.refine import Refined
from gscompleter.stages.synthesize import GeneratedView
from gscompleter.types import DepthAffine, View
from scenes import camera_at, random_gaussians
from target_views import observe

CAMERA = camera_at(size=8)
ADDED = random_gaussians(7)
IMAGE = GeneratedView(torch.zeros(8, 8, 3), CAMERA)
ATTEMPT = Attempt(
    observe(ADDED, [View(torch.zeros(8, 8, 3), CAMERA)], CAMERA),
    IMAGE,
    DepthAffine(agreement=0.6, coverage=0.5),
    Refined(ADDED, (), ()),
)


def test_an_image_that_shows_another_scene_adds_nothing():
    guard = ImageAgreement()
    assert guard.verify(ADDED, ATTEMPT) is ADDED
    wrong = replace(ATTEMPT, reference=replace(IMAGE, is_inconsistent=True))
    assert len(guard.verify(ADDED, wrong)) == 0


@pytest.mark.parametrize(
    ("agreement", "coverage", "kept"), [(0.14, 0.5, 0), (0.16, 0.5, 7), (0.0, 0.005, 7)]
)
def test_depths_with_which_less_than_15_percent_agree_add_nothing(agreement, coverage, kept):
    """Of hardly any pixels the share says nothing."""
    guard = DepthAgreement()
    attempt = replace(ATTEMPT, affine=DepthAffine(agreement=agreement, coverage=coverage))
    assert len(guard.verify(ADDED, attempt)) == kept
    if not kept:
        assert "Only 14% of the scene" in guard.explain_rejection(attempt)
