"""Impossible cameras and views are refused where they are made."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter import GSCompleter, InputError
from scenes import Room, camera_at, gaussians_of, view_of


def changed(index: tuple[int, int], value: float) -> torch.Tensor:
    pose = torch.eye(4)
    pose[index] = value
    return pose


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"c2w": changed((0, 3), math.nan)}, "its pose holds NaN or infinity"),
        ({"c2w": changed((1, 1), math.inf)}, "its pose holds NaN or infinity"),
        ({"c2w": changed((0, 0), -1)}, "its pose is left-handed"),
        ({"c2w": changed((0, 0), 1.1)}, "scaled, sheared or projective"),
        ({"c2w": changed((0, 1), 0.1)}, "scaled, sheared or projective"),
        ({"c2w": changed((3, 0), 1)}, "scaled, sheared or projective"),
        ({"c2w": torch.eye(3)}, "no tensor of 4 × 4 floats"),
        ({"c2w": np.eye(4)}, "no tensor of 4 × 4 floats"),
        ({"K": torch.zeros(3, 3)}, "its focal lengths are 0 and 0"),
        ({"K": torch.full((3, 3), math.nan)}, "its focal lengths are nan"),
        ({"K": torch.eye(4)}, "no tensor of 3 × 3 floats"),
        ({"width": 0}, "0 × 32 pixels"),
        ({"near": 2.0, "far": 2.0}, "near plane at 2 is not before its far plane at 2"),
        ({"near": 0.0}, "near plane is at 0"),
        ({"far": math.inf}, "far plane is at inf"),
    ],
)
def test_an_impossible_camera_is_refused_at_once(change, sentence):
    with pytest.raises(InputError, match=sentence):
        unchecked(replace, camera_at(size=32), **change)


def test_a_rotation_may_be_rounded_and_planes_may_be_unknown():
    camera = camera_at(yaw=12, size=32)
    pose = camera.c2w.clone()
    pose[:, :3] += 1e-4
    assert replace(camera, c2w=pose, near=None).far == 20


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"image": torch.zeros(32, 31, 3)}, r"shape \[32, 31, 3\], and its camera has 32 × 32"),
        ({"image": torch.zeros(32, 32)}, r"no tensor of floats of shape \[h, w, 3\]"),
        ({"image": torch.zeros(32, 32, 3, dtype=torch.uint8)}, "no tensor of floats"),
        ({"image": np.zeros((32, 32, 3))}, "no tensor of floats"),
        ({"depth": torch.zeros(16, 32)}, "The depth of a view has the shape"),
        (
            {"ignore_mask": torch.zeros(1, 1, dtype=torch.bool)},
            "The ignore mask of a view has the shape",
        ),
    ],
)
def test_an_image_that_is_not_its_cameras_is_refused_at_once(change, sentence):
    view = view_of(Room(), camera_at(size=32))
    with pytest.raises(InputError, match=sentence):
        unchecked(replace, view, **change)


def test_values_that_no_stage_can_work_with_are_refused_before_any_work():
    cameras = [camera_at(x, size=32) for x in (-0.3, 0.1, 0.5)]
    first, second = (view_of(Room(), camera) for camera in cameras[:2])
    scene = gaussians_of(first)
    for image in (first.image * 255, first.image * math.nan):
        with pytest.raises(InputError, match=r"view 1 has values from .* colours in \[0, 1\]"):
            GSCompleter()([second, replace(first, image=image)], cameras[2])
    broken = replace(scene, means=scene.means * math.nan)
    with pytest.raises(InputError, match="The scene holds NaN or infinity"):
        GSCompleter()([first, second], cameras[2], scene=broken)


def unchecked(make, *arguments, **changes):
    """Call `make` without the type checks of these tests."""
    from jaxtyping import config

    before = config.jaxtyping_disable
    config.update("jaxtyping_disable", True)
    try:
        return make(*arguments, **changes)
    finally:
        config.update("jaxtyping_disable", before)
