"""Pairs of cameras that may see the same."""

import numpy as np
import pytest

from gscompleter.numerics.two_views import find_near_pairs

AHEAD = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("rounding", [0.0, 1e-8])
def test_views_of_one_panorama_are_no_pair_whatever_rounding_did_to_their_centres(rounding):
    places = np.repeat(np.arange(4)[:, None] * [1.0, 0.0, 0.0], 3, axis=0)
    places += rounding * np.random.default_rng(0).standard_normal(places.shape)
    pairs = find_near_pairs(places, np.tile(AHEAD, (12, 1)), 3)
    # Each with views of a panorama beside its own.
    assert {j // 3 - i // 3 for i, j in pairs} == {1}
    assert {i for pair in pairs for i in pair} == set(range(12))


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.filterwarnings("error")
def test_cameras_in_one_place_form_no_pair(count):
    assert find_near_pairs(np.ones((count, 3)), np.tile(AHEAD, (count, 1)), 3) == []
