"""Values known in a part of an image are interpolated smoothly."""

import torch

from gscompleter.numerics.image_ops import fill_smoothly, smooth_masked


def test_known_values_stay_and_a_constant_is_continued():
    values = torch.full((20, 30), 4.0)
    known = torch.zeros(20, 30, dtype=torch.bool)
    known[:, :5] = True
    assert torch.allclose(fill_smoothly(values, known), values)


def test_between_two_known_sides_the_values_lie_between():
    values = torch.zeros(16, 33)
    values[:, -1] = 1.0
    known = torch.zeros(16, 33, dtype=torch.bool)
    known[:, 0] = known[:, -1] = True
    filled = fill_smoothly(values, known, num_relaxations=2000)
    assert torch.allclose(filled, torch.linspace(0, 1, 33).expand(16, 33), atol=0.02)


def test_nothing_known_is_zero():
    assert (fill_smoothly(torch.ones(5, 7), torch.zeros(5, 7, dtype=torch.bool)) == 0).all()


def test_means_are_those_of_the_pixels_of_the_mask_around():
    values = torch.rand(9, 13, 3, generator=torch.Generator().manual_seed(0))
    mask = torch.rand(9, 13, generator=torch.Generator().manual_seed(1)) < 0.4
    found = smooth_masked(values, mask, 2)
    compared = 0
    for y in range(9):
        for x in range(13):
            around = slice(max(y - 2, 0), y + 3), slice(max(x - 2, 0), x + 3)
            if mask[around].any():
                expected = values[around][mask[around]].mean(dim=0)
                assert (found[y, x] - expected).abs().max() < 1e-6
                compared += 1
    assert compared > 100
