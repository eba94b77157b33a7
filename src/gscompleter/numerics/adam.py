"""Gradient descent by Adam (Kingma and Ba 2015).

Torch's own class first loads its compiler, which takes longer than many a fit.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.optim.adam import adam


class Adam:
    """The Adam optimiser with one step size per variable.

    `rates` are pairs of a variable, a leaf that requires a gradient, and its step size. `betas` are
    the decay of the running means of gradients and squared gradients.
    """

    def __init__(
        self, rates: Sequence[tuple[Tensor, float]], betas: tuple[float, float] = (0.9, 0.999)
    ) -> None:
        self._rates = list(rates)
        self._betas = betas
        self._means = [torch.zeros_like(variable) for variable, _ in rates]
        self._squares = [torch.zeros_like(variable) for variable, _ in rates]
        self._counts = [torch.zeros(()) for _ in rates]

    def step(self, loss: Tensor, factor: float = 1.0) -> None:
        """Move the variables one step down the gradient of `loss`, in place.

        `loss` depends on all variables. Step sizes are multiplied by `factor`.
        """
        variables = [variable for variable, _ in self._rates]
        gradients = torch.autograd.grad(loss, variables)
        states = zip(self._rates, gradients, self._means, self._squares, self._counts, strict=True)
        beta1, beta2 = self._betas
        with torch.no_grad():
            # One variable at a time: torch's function has one step size for all that it is given.
            for (variable, rate), gradient, mean, square, count in states:
                adam(
                    [variable],
                    [gradient],
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
