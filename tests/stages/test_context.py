"""Stage 1 reconstructs what photographs show, whatever range of depths was given."""

from dataclasses import dataclass, replace

import pytest
import torch

from gscompleter import Reconstruction, View, load_reconstructor
from gscompleter.stages.context import reconstruct_context
from gscompleter.types import DepthMap
from scenes import Room, camera_at, gaussians_of, view_of

NEAR_BOX = 2.3
"""z-depth before which only the front of the nearer box lies, at 2.2."""


def see_room(near: float | None, far: float | None) -> list[View]:
    cameras = [camera_at(x, size=128) for x in (-0.3, 0.1)]
    return [view_of(Room(), replace(camera, near=near, far=far)) for camera in cameras]


def test_what_stands_before_a_given_near_plane_gets_its_depth(caplog):
    caplog.set_level("WARNING", logger="gscompleter")
    """With the near plane believed, the front of the box stands at more than twice its depth."""
    context = reconstruct_context(load_reconstructor("plane-sweep"), see_room(2.9, 20.0))
    assert "nearer than the near plane at 2.9" in caplog.text
    assert caplog.text.count("widened") == 1
    assert all(view.camera.near < 2.0 for view in context.views)
    view = context.views[0]
    is_front = view.depth < NEAR_BOX
    assert is_front.sum() > 300
    # One Gaussian a pixel, in the order of the photographs
    z = (context.source.gaussians.means @ view.camera.c2w[:3, 2])[: view.depth.numel()]
    error = (z.view_as(view.depth) / view.depth - 1).abs()[is_front]
    assert error.median() < 0.02
    assert error.quantile(0.9) < 0.05


@dataclass(frozen=True)
class Recorder:
    """A Ψ that records the ranges of depths that it is given."""

    ranges: list[tuple[float | None, float | None]]
    depth_range: tuple[float, float] | None = (10.0, 1000.0)
    keeps_range: bool = False

    def __call__(self, views: list[View]) -> Reconstruction:
        self.ranges.extend((view.camera.near, view.camera.far) for view in views)
        return Reconstruction(gaussians_of(views[0]), tuple(list_depths(views)))


def list_depths(views: list[View]) -> list[DepthMap]:

    return [DepthMap(view.depth, torch.ones_like(view.depth) > 0) for view in views]


@pytest.mark.parametrize("near", [None, 10.0, 3.0])
def test_a_network_with_one_range_is_given_it_and_python_is_told(caplog, near):
    caplog.set_level("WARNING", logger="gscompleter")
    psi = Recorder([])
    reconstruct_context(psi, see_room(near, None if near is None else 1000.0))
    assert psi.ranges == [(near or 10.0, 1000.0)] * 2
    told = {
        None: "this model was trained on 10 to 1000: multiply the positions of the cameras",
        10.0: "",
        3.0: "nearer than the near plane at 3: this model gets the range as it was given",
    }[near]
    assert told in caplog.text
    assert bool(told) == bool(caplog.text)


@pytest.mark.parametrize("keeps", [False, True])
def test_a_reconstructor_may_ask_for_the_range_that_was_given(caplog, keeps):
    caplog.set_level("WARNING", logger="gscompleter")
    psi = Recorder([], depth_range=None, keeps_range=keeps)
    reconstruct_context(psi, see_room(2.9, 20.0))
    assert (psi.ranges[0][0] == 2.9) == keeps
    assert ("gets the range as it was given" if keeps else "was widened to") in caplog.text


def test_a_range_that_was_found_before_is_not_looked_for_again(caplog):
    caplog.set_level("WARNING", logger="gscompleter")
    psi = Recorder([], depth_range=None)
    reconstruct_context(psi, see_room(2.9, 20.0), has_scene_range=True)
    # It would be widened, as above.
    assert psi.ranges == [(2.9, 20.0)] * 2
    assert not caplog.text
