"""Space that a photograph observed as empty stays empty."""

from dataclasses import replace

import pytest
import torch

from gscompleter.config import FreeSpaceConfig
from gscompleter.guards import free_space
from gscompleter.guards.free_space import Observed, find_in_free_space, respect_free_space
from gscompleter.numerics.geometry import project
from gscompleter.types import Camera, Gaussians, Render, make_observed
from scenes import camera_at

SIZE = 32
TARGET, WITNESS = camera_at(0.5, size=SIZE), camera_at(-0.5, size=SIZE)


def wall(depth: float, alpha: float = 1.0) -> Render:
    """Render a wall that fills the image of a camera."""
    shape = (SIZE, SIZE)
    return Render(torch.zeros(*shape, 3), torch.full(shape, depth), torch.full(shape, alpha))


def floaters(depth: float) -> Gaussians:
    """Make small Gaussians in front of the target camera."""
    x = torch.linspace(-0.3, 0.3, 7)
    means = torch.stack([x, 0 * x, torch.full((7,), depth)], dim=-1)
    return make_observed(
        means,
        torch.tensor([1.0, 0, 0, 0]).repeat(7, 1),
        torch.full((7, 3), 0.01),
        torch.ones(7),
        torch.zeros(7, 1, 3),
    )


def see(render: Render, camera: Camera = WITNESS) -> list[Observed]:
    """List the surfaces that one camera sees."""
    return [Observed.from_render(render, camera, TARGET)]


def test_what_stands_before_a_wall_slides_back_along_its_ray_until_it_is_hidden():
    moved, placed = respect_free_space(
        floaters(2.0), TARGET, [WITNESS], [wall(4.0)], "constant", FreeSpaceConfig()
    )
    assert placed.all()
    assert (moved.means[:, 2] > 4.0).all()
    assert (moved.means[:, 2] < 4.0 * 1.01 * 1.05).all()
    before, _ = project(floaters(2.0).means, TARGET)
    after, _ = project(moved.means, TARGET)
    assert torch.allclose(before, after, atol=1e-3)
    ratio = moved.means[:, 2] / 2.0
    assert torch.allclose(moved.scales, floaters(2.0).scales * ratio[:, None], rtol=1e-4)


def test_what_lies_behind_the_wall_or_in_a_hole_stays():
    for render, depth in ((wall(4.0), 5.0), (wall(4.0, alpha=0.2), 2.0)):
        moved, placed = respect_free_space(floaters(depth), TARGET, [WITNESS], [render], "fixed")
        assert placed.all()
        assert torch.allclose(moved.means, floaters(depth).means, atol=1e-6)


def test_what_finds_no_place_is_told():
    config = FreeSpaceConfig(num_steps=3)
    _, placed = respect_free_space(
        floaters(2.0), TARGET, [WITNESS], [wall(4.0)], "constant", config
    )
    assert not placed.any()


def test_a_gaussian_just_beyond_the_border_shows_and_is_judged_by_the_border(monkeypatch):
    # 1 m in front of the camera, 1.5 pixels left of its image.
    x = (-1.5 - SIZE / 2) / WITNESS.K[0, 0].item() - 0.5
    just_outside = torch.tensor([[x, 0.0, 1.0]])
    far_outside = torch.tensor([[x - 1.0, 0.0, 1.0]])
    assert find_in_free_space(just_outside, see(wall(4.0))).all()
    assert not find_in_free_space(far_outside, see(wall(4.0))).any()
    monkeypatch.setattr(free_space, "OUTER_BORDER", 0)
    assert not find_in_free_space(just_outside, see(wall(4.0))).any()


@pytest.mark.parametrize("unit", [0.001, 1000.0])
def test_the_unit_of_the_scene_does_not_matter(unit):
    def place(unit: float) -> torch.Tensor:
        target, witness = (camera_at(x, size=SIZE, unit=unit) for x in (0.5, -0.5))
        gaussians = replace(floaters(2.0), means=floaters(2.0).means * unit)
        views = [witness], [wall(4.0 * unit)]
        return respect_free_space(gaussians, target, *views, "fixed")[0].means

    assert torch.allclose(place(unit) / unit, place(1.0), rtol=1e-4)


def test_nothing_stands_where_a_camera_stood():
    """No Gaussian is nearer to a camera than all that it sees, not even behind it."""
    behind = WITNESS.center + torch.tensor([[0.0, 0.0, -0.3], [0.0, 0.0, -0.6]])
    assert WITNESS.near == 0.5
    assert find_in_free_space(behind, see(wall(4.0))).tolist() == [True, False]
    unknown = replace(WITNESS, near=None)
    assert not find_in_free_space(behind, see(wall(4.0), unknown)).any()


def make_edge(columns: int) -> Render:
    """Render a surface at 2 m over the left columns, and a wall at 4 m beside it."""
    seen = wall(4.0)
    seen.depth[:, :columns] = 2.0
    return seen


def at_pixels(columns: list[float], depth: float) -> torch.Tensor:
    """Place points of that depth in the middle row of that camera."""
    x = (torch.tensor(columns) - SIZE / 2) * depth / WITNESS.K[0, 0]
    points = torch.stack([x, torch.zeros_like(x), torch.full_like(x, depth)], dim=-1)
    return points @ WITNESS.c2w[:3, :3].T + WITNESS.center


def test_what_an_edge_hides_leaves_the_wall_beside_it_free():
    """A Gaussian behind an object shows beside its edge, unless it lies at the wall there."""
    hidden = at_pixels([8.5, 12.5, 13.5, 15.5], 3.0)
    assert find_in_free_space(hidden, see(make_edge(16))).tolist() == [False, False, True, True]
    at_the_wall = at_pixels([14.5, 15.5], 3.95)
    assert not find_in_free_space(at_the_wall, see(make_edge(16))).any()
    moved, placed = respect_free_space(
        replace(floaters(3.0)[:4], means=hidden), TARGET, [WITNESS], [make_edge(16)], "constant"
    )
    assert placed.all()
    assert (moved.means[2:, 2] > 3.1).all()
    assert not find_in_free_space(moved.means, see(make_edge(16))).any()
    assert torch.equal(moved.means[:2], hidden[:2])


def test_a_photograph_of_another_size_has_footprints_of_its_own_pixels():
    """An addition is a pixel of the target wide, and four of a camera with that focal length."""
    K = WITNESS.K.clone()
    K[:2, :2] *= 4
    close = replace(WITNESS, K=K)
    seen = Observed.from_render(make_edge(16), close, TARGET)
    assert (seen.farthest[0, 4:] == 4.0).all()
    assert (seen.farthest[0, :4] == 2.0).all()


def test_a_hole_of_a_photograph_hides_nothing():
    seen = make_edge(16)
    seen.alpha[:, :16] = 0.0
    assert not find_in_free_space(at_pixels([14.5, 15.5], 3.0), see(seen)).any()
