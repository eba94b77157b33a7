"""Gradient descent by Adam (Kingma and Ba 2015).

The steps are torch's own. Its class `torch.optim.Adam` loads the compiler of torch when the first
one is made, which takes longer than many a fit.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.optim.adam import adam


class Adam:
    """Steps of given sizes down the slope of a loss."""

    def __init__(
        self, rates: Sequence[tuple[Tensor, float]], betas: tuple[float, float] = (0.9, 0.999)
    ) -> None:
        """
        Args:
            rates: What is varied, and the size of its steps.
            betas: Decay of the running means of slopes and of their squares.
        """
        self._rates, self._betas = list(rates), betas
        self._means = [torch.zeros_like(variable) for variable, _ in rates]
        self._squares = [torch.zeros_like(variable) for variable, _ in rates]
        self._counts = [torch.zeros(()) for _ in rates]

    def step(self, loss: Tensor, factor: float = 1.0) -> None:
        """One step down the slope of `loss`, its size multiplied by `factor`."""
        variables = [variable for variable, _ in self._rates]
        slopes = torch.autograd.grad(loss, variables)
        states = zip(self._rates, slopes, self._means, self._squares, self._counts, strict=True)
        beta1, beta2 = self._betas
        with torch.no_grad():
            for (variable, rate), slope, mean, square, count in states:
                adam(
                    [variable],
                    [slope],
                    [mean],
                    [square],
                    [],
                    [count],
                    amsgrad=False,
                    beta1=beta1,
                    beta2=beta2,
                    lr=factor * rate,
                    weight_decay=0.0,
                    eps=1e-8,
                    maximize=False,
                )
