"""Impossible cameras and views are refused where they are made."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter import GSCompleter, InputError, merge
from gscompleter.types import ContextScene
from scenes import Room, camera_at, gaussians_of, random_gaussians, view_of


def changed(index: tuple[int, int], value: float) -> torch.Tensor:
    pose = torch.eye(4)
    pose[index] = value
    return pose


def lens(row: int, column: int, value: float) -> torch.Tensor:
    K = camera_at(size=32).K.clone()
    K[row, column] = value
    return K


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"c2w": changed((0, 3), math.nan)}, "its pose holds NaN or infinity"),
        ({"c2w": changed((1, 1), math.inf)}, "its pose holds NaN or infinity"),
        ({"c2w": changed((0, 0), -1)}, "its pose is left-handed"),
        ({"c2w": changed((0, 0), 1.1)}, "scaled, sheared or projective"),
        ({"c2w": changed((0, 1), 0.1)}, "scaled, sheared or projective"),
        ({"c2w": changed((3, 0), 1)}, "scaled, sheared or projective"),
        ({"c2w": torch.eye(3)}, r"has to be a tensor of float32 and shape \[4, 4\]"),
        ({"c2w": np.eye(4)}, "is of type ndarray"),
        ({"c2w": torch.eye(4).half()}, "is a tensor of float16"),
        ({"c2w": torch.eye(4).double()}, "numbers of a camera have to be of one type"),
        ({"c2w": torch.eye(4).to_sparse()}, "is a sparse tensor"),
        ({"c2w": torch.eye(4, device="meta")}, "without values"),
        ({"c2w": torch.nn.Parameter(torch.eye(4, device="meta"))}, "without values"),
        ({"c2w": torch.eye(4).requires_grad_()}, "its pose requires a gradient"),
        ({"c2w": changed((0, 3), 1e10)}, "from the origin"),
        ({"K": torch.zeros(3, 3)}, "its focal lengths are 0 and 0"),
        ({"K": torch.full((3, 3), math.nan)}, "its focal lengths are nan"),
        ({"K": torch.eye(4)}, r"has to be a tensor of float32 and shape \[3, 3\]"),
        ({"K": lens(2, 2, 0.0)}, "a skew or another last row"),
        ({"K": lens(2, 2, 1e-3)}, "a skew or another last row"),
        ({"K": lens(2, 0, math.nan)}, "a skew or another last row"),
        ({"K": lens(1, 0, math.inf)}, "a skew or another last row"),
        ({"K": lens(1, 0, math.nan)}, "a skew or another last row"),
        ({"K": lens(0, 1, 3.0)}, "a skew or another last row"),
        ({"K": lens(0, 0, 1e-30)}, "fit no lens"),
        ({"K": lens(0, 2, 1e6)}, "far outside of its image"),
        ({"K": lens(0, 0, 40.0).requires_grad_()}, "its K requires a gradient"),
        ({"width": 0}, "width is 0 pixels"),
        ({"width": 10**6}, "width is 1000000 pixels"),
        ({"width": 64.5}, "width is 64.5, and a whole number"),
        ({"width": "64"}, "width is '64', and a whole number"),
        ({"height": None}, "height is None"),
        ({"height": True}, "height is True"),
        ({"padding": 4}, "its padding is 4, and two numbers of pixels from 0 are needed"),
        ({"padding": (4, -1)}, "its padding is .*, and two numbers of pixels from 0 are needed"),
        ({"padding": (4, 0.5)}, "its padding is .*, and two numbers of pixels from 0 are needed"),
        ({"padding": (4, 16)}, "its padding of 4 and 16 pixels on each side leaves nothing"),
        ({"near": "1"}, "near plane is '1', and a number"),
        ({"near": 2.0, "far": 2.0}, "near plane at 2 is not before its far plane at 2"),
        ({"near": 0.0}, "near plane is at 0"),
        ({"far": math.inf}, "far plane is at inf"),
    ],
)
def test_an_impossible_camera_is_refused_at_once(change, sentence):
    with pytest.raises(InputError, match=sentence):
        unchecked(replace, camera_at(size=32), **change)


def test_numbers_of_numpy_become_those_of_python():
    """JSON cannot hold NumPy's."""
    changes = {"width": np.int64(32), "near": np.float32(0.5), "padding": (np.int64(4), 2)}
    camera = unchecked(replace, camera_at(size=32), **changes)
    assert type(camera.width) is int
    assert type(camera.near) is float
    view = unchecked(replace, view_of(Room(), camera), frame=np.int64(3))
    place = (np.float32(0.5), 1.0, 2.0)
    scene = unchecked(replace, random_gaussians(4), origin=place)
    assert json.loads(json.dumps([camera.padding, view.frame, scene.origin])) == [
        [4, 2],
        3,
        [0.5, 1.0, 2.0],
    ]


