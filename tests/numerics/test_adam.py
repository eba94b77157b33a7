"""Adam takes the steps of torch's own."""

import torch

from gscompleter.numerics.adam import Adam


def slope_of(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    return ((x - 1) ** 4).sum() + (x * y).sum() ** 2


def test_the_steps_are_those_of_torch():
    x, y = torch.randn(7, generator=torch.Generator().manual_seed(0)), torch.ones(7)
    ours = [value.clone().requires_grad_() for value in (x, y)]
    theirs = [value.clone().requires_grad_() for value in (x, y)]
    optimizer = Adam([(ours[0], 0.1), (ours[1], 0.02)], (0.8, 0.99))
    groups = [{"params": [theirs[0]], "lr": 0.1}, {"params": [theirs[1]], "lr": 0.02}]
    torchs = torch.optim.Adam(groups, betas=(0.8, 0.99))
    for _ in range(10):
        optimizer.step(slope_of(*ours))
        torchs.zero_grad()
        slope_of(*theirs).backward()
        torchs.step()
    for value, expected, start in zip(ours, theirs, (x, y), strict=True):
        assert torch.equal(value, expected)
        assert not torch.equal(value.detach(), start)


def test_a_factor_makes_a_step_shorter():
    start = torch.tensor([3.0])
    whole, half = (start.clone().requires_grad_() for _ in range(2))
    Adam([(whole, 0.1)]).step(whole.square().sum())
    Adam([(half, 0.1)]).step(half.square().sum(), 0.5)
    torch.testing.assert_close(start - half, (start - whole) / 2)
