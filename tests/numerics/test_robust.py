"""Robust fits."""

import pytest
import torch

from gscompleter.numerics.robust import fit_line_ransac, fit_robust_affine, fit_scale

RANDOM = torch.rand(200, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
DEPTHS = 1 + 4 * RANDOM
WRONG = torch.arange(200) % 3 == 0
"""A third of the pixels, which show something else."""


def fit_line(x, y):
    return fit_line_ransac(x, y, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("unit_of_x", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("unit_of_y", [1e-6, 1.0, 1e6])
def test_a_line_is_found_among_outliers_in_any_unit(unit_of_x, unit_of_y):
    noise = 1 + 0.04 * (torch.arange(200) % 7 - 3) / 3
    y = torch.where(WRONG, 3 * DEPTHS.flip(0), noise * (2 * DEPTHS + 1))
    expected = fit_line(DEPTHS, y)
    assert expected == pytest.approx((2, 1), rel=0.1)
    scale, shift = fit_line(unit_of_x * DEPTHS, unit_of_y * y)
    assert scale * unit_of_x / unit_of_y == pytest.approx(expected[0], rel=1e-6)
    assert shift / unit_of_y == pytest.approx(expected[1], rel=1e-6)


def test_there_is_no_line_through_one_depth_or_with_a_falling_one():
    assert fit_line(torch.ones_like(DEPTHS), DEPTHS) == (0.0, 0.0)
    assert fit_line(torch.zeros_like(DEPTHS), DEPTHS) == (0.0, 0.0)
    assert fit_line(DEPTHS, 6 - DEPTHS) == (0.0, 0.0)


def test_a_scale_is_found_among_outliers():
    assert fit_scale(DEPTHS, torch.where(WRONG, 9.0, 2 * DEPTHS)) == pytest.approx(2, rel=1e-9)


def test_a_gain_and_an_offset_are_found_in_each_channel():
    x = torch.stack([RANDOM, RANDOM.flip(0)], dim=1)
    wrong = torch.where(WRONG[:, None], 1 - x, torch.tensor([0.8, 1.2]) * x + 0.1)
    gain, offset = fit_robust_affine(x, wrong)
    assert gain.tolist() == pytest.approx([0.8, 1.2], abs=0.01)
    assert offset.tolist() == pytest.approx([0.1, 0.1], abs=0.01)


def test_without_samples_nothing_is_corrected():
    gain, offset = fit_robust_affine(torch.ones(0, 3), torch.ones(0, 3))
    assert (gain.tolist(), offset.tolist()) == ([1, 1, 1], [0, 0, 0])
