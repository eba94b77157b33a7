"""Additions of which photographs show several in one place are thinned out."""

from dataclasses import replace

import pytest
import torch

from gscompleter.stages.thin_additions import PLACE_REACH, find_doubled
from gscompleter.types import Gaussians, merge
from scenes import Room, camera_at, gaussians_of, view_of

PIXELS = gaussians_of(view_of(Room(), camera_at(0.0, size=16)))
"""A surface with a Gaussian for each pixel."""


def all_of(scene: Gaussians) -> torch.Tensor:
    return torch.ones(len(scene), dtype=torch.bool)


def scale(scene: Gaussians, factor: float) -> Gaussians:
    """Make Gaussians larger, at their places."""
    return replace(scene, scales=factor * scene.scales)


def test_one_of_two_in_one_place_goes():
    fine = scale(PIXELS, 0.1)
    doubled = merge([fine, fine])
    # Photographs lose more by the first ones.
    lost = torch.cat([torch.full((len(fine),), 2.0), torch.ones(len(fine))])
    gone = find_doubled(doubled, all_of(doubled), lost)
    assert not gone[: len(fine)].any()
    assert gone[len(fine) :].all()


def test_what_stands_alone_stays():
    assert not find_doubled(scale(PIXELS, 0.1), all_of(PIXELS), torch.zeros(len(PIXELS))).any()


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_each_that_goes_has_one_that_stays_in_its_place(factor):
    lost = torch.rand(len(PIXELS), generator=torch.Generator().manual_seed(0))
    scene = scale(PIXELS, factor)
    gone = find_doubled(scene, all_of(scene), lost)
    assert gone.any()
    distances = torch.cdist(scene.means[gone], scene.means[~gone])
    reach = PLACE_REACH * scene.scales.amax(dim=1)
    both = torch.minimum(reach[gone][:, None], reach[~gone][None])
    assert (distances <= both * (1 + 1e-6)).any(dim=1).all()


def test_those_that_photographs_need_stay():
    doubled = merge([PIXELS, PIXELS])
    is_first = torch.arange(len(doubled)) < len(PIXELS)
    gone = find_doubled(doubled, is_first, torch.zeros(len(doubled)))
    assert gone[is_first].all()
    assert not gone[~is_first].any()


@pytest.mark.parametrize("count", [0, 1])
def test_less_than_two_are_no_doubles(count):
    few = PIXELS[:count]
    assert not find_doubled(few, all_of(few), torch.zeros(count)).any()
