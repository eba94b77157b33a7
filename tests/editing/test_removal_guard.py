"""The removal guard: only the hole that removed Gaussians leave is filled."""

from dataclasses import replace

import torch

from gscompleter.editing.removal_guard import Removal
from gscompleter.numerics.geometry import look_up
from gscompleter.stages.hole_masks import HoleEdits
from gscompleter.types import View
from scenes import camera_at, random_gaussians
from target_views import observe

CAMERA = camera_at(size=32)
CANDIDATES = random_gaussians(200)


def test_candidates_stay_in_pixels_that_showed_what_was_removed():
    photographs = [View(torch.zeros(32, 32, 3), CAMERA)]
    view = observe(CANDIDATES[:3], photographs, CAMERA)
    assert Removal().place(CANDIDATES, view) is CANDIDATES
    opened = torch.zeros(32, 32, dtype=torch.bool)
    opened[:, :16] = True
    opened_there = replace(view, masks=replace(view.masks, edits=HoleEdits(opened)))
    kept = Removal().place(CANDIDATES, opened_there)
    left = look_up(opened.long(), CANDIDATES, CAMERA) == 1
    assert 0 < len(kept) < len(CANDIDATES)
    assert torch.equal(kept.means, CANDIDATES[left].means)
