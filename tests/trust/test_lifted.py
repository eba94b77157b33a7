"""Scenes that were lifted from pixels are told from trained ones."""

from dataclasses import replace

import pytest
import torch

from gscompleter import InputError
from gscompleter.trust.lifted import find_pixel_center, is_lifted, measure_core
from scenes import Room, camera_at, gaussians_of, random_gaussians, view_of

SIZE = 48


def test_a_scene_of_a_gaussian_for_each_pixel_is_lifted():
    assert is_lifted(gaussians_of(view_of(Room(), camera_at(size=SIZE))))


def test_other_splats_have_no_centre():
    assert find_pixel_center(random_gaussians(2000)) is None
    scene = gaussians_of(view_of(Room(), camera_at(size=SIZE)))
    alike = replace(scene, scales=torch.full_like(scene.scales, 0.02))
    assert find_pixel_center(alike) is None
    assert not is_lifted(alike)
    assert find_pixel_center(scene[:3]) is None


def test_far_from_the_origin_a_scene_is_lifted_as_well():
    far = torch.tensor([8000.0, 8000.0, 0.0])
    scene = gaussians_of(view_of(Room(), camera_at(size=SIZE)))
    moved = replace(scene, means=scene.means + far)
    near = find_pixel_center(scene)
    found = find_pixel_center(moved)
    assert near is not None
    assert found is not None
    assert (found - far - near).norm() < 0.1 * measure_core(scene.means).radius


def test_a_splat_without_gaussians_has_no_core():
    with pytest.raises(InputError, match="A splat without Gaussians has no size"):
        measure_core(torch.empty(0, 3))
