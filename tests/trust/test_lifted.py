"""Scenes that were lifted from pixels are told from trained ones."""

from dataclasses import replace

import torch

from gscompleter.trust.lifted import find_pixel_center, is_lifted
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
