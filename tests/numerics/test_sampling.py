"""Samples at even steps."""

import pytest

from gscompleter.numerics.sampling import sample_evenly


@pytest.mark.parametrize(
    ("count", "sampled"),
    [(1, [0]), (2, [0, 8]), (3, [0, 4, 8]), (9, [*range(9)]), (40, [*range(9)])],
)
def test_items_are_sampled_from_the_first_to_the_last(count, sampled):
    assert sample_evenly(range(9), count) == sampled


def test_nothing_has_no_samples():
    assert sample_evenly([], 8) == []
