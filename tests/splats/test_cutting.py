"""Gaussians cut at the border of a region."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gscompleter.editing import cutting
from gscompleter.editing.cutting import cut, split
from gscompleter.numerics.geometry import axis_angle_to_matrix, rotations_to_quats
from gscompleter.render.loading import load_renderer
from gscompleter.types import Gaussians, make_observed, merge, sh_from_rgb
from scenes import camera_at

CAMERA = camera_at(0.0, size=96)
RENDERER = load_renderer("cpu")


def make_disc(x: float = 0.0, opacity: float = 0.9) -> Gaussians:
    """Make an elongated disc in front of the camera, rotated in the image."""
    turn = rotations_to_quats(axis_angle_to_matrix(torch.tensor([0.0, 0, 1]), 0.4))
    scales, color = torch.tensor([[0.5, 0.25, 0.02]]), torch.tensor([[0.9, 0.5, 0.2]])
    center = CAMERA.center + 3 * CAMERA.forward + torch.tensor([x, 0.0, 0.0])
    return make_observed(
        center[None], turn[None], scales, torch.tensor([opacity]), sh_from_rgb(color)
    )


def is_left(points: torch.Tensor) -> torch.Tensor:
    """Find the points left of the middle of the image."""
    return points[:, 0] < CAMERA.center[0]


def show(gaussians: Gaussians) -> torch.Tensor:
    """Render Gaussians."""
    return RENDERER.render(gaussians, CAMERA).image


@pytest.mark.parametrize("opacity", [0.3, 0.6, 0.9])
def test_pieces_look_like_the_whole(opacity):
    whole = make_disc(opacity=opacity)
    pieces = split(whole)
    assert len(pieces) > 20
    assert pieces.scales.amax() < 0.4 * whole.scales.amax()
    assert torch.equal(pieces.scales[:, 2], whole.scales[:1, 2].expand(len(pieces)))
    image, composed = show(whole), show(pieces)
    assert (composed - image).abs().max() < 0.15 * image.max()
    assert (composed - image).mean().abs() < 0.08 * image.mean()


def test_gaussians_are_cut_as_one_by_one(monkeypatch):
    discs = [make_disc(x, opacity) for x in (-1.0, 0.0, 0.1) for opacity in (0.3, 0.9)]
    pairs = [cut(disc, is_left) for disc in discs]
    wholes = [inner for inner, _ in pairs if len(inner) == 1]
    pieces = [inner for inner, _ in pairs if len(inner) > 1]
    assert wholes
    assert len(pieces) > 1
    for block in (1, 2, 1000):
        monkeypatch.setattr(cutting, "CUT_BLOCK", block)
        inner, outer = cut(merge(discs), is_left)
        for name in ("means", "quats", "scales", "opacities", "sh", "generated"):
            parts = [getattr(part, name) for part in (*wholes, *pieces)]
            assert torch.equal(getattr(inner, name), torch.cat(parts)), name
            parts = [getattr(part, name) for _, part in pairs]
            assert torch.equal(getattr(outer, name), torch.cat(parts)), name


def test_balls_and_needles_are_divided_as_well():
    ball, needle = make_disc(opacity=0.6), make_disc(opacity=0.6)
    ball = replace(ball, scales=torch.full_like(ball.scales, 0.3))
    needle = replace(needle, scales=needle.scales * torch.tensor([1.0, 0.1, 1.0]))
    assert len(split(needle)) == 9
    for whole in (ball, needle):
        image, pieces = show(whole), split(whole)
        assert (
            (pieces.scales < 0.4 * whole.scales).sum(dim=1) == (2 if whole is ball else 1)
        ).all()
        assert (show(pieces) - image).abs().max() < 0.2 * image.max()


def test_what_reaches_out_of_the_region_stays():
    disc = make_disc(-0.2)
    inner, outer = cut(disc, is_left)
    assert is_left(inner.means).all()
    assert not is_left(outer.means).any()
    image, (left, right) = show(disc), (slice(0, 40), slice(56, 96))
    assert image[:, right].max() > 0.3
    assert (show(outer) - image)[:, right].abs().max() < 0.15 * image.max()
    assert (show(inner) - image)[:, left].abs().max() < 0.15 * image.max()
    assert show(outer)[:, left].max() < 0.08 * image.max()


def test_gaussians_that_do_not_cross_the_border_are_not_divided():
    inside, outside = make_disc(-2.0), make_disc(0.1)
    inner, outer = cut(merge([inside, outside]), is_left)
    assert torch.equal(inner.means, torch.cat([inside.means, outside.means]))
    assert torch.equal(inner.scales, torch.cat([inside.scales, outside.scales]))
    assert len(outer) == 0
    assert [len(part) for part in cut(inside[:0], is_left)] == [0, 0]
