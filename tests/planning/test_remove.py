"""Removal in Python, with the completion of its place."""

from __future__ import annotations

import pytest
import torch

import gscompleter as gsc
from gscompleter.config import CompleterConfig
from gscompleter.numerics.geometry import look_up
from gscompleter.numerics.image_ops import dilate
from gscompleter.render.removed import mask_removed
from gscompleter.types import Gaussians, merge
from scenes import Room, camera_at, gaussians_of, view_of

ROOM = Room()
VIEWS = [view_of(ROOM, camera_at(x, yaw=10 * -x, size=48)) for x in (-0.4, 0.0, 0.4)]


def is_crate(points: torch.Tensor) -> torch.Tensor:
    """Find points on the box in the middle of the room."""
    low, high = (torch.tensor(corner) for corner in ROOM.boxes[1])
    return ((points > low - 0.05) & (points < high + 0.05)).all(-1) & (points[:, 1] < 1.45)


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return merge([gaussians_of(view) for view in VIEWS])


# Settings that are given are adapted as those by default.
@pytest.mark.parametrize("config", [None, CompleterConfig()])
def test_nothing_but_the_place_is_completed(scene, config):
    """From beside the photographs the room has holes that nothing was removed from."""
    target = camera_at(1.0, yaw=-14, size=48)
    completer = gsc.GSCompleter(config=config)
    completion = gsc.remove(scene, is_crate(scene.means), VIEWS, [target], completer)
    shown = mask_removed(completion.source, target, completer.renderer)
    place = dilate(shown, completion.config.holes.dilation)
    added = completion.added
    assert len(added) > 100
    assert look_up(place, added, target).float().mean() > 0.9
