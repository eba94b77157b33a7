"""Total generalized variation of second order as operations of torch, for a GPU.

The twin of `kernels/tgv.py`. Heights u and their gradients v are one tensor of three maps, and so
are the dual variables of each direction: they are differentiated, and moved, together.
"""

from __future__ import annotations

import threading

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from gscompleter.numerics.kernels.tgv import (
    DUAL_STEP,
    GRADIENT_DUAL_STEP,
    GRADIENT_STEP,
    PRIMAL_STEP,
)

LAUNCHES_PER_ITERATION = 20
"""Operations of an iteration, each of which a GPU is given alone."""

FIT_BYTES = 140
"""Most bytes for each pixel that a fit holds on its device."""
_FITTING = threading.Lock()
"""Held during a fit: several at a time would launch no faster, and hold as much each."""

HeightMap = Float32[np.ndarray, "h w"]


def fit_on_device(
    device: str,
    heights: HeightMap,
    gradients: Float32[np.ndarray, "2 h w"],
    data: HeightMap,
    weight: HeightMap,
    across: HeightMap,
    down: HeightMap,
    bend: np.float32,
    tolerance: np.float32,
    iterations: int,
) -> None:
    """Fit heights and their gradients, in place, as `fit` of the kernels does.

    The host waits once, for the result. Roundings differ: the result is equal to about 1e-5 of the
    largest height. One map is fitted at a time, from whatever threads.
    """

    def upload(*arrays: np.ndarray) -> Tensor:
        return torch.from_numpy(np.stack(arrays)).to(device, non_blocking=True)

    def fit() -> Float32[np.ndarray, "3 h w"]:
        state = upload(heights, *gradients)
        # Beyond the last column and the last row there is nothing to step to.
        bounds = upload(across, down)
        bounds[0, :, -1] = 0
        bounds[1, -1] = 0
        (target,) = upload(data)
        (pull,) = upload(PRIMAL_STEP * weight)
        state = iterate(state, bounds, target, pull, float(bend), float(tolerance), iterations)
        return state.cpu().numpy()

    # The tensors belong to the call inside, so that they are let go before the next fit begins.
    with _FITTING:
        found = fit()
    heights[:] = found[0]
    gradients[:] = found[1:]


def iterate(
    state: Float32[Tensor, "3 h w"],
    bounds: Float32[Tensor, "2 h w"],
    target: Float32[Tensor, "h w"],
    pull: Float32[Tensor, "h w"],
    bend: float,
    tolerance: float,
    iterations: int,
) -> Float32[Tensor, "3 h w"]:
    """Run the primal-dual iterations from heights and gradients, and return these.

    `bounds` are the costs of a step to the right and below, and `pull` the steps that measurements
    cause at most.
    """
    share = pull / (tolerance + pull)
    lower = -bounds
    lowest_pull = -pull
    dual_rates, primal_rates = (
        torch.tensor(rates)[:, None, None].to(state, non_blocking=True)
        for rates in (
            [DUAL_STEP, GRADIENT_DUAL_STEP, GRADIENT_DUAL_STEP],
            [PRIMAL_STEP, GRADIENT_STEP, GRADIENT_STEP],
        )
    )
    after = torch.empty_like(state)
    ahead = state.clone()
    change = torch.empty_like(state)
    duals = state.new_zeros((2, *state.shape))
    along_row, along_column = duals
    # `steps` belong to u_x - v_x and u_y - v_y, `bends` to the derivatives of v.
    steps = duals[:, 0]
    bends = duals[:, 1:]
    for _ in range(iterations):
        rise = ahead[:, :, 1:] - ahead[:, :, :-1]
        along_row[:, :, :-1].addcmul_(rise, dual_rates)
        rise = ahead[:, 1:] - ahead[:, :-1]
        along_column[:, :-1].addcmul_(rise, dual_rates)
        steps.sub_(ahead[1:], alpha=float(DUAL_STEP))
        torch.clamp(steps, lower, bounds, out=steps)
        length = torch.linalg.vector_norm(bends, dim=(0, 1))
        bends.div_(length.div_(bend).clamp_min_(1))

        # Negative divergence of the duals, with nothing beyond the border.
        torch.add(along_row, along_column, out=change)
        change[:, :, 1:].sub_(along_row[:, :, :-1])
        change[:, 1:].sub_(along_column[:, :-1])
        change[1:].add_(steps)
        torch.addcmul(state, change, primal_rates, out=after)
        # Proximal step of the Huber loss: shrinking near the data, a constant pull farther off.
        miss = after[0] - target
        after[0].sub_(torch.clamp(miss.mul_(share), lowest_pull, pull))
        torch.lerp(state, after, 2.0, out=ahead)
        # The array of the state before is written over in the next iteration.
        previous = state
        state = after
        after = previous
    return state
