"""A splat says which of two cameras of a photograph it agrees with, or that it cannot tell."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gscompleter import load_renderer
from gscompleter.splats.alignment.witness import compare_poses
from gscompleter.types import View, merge
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 48
RENDERER = load_renderer("cpu")
TRUE_VIEWS = [view_of(Room(), camera_at(x, size=SIZE)) for x in (-0.2, 0.2)]
SPLAT = merge([gaussians_of(view) for view in TRUE_VIEWS])
PHOTOS = [
    replace(view, image=RENDERER.render(SPLAT, view.camera).image.clamp(0, 1))
    for view in TRUE_VIEWS
]
"""Photographs that the splat reproduces."""


def shift(view: View, x: float) -> View:
    """Place the camera of a photograph wrongly."""
    c2w = view.camera.c2w.clone()
    c2w[0, 3] += x
    return replace(view, camera=replace(view.camera, c2w=c2w))


def test_the_right_cameras_agree_more_whichever_are_the_given_ones():
    wrong = [shift(view, 0.1) for view in PHOTOS]
    compared = compare_poses(SPLAT, wrong, PHOTOS, RENDERER)
    assert compared.refined > compared.given + 3
    swapped = compare_poses(SPLAT, PHOTOS, wrong, RENDERER)
    assert (swapped.given, swapped.refined) == (compared.refined, compared.given)


def test_another_exposure_counts_for_neither():
    far = [shift(view, 0.1) for view in PHOTOS]
    near = [shift(view, 0.05) for view in PHOTOS]
    expected = compare_poses(SPLAT, far, near, RENDERER)
    far, near = ([replace(view, image=0.8 * view.image) for view in views] for views in (far, near))
    compared = compare_poses(SPLAT, far, near, RENDERER)
    # A gain scales the errors of both alike.
    margin = expected.refined - expected.given
    assert compared.refined - compared.given == pytest.approx(margin, abs=0.01)


def test_a_splat_that_covers_little_of_all_photographs_says_nothing():
    few = SPLAT[:20]
    assert compare_poses(few, PHOTOS, PHOTOS, RENDERER) is None
    hidden = torch.ones(SIZE, SIZE, dtype=torch.bool)
    masked = [replace(view, ignore_mask=hidden) for view in PHOTOS]
    assert compare_poses(SPLAT, masked, masked, RENDERER) is None
    # One photograph with enough of them is asked alone.
    one = [PHOTOS[0], masked[1]]
    alone = compare_poses(SPLAT, PHOTOS[:1], PHOTOS[:1], RENDERER)
    assert compare_poses(SPLAT, one, one, RENDERER) == alone
