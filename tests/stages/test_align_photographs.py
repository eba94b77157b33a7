"""Depths of photographs are corrected by what all of them show, and by no more than they tell."""

import pytest
import torch

from gscompleter.stages.align_paper import compare_depth_maps, fit_affine
from gscompleter.stages.align_photographs import align_photographs
from gscompleter.types import DepthAffine, DepthMap
from scenes import Room, camera_at, view_of

SIZE = 64
CAMERAS = [camera_at(x, size=SIZE) for x in (-0.5, 0.0, 0.5)]
NEAR = 2.2
"""Depth of the crate that the scene lacks, before everything that is compared but the floor."""
FAR = 4.5
"""Depth beyond which there is only the far wall."""


def seed() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def show(room: Room) -> list[torch.Tensor]:
    """Return the true depths of a room at each camera."""
    return [view_of(room, camera).depth for camera in CAMERAS]


EMPTY = show(Room(boxes=Room().boxes[:1]))


def everywhere(depths: list[torch.Tensor]) -> list[DepthMap]:
    return [DepthMap(depth, torch.ones_like(depth, dtype=torch.bool)) for depth in depths]


def measure_move(affine: DepthAffine, z: float) -> float:
    """Compute by which share of its depth something at z is moved."""
    return abs(affine.scale * z + affine.shift - z) / z


@pytest.mark.parametrize("error", [0.98, 0.99, 1.01, 1.02])
def test_a_far_wall_that_is_a_little_off_does_not_move_a_near_crate(error):
    scene = everywhere([torch.where(d > FAR, error * d, d) for d in EMPTY])
    assert measure_move(align_photographs(everywhere(EMPTY), scene, seed()), NEAR) < 0.02


def test_the_affine_of_the_paper_moves_the_crate():
    """The case is one: Eq. 8 follows the wall, and the crate is far from all that it fits."""
    scene = everywhere([torch.where(d > FAR, 1.02 * d, d) for d in EMPTY])
    moves = [
        measure_move(fit_affine(compare_depth_maps(one, other), seed()), NEAR)
        for one, other in zip(everywhere(EMPTY), scene, strict=True)
    ]
    assert max(moves) > 0.02


@pytest.mark.parametrize("scale", [0.4, 0.85, 1.1, 3.0])
def test_a_scale_of_its_own_is_found_though_much_shows_something_else(scale):
    other = [torch.rand(d.shape, generator=seed()) * 6 + 1 for d in EMPTY]
    wrong = torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(1)) < 0.4
    scene = everywhere([d.where(~wrong, o) for d, o in zip(EMPTY, other, strict=True)])
    affine = align_photographs(everywhere([d / scale for d in EMPTY]), scene, seed())
    assert affine.scale == pytest.approx(scale, rel=0.01)
    assert affine.shift == 0.0
    assert affine.inliers == pytest.approx(0.6, abs=0.05)


def test_depths_that_only_a_shift_explains_get_one():
    predicted = everywhere([(d - 1.5) / 0.6 for d in EMPTY])
    affine = align_photographs(predicted, everywhere(EMPTY), seed())
    assert affine.method == "ransac"
    assert affine.scale == pytest.approx(0.6, rel=0.02)
    assert affine.shift == pytest.approx(1.5, rel=0.05)


def test_a_photograph_with_little_to_compare_does_not_decide_for_itself():
    """Fit all photographs together: depths of the last one, a strip of wall, have another slope."""
    scene = everywhere(EMPTY)
    strip = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    strip[:, :6] = True
    bent = 0.7 * EMPTY[2] + 0.3 * EMPTY[2][strip].mean()
    scene[2] = DepthMap(bent, strip)
    together = align_photographs(everywhere(EMPTY), scene, seed())
    assert measure_move(together, NEAR) < 0.005
    alone = fit_affine(compare_depth_maps(everywhere(EMPTY)[2], scene[2]), seed())
    assert measure_move(alone, NEAR) > 0.05


def test_without_anything_to_compare_nothing_moves():
    nowhere = [DepthMap(d, torch.zeros_like(d, dtype=torch.bool)) for d in EMPTY]
    assert align_photographs(everywhere(EMPTY), nowhere, seed()) == DepthAffine()


def test_a_single_depth_gets_a_scale():
    flat = everywhere([torch.full((SIZE, SIZE), 2.0)])
    wall = everywhere([torch.full((SIZE, SIZE), 3.0)])
    affine = align_photographs(flat, wall, seed())
    assert (affine.scale, affine.shift) == (1.5, 0.0)