def test_a_rotation_may_be_rounded_and_planes_may_be_unknown():
    camera = camera_at(yaw=12, size=32)
    pose = camera.c2w.clone()
    pose[:, :3] += 1e-4
    assert replace(camera, c2w=pose, near=None).far == 20


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"image": torch.zeros(32, 31, 3)}, r"shape \[32, 31, 3\], and its camera has 32 × 32"),
        ({"image": torch.zeros(32, 32)}, r"has to be a tensor of float32 and shape \[h, w, 3\]"),
        ({"image": torch.zeros(32, 32, 3, dtype=torch.uint8)}, "is a tensor of uint8"),
        ({"image": np.zeros((32, 32, 3))}, "is of type ndarray"),
        ({"image": torch.zeros(32, 32, 3).requires_grad_()}, "requires a gradient"),
        ({"image": torch.zeros(32, 32, 3).double()}, "numbers of a view have to be of one type"),
        ({"ignore_mask": torch.zeros(32, 32)}, "The ignore_mask of a view has to be"),
        ({"dynamic_mask": torch.zeros(32, 32, 1).bool()}, "The dynamic_mask of a view has to be"),
        ({"depth": None, "given_depth": torch.ones(32, 32, 1)}, "The given_depth of a view has"),
        ({"camera": None}, "The camera of a view has to be a Camera, and is None"),
        ({"frame": "a"}, "The frame of a view is 'a'"),
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
    for name, value in SPOILED:
        part = getattr(scene, name).clone()
        part[0] = value
        broken = replace(scene, **{name: part})
        for views in ([first, second], [first]):
            with pytest.raises(InputError, match=f"The scene has 1 of {len(scene):,} Gaussians"):
                GSCompleter()(views, cameras[2], scene=broken, check_views=[second])


SPOILED = [
    ("means", math.nan),
    ("quats", 0.0),
    ("quats", 1e38),
    ("scales", -1.0),
    ("scales", math.inf),
    ("opacities", 2.0),
    ("opacities", -1e-3),
    ("opacities", math.nan),
    ("sh", math.nan),
    ("sh", -math.inf),
    ("sh", 1e38),
]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"means": np.zeros((4, 3), np.float32)}, "means of Gaussians .* is of type ndarray"),
        ({"means": None}, "means of Gaussians .* is None"),
        ({"means": torch.zeros(4, 3).double()}, "numbers of Gaussians have to be of one type"),
        ({"means": torch.zeros(3, 4)}, r"shape \[n, 3\]"),
        ({"quats": torch.zeros(4, 3)}, r"shape \[n, 4\]"),
        ({"scales": torch.ones(4, 3, dtype=torch.int64)}, "is a tensor of int64"),
        ({"opacities": torch.ones(4, 1)}, r"shape \[n\]"),
        ({"opacities": torch.ones(3)}, "as many rows, and .* opacities has 3"),
        ({"sh": torch.zeros(4, 3)}, r"shape \[n, k, 3\]"),
        ({"sh": torch.zeros(4, 2, 3)}, "2 spherical harmonics per channel"),
        ({"sh": torch.zeros(4, 25, 3)}, "25 spherical harmonics per channel"),
        ({"sh": torch.zeros(4, 0, 3)}, "0 spherical harmonics per channel"),
        ({"generated": torch.zeros(4)}, "generated of Gaussians .* tensor of uint8"),
        ({"encoded": torch.zeros(4, 3)}, r"encoded of Gaussians .* shape \[n, 4\]"),
        ({"is_antialiased": "yes"}, "is_antialiased"),
    ],
)
def test_gaussians_of_other_types_and_shapes_are_refused_at_once(change, sentence):
    with pytest.raises(InputError, match=sentence):
        unchecked(replace, random_gaussians(4), **change)


@pytest.mark.parametrize(
    ("index", "sentence"),
    [
        (torch.ones(3).bool(), "A mask of 3 entries cannot select from 4 Gaussians"),
        (torch.ones(5).bool(), "A mask of 5 entries"),
        (torch.ones(4, 3).bool(), r"by a boolean mask of shape \[n\], .* tensor of bool and shape"),
        (torch.ones(4), "a tensor of float32"),
        (np.ones(4, bool), "not by a value of type ndarray"),
        ([0, 1], "of type list"),
        (0, "not by a value 0"),
    ],
)
def test_what_selects_no_gaussians_is_refused(index, sentence):
    with pytest.raises(InputError, match=sentence):
        unchecked(random_gaussians(4).__getitem__, index)


