"""Guard `completed-targets`: additions show as no spots in the images of completed targets."""

from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch

from gscompleter.config import CompleterConfig
from gscompleter.guards import Attempt
from gscompleter.guards.completed_targets import VISIBLE_CHANGE, CompletedTargets
from gscompleter.numerics.geometry import pad_camera
from gscompleter.parts import PartOrigin, make_part
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.loading import load_renderer
from gscompleter.stages.additions import Refined
from gscompleter.stages.synthesize import GeneratedView
from gscompleter.stages.target_view import MAX_COMPLETED, render_target
from gscompleter.target_result import TargetResult
from gscompleter.types import Camera, DepthAffine, Gaussians
from scenes import Room, camera_at, half_a_room_of
from target_views import begin_with

CAMERA = camera_at(size=48)
VIEW, CONTEXT, RIGHT = half_a_room_of(Room(), CAMERA)
FILLED = (make_part(PartOrigin("target", 1), RIGHT),)


def verify(
    added: Gaussians,
    completed: tuple[Camera, ...] = (CAMERA,),
    filled=FILLED,
    being_filled: Camera | None = None,
) -> Gaussians:
    """Verify an addition for a second target, after a first one was completed at `CAMERA`."""
    scenes = SceneRenderer(load_renderer("cpu"))
    targets = tuple(Mock(spec=TargetResult, target=camera, added=RIGHT) for camera in completed)
    begun = begin_with(CONTEXT, [VIEW], CompleterConfig())
    state = replace(begun, added_parts=filled, targets=targets, filled_target=being_filled)
    view = render_target(state, pad_camera(camera_at(0.05, size=48), 0.0), scenes)
    reference = GeneratedView(view.render.image, view.camera.target)
    attempt = Attempt(view, reference, DepthAffine(), Refined(added, (), ()))
    return CompletedTargets().verify(added, attempt)


def measure_change(added: Gaussians) -> torch.Tensor:
    """Measure by how much an addition changes each pixel of the completed target."""
    frozen = load_renderer("cpu").freeze(CONTEXT, CAMERA).extend(RIGHT)
    return (frozen.composite(added).image - frozen.render.image).abs().amax(dim=-1)


def test_what_hangs_before_a_completed_target_in_other_colours_goes():
    hanging = replace(RIGHT[::7], sh=-RIGHT.sh[::7], means=0.9 * RIGHT.means[::7])
    assert (measure_change(hanging) > VISIBLE_CHANGE).sum() > 50
    kept = verify(hanging)
    assert (measure_change(kept) > VISIBLE_CHANGE).sum() < 5


def test_what_closes_gaps_may_not_hang_before_its_own_target():
    hanging = replace(RIGHT[::7], sh=-RIGHT.sh[::7], means=0.9 * RIGHT.means[::7])
    assert len(verify(hanging, ())) == len(hanging)
    kept = verify(hanging, (), being_filled=CAMERA)
    assert (measure_change(kept) > VISIBLE_CHANGE).sum() < 5


def test_a_surface_may_grow_denser():
    """It changes all pixels a little, as what closes the cracks of a road from nearer by."""
    denser = replace(RIGHT, sh=RIGHT.sh + 0.03)
    assert 0.003 < measure_change(denser).mean() < VISIBLE_CHANGE
    assert len(verify(denser)) > 0.85 * len(denser)


@pytest.mark.parametrize("completed", [(), (camera_at(yaw=180.0, size=48),)])
def test_no_completed_target_that_sees_it_objects_to_nothing(completed):
    hanging = replace(RIGHT, sh=-RIGHT.sh, means=0.9 * RIGHT.means)
    assert len(verify(hanging, completed)) == len(hanging)


def test_the_holes_of_a_completed_target_may_be_filled():
    filling = replace(RIGHT, sh=-RIGHT.sh)
    kept = verify(filling, filled=())
    # At the border of its hole it shows a part of the left half.
    assert len(kept) > 0.95 * len(filling)


def test_the_nearest_completed_targets_are_asked():
    far = tuple(camera_at(yaw=180.0, x=0.1 * k, size=48) for k in range(1, MAX_COMPLETED + 1))
    hanging = replace(RIGHT, sh=-RIGHT.sh, means=0.9 * RIGHT.means)
    assert len(verify(hanging, (*far, CAMERA))) < 0.1 * len(hanging)
    near = tuple(camera_at(yaw=180.0, x=0.05, size=48) for _ in far)
    assert len(verify(hanging, (CAMERA, *near))) == len(hanging)
