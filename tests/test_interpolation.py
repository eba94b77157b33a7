"""What is known in part is continued smoothly."""

import torch

from gscompleter.interpolation import fill_smoothly


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
