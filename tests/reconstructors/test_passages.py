"""Passages: what is not measured moves away from where cameras were carried along."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter import View
from gscompleter.numerics.geometry import axis_angle_to_matrix
from gscompleter.reconstructors.plane_sweep.free_space import leave_free_space
from gscompleter.reconstructors.plane_sweep.fusion import DepthLayer
from gscompleter.reconstructors.plane_sweep.passages import (
    PASSAGE_DEPTH,
    PASSAGE_SHARES,
    Passages,
    find_passages,
)
from gscompleter.reconstructors.plane_sweep.rig import build_rig
from gscompleter.types import DepthMap
from scenes import Room, camera_at, view_of

SIZE = 40
NEAR = 1.0
BLOCK = (slice(10, 30), slice(5, 35))


def views_at(*offsets: float) -> list[View]:
    views = [view_of(Room(), camera_at(x, size=SIZE)) for x in offsets]
    return [replace(view, camera=replace(view.camera, near=NEAR)) for view in views]


def passages_of(views: list[View], checks: Sequence[View] = ()) -> Passages:
    depth = DepthMap(views[0].depth, torch.ones_like(views[0].depth, dtype=torch.bool))
    inverse = (build_rig(views).unit / views[0].depth).float().numpy()
    return find_passages(views, checks, depth, inverse)


def hanging_layers(views: list[View], is_measured: bool) -> tuple[list[DepthLayer], dict]:
    """Layers of which the first has a block right before the cameras; the others show nothing."""
    rig = build_rig(views)
    layers = []
    for number, (view, image) in enumerate(zip(views, rig.images, strict=True)):
        inverse = np.float32(rig.unit) / view.depth.numpy()
        confidence = np.full_like(inverse, float(number == 0))
        if number == 0:
            inverse[BLOCK] = np.float32(rig.unit) / (1.1 * NEAR)
            confidence[BLOCK] = float(is_measured)
        layers.append(DepthLayer(image, inverse, confidence))
    return layers, rig.transforms


@pytest.mark.parametrize("is_measured", [False, True])
def test_what_is_not_measured_moves_away_from_passages(is_measured):
    views = views_at(-0.2, 0.0, 0.2)
    layers, transforms = hanging_layers(views, is_measured)
    passages = passages_of(views)
    everywhere = [np.ones_like(layer.measured_mask) for layer in layers]
    none = [np.zeros(layer.inverse.shape, int) for layer in layers]
    skies = [~mask for mask in everywhere]
    before = layers[0].inverse
    blocking = passages.find_blocking(0, before, everywhere[0])
    assert blocking[BLOCK].all()
    assert blocking.sum() == blocking[BLOCK].sum()

    inputs = (layers, everywhere, none, skies, transforms)
    assert leave_free_space(*inputs)[0] is layers[0]
    first, *others = leave_free_space(*inputs, passages)
    assert all(after is layer for after, layer in zip(others, layers[1:], strict=True))
    if is_measured:
        assert first is layers[0]
        return
    assert not passages.find_blocking(0, first.inverse, everywhere[0]).any()
    assert (first.inverse < before)[BLOCK].all()
    # Not farther than one step, and nothing else moved.
    depth = build_rig(views).unit / first.inverse[BLOCK]
    assert depth.max() < 1.06 * PASSAGE_DEPTH * NEAR
    assert np.array_equal(first.inverse[~blocking], before[~blocking])


def test_passages_are_the_cameras_and_others_on_the_way():
    views = views_at(-0.2, 0.0, 0.2)
    (check,) = views_at(0.5)
    cameras = passages_of(views, [check]).cameras
    # Each of the four is a neighbour of all others.
    assert len(cameras) == 4 + 6 * len(PASSAGE_SHARES)
    places = sorted({round(float(camera.center[0]), 3) for camera in cameras})
    assert places[0] == -0.2
    assert places[-1] == 0.5
    assert 0.1 in places


def test_there_are_none_between_cameras_that_look_elsewhere_or_without_a_near_plane():
    views = views_at(-0.2, 0.0, 0.2)
    camera = views[2].camera
    c2w = camera.c2w.clone()
    c2w[:3, :3] = axis_angle_to_matrix(torch.tensor([0.0, 1.0, 0.0]), 1.6) @ c2w[:3, :3]
    turned = [*views[:2], replace(views[2], camera=replace(camera, c2w=c2w))]
    assert len(passages_of(turned).cameras) == 3 + len(PASSAGE_SHARES)
    assert not passages_of(views[:2]).cameras
    unknown = [replace(view, camera=replace(view.camera, near=None)) for view in views]
    assert not passages_of(unknown).cameras