def test_gaussians_are_selected_by_masks_indices_and_slices():
    scene = random_gaussians(4)
    last = scene.means[2:]
    assert torch.equal(scene[torch.arange(4) > 1].means, last)
    assert torch.equal(scene[torch.tensor([2, 3])].means, last)
    assert torch.equal(scene[2:].means, last)


def test_constructors_read_no_number_of_large_tensors():
    """They run in every step of an optimisation, and a GPU would be waited for."""
    scene = random_gaussians(4)
    assert len(replace(scene, means=scene.means * math.nan)) == 4
    assert (
        replace(scene, opacities=scene.opacities.requires_grad_()).detach().opacities.grad is None
    )


def test_a_scene_that_requires_gradients_is_completed_without_them():
    views = [view_of(Room(), camera_at(x, size=32)) for x in (-0.3, 0.1)]
    scene = gaussians_of(views[0])
    learned = replace(scene, opacities=scene.opacities.clone().requires_grad_())
    done = GSCompleter()(views, camera_at(0.5, size=32), scene=learned)
    assert not done.scene.opacities.requires_grad


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"views": None}, "The context views have to be a list"),
        ({"views": [None]}, "list of View, and number 0 is None"),
        ({"target": None}, "The target has to be a Camera"),
        ({"target": []}, "No target camera"),
        ({"target": [3]}, "Target 0 has to be a Camera"),
        ({"target": camera_at(size=4)}, "at least 8 × 8 are needed"),
        ({"target": camera_at(size=16_000)}, "need about .* of memory"),
        ({"scene": "scene.ply"}, "The scene has to be Gaussians"),
        ({"check_views": 3}, "The check views have to be a list"),
    ],
)
def test_arguments_of_other_types_are_refused_before_any_work(arguments, sentence):
    views = [view_of(Room(), camera_at(x, size=32)) for x in (-0.3, 0.1)]
    usual = {"views": views, "target": camera_at(0.5, size=32)}
    with pytest.raises(InputError, match=sentence):
        unchecked(GSCompleter(), **(usual | arguments))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"ignore_mask": torch.ones(32, 32).bool()}, "The masks leave no pixel"),
        ({"depth": torch.full((32, 32), math.nan)}, "The depth of context view 0 holds NaN"),
        ({"depth": None, "given_depth": -torch.ones(32, 32)}, "The given depth of context view 0"),
    ],
)
def test_views_that_leave_nothing_to_work_on_are_refused(change, sentence):
    views = [replace(view_of(Room(), camera_at(x, size=32)), **change) for x in (-0.3, 0.1)]
    with pytest.raises(InputError, match=sentence):
        GSCompleter()(views, camera_at(0.5, size=32))


def test_views_of_float64_are_refused_by_name():
    view = view_of(Room(), camera_at(size=32))
    camera = replace(view.camera, c2w=view.camera.c2w.double(), K=view.camera.K.double())
    exact = replace(view, camera=camera, image=view.image.double(), depth=view.depth.double())
    with pytest.raises(InputError, match="holds float64, and float32 is needed"):
        GSCompleter()([exact, exact], camera_at(0.5, size=32))


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"generator": None}, "The generator has to be a function"),
        ({"reconstructor": None}, "The reconstructor has to be a function"),
        ({"renderer": "cpu"}, "The renderer has to be one"),
        ({"config": "paper"}, r"a CompleterConfig, such as CompleterConfig\.paper\(\)"),
        ({"seed": "1"}, "The seed has to be a whole number"),
        ({"seed": -1}, "The seed has to be a whole number"),
    ],
)
def test_parts_of_a_completer_are_refused_at_once(settings, sentence):
    with pytest.raises(InputError, match=sentence):
        unchecked(GSCompleter, **settings)


def unchecked(make, *arguments, **changes):
    """Call `make` without the type checks of these tests."""
    from jaxtyping import config

    before = config.jaxtyping_disable
    config.update("jaxtyping_disable", True)
    try:
        return make(*arguments, **changes)
    finally:
        config.update("jaxtyping_disable", before)


def test_of_a_context_some_or_all_are_left_out():
    scene = random_gaussians(5)
    source = ContextScene.whole(scene)
    everything = torch.ones(5).bool()
    half = source.leave_out(torch.arange(5) < 3)
    assert torch.equal(half.rendered.means, scene.means[3:])
    assert half.proxy_index[3:].tolist() == [0, 1]
    empty = replace(source.leave_out(everything), replaced_mask=everything)
    assert len(empty.leave_out(torch.zeros(0).bool()).rendered) == 0
    assert torch.equal(empty.expand(torch.ones(0, 2)), torch.zeros(5, 2))


def test_a_scene_of_one_part_is_not_copied():
    scene = random_gaussians(5)
    assert merge([scene]) is scene
