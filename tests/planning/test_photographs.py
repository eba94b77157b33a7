"""Targets at photographs that show something that was removed."""

import pytest
import torch

from gscompleter import GSCompleter
from gscompleter.config import CompleterConfig
from gscompleter.editing.removal import remove_gaussians
from gscompleter.planning.photographs import PhotographPlanner
from gscompleter.planning.planner import ViewPlanner
from gscompleter.planning.remove import contain_nothing
from gscompleter.state import Completion
from gscompleter.types import merge
from scenes import Room, camera_at, gaussians_of, view_of

ROOM = Room()
CAMERAS = [camera_at(x, yaw=yaw, size=48) for x, yaw in ((-0.4, 4), (0.0, 0), (0.4, 70))]
"""The last one looks past the box in the middle of the room."""
COMPLETER = GSCompleter(config=CompleterConfig.splat().for_removal())
PLANNER = PhotographPlanner(COMPLETER)


@pytest.fixture(scope="module")
def removed() -> Completion:
    """Remove the box in the middle of the room from a splat of three photographs."""
    views = [view_of(ROOM, camera) for camera in CAMERAS]
    low, high = (torch.tensor(corner) for corner in ROOM.boxes[1])
    begun = COMPLETER.begin(views, merge([gaussians_of(view) for view in views]), [])
    points = begun.context.means
    chosen = ((points > low - 0.05) & (points < high + 0.05)).all(-1) & (points[:, 1] < 1.45)
    return remove_gaussians(begun, chosen, contain_nothing, COMPLETER.scenes)


def test_candidates_are_the_cameras_of_photographs_where_they_show_the_removed(removed):
    candidates, spacing = PLANNER.find_candidates(removed, CAMERAS)
    assert [candidate.base for candidate in candidates] == [0, 1, 2]
    for candidate, camera in zip(candidates, CAMERAS, strict=True):
        assert torch.equal(candidate.camera.c2w, camera.c2w)
    shares = [candidate.region.float().mean().item() for candidate in candidates]
    assert min(shares[:2]) > 0.05
    assert max(shares[:2]) < 0.5
    assert shares[2] == 0
    assert spacing == pytest.approx(0.4)


def test_a_hole_that_fills_an_image_gains_less(removed):
    candidates, _ = PLANNER.find_candidates(removed, CAMERAS)
    plain = ViewPlanner(COMPLETER).score_candidates(removed, candidates)
    scored = PLANNER.score_candidates(removed, candidates)
    for choice, before in zip(scored, plain, strict=True):
        rest = 1 - choice.hole_fraction
        assert choice.gain == pytest.approx(before.gain * rest**2)
    assert scored[1].gain > 0
    assert scored[2].gain == 0
