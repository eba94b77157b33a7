"""The camera of a pixel-aligned splat, found from the sizes of its Gaussians."""

from dataclasses import replace

import pytest
import torch

from gscompleter.trust.lifted import find_pixel_center, measure_core
from gscompleter.types import merge
from gscompleter.virtual_capture.pixel_aligned import (
    INNER,
    MAX_DIRECTIONS,
    aim_pixel_camera,
    find_inner_limit,
    move_beside,
)
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 48
UP = torch.tensor([0.0, -1.0, 0.0])


@pytest.mark.parametrize("places", [(0.0,), (-0.2, 0.2)])
@pytest.mark.parametrize("unit", [1.0, 100.0])
def test_the_camera_is_where_sizes_are_proportional_to_distances(places, unit):
    cameras = [camera_at(x, yaw=10, size=SIZE) for x in places]
    scene = merge([gaussians_of(view_of(Room(), camera)) for camera in cameras])
    scene = replace(scene, means=unit * scene.means, scales=unit * scene.scales)
    center = find_pixel_center(scene)
    assert center is not None
    found = aim_pixel_camera(scene, center, UP, SIZE)
    middle = unit * torch.stack([camera.center for camera in cameras]).mean(dim=0)
    assert (found.center - middle).norm() < 0.15 * measure_core(scene.means).radius
    # It looks where they do, and its horizon is level.
    assert found.forward @ cameras[0].forward > 0.98
    assert found.c2w[1, 0].abs() < 1e-4
    assert 0.6 < found.K[0, 0] / cameras[0].K[0, 0] < 1.5


def test_a_splat_of_more_gaussians_than_a_quantile_takes_has_a_field_of_view():
    assert find_inner_limit(torch.linspace(0, 1, MAX_DIRECTIONS + 9)) == pytest.approx(INNER, 1e-4)


def test_small_moves_keep_the_view():
    camera = camera_at(0.3, yaw=20, size=SIZE)
    first, *others = move_beside(camera, 4.0)
    assert first is camera
    for other in others:
        assert torch.equal(other.c2w[:3, :3], camera.c2w[:3, :3])
        assert 0.1 < (other.center - camera.center).norm() < 0.6
