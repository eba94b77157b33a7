"""Hole masks: Eq. 12, and what trust, padding and edits of a user make of it."""

from dataclasses import replace

import torch

from gscompleter.config import CompleterConfig, HoleConfig
from gscompleter.numerics.geometry import pad_camera
from gscompleter.stages.hole_masks import HoleEdits, HoleMasks, compute_hole_mask, find_hole_masks
from gscompleter.types import Camera, Render
from scenes import camera_at

SIZE = 16
CAMERA = pad_camera(camera_at(size=SIZE), 0.0)
ALPHA = torch.linspace(0, 1, SIZE).expand(SIZE, SIZE)
"""Empty on the left, covered on the right."""
RENDER = Render(torch.zeros(SIZE, SIZE, 3), torch.ones(SIZE, SIZE), ALPHA)
PAPER = CompleterConfig.paper().holes


def render_nothing(camera: Camera) -> Render:
    raise AssertionError("no other camera is asked")


def find(
    trusted: torch.Tensor = ALPHA, config: HoleConfig = PAPER, edits: HoleEdits = HoleEdits()
) -> HoleMasks:
    return find_hole_masks(RENDER, trusted, CAMERA, config, edits, render_nothing)


def test_in_the_paper_the_mask_is_that_of_eq_12():
    masks = find()
    expected = ALPHA < 0.5
    assert torch.equal(masks.empty, expected)
    assert masks.holes is masks.empty
    assert torch.equal(compute_hole_mask(ALPHA), expected)


def test_what_is_not_trusted_is_filled_by_an_image_and_gets_no_gaussians():
    trusted = ALPHA.where(torch.arange(SIZE)[:, None] < SIZE // 2, 0.0)
    masks = find(trusted)
    assert masks.holes[SIZE // 2 :].all()
    assert torch.equal(masks.holes[: SIZE // 2], (ALPHA < 0.5)[: SIZE // 2])
    assert torch.equal(masks.empty, ALPHA < 0.5)


def test_after_a_removal_only_what_it_opened_is_a_hole():
    opened = torch.arange(SIZE)[:, None].expand(SIZE, SIZE) < 4
    masks = find(edits=HoleEdits(opened))
    assert torch.equal(masks.empty, (ALPHA < 0.5) & opened)


def test_what_the_user_marked_is_a_hole_whatever_stands_there():
    opened = torch.arange(SIZE)[:, None].expand(SIZE, SIZE) < 4
    forced = torch.arange(SIZE).expand(SIZE, SIZE) >= 12
    masks = find(edits=HoleEdits(opened, forced))
    assert torch.equal(masks.empty, ((ALPHA < 0.5) & opened) | forced)
    assert torch.equal(masks.holes, masks.empty)


def test_padding_is_completed_beside_holes_of_the_image_alone():
    camera = pad_camera(camera_at(size=SIZE), 0.25)
    size = camera.padded.height
    # The rim is empty all around; in the image, only the upper half of the left edge is.
    alpha = torch.zeros(size, size)
    camera.crop(alpha).fill_(1.0)
    camera.crop(alpha)[: SIZE // 2, :2] = 0.0
    render = Render(torch.zeros(size, size, 3), torch.ones(size, size), alpha)
    config = replace(PAPER, padding="beside")
    masks = find_hole_masks(render, alpha, camera, config, HoleEdits(), render_nothing)
    left, top = camera.left, camera.top
    assert masks.empty[top : top + SIZE // 2, :left].all()
    assert not masks.empty[top + SIZE // 2 :, :left].any()
    assert not masks.empty[:, left + SIZE :].any()
