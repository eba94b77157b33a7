"""Colours of Gaussians fitted to images, which are linear in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from gscompleter.render.protocols import ColorSums, FrozenScene
from gscompleter.render.spherical_harmonics import evaluate_colors
from gscompleter.render.view_map import get_view_map
from gscompleter.system.threads import use_one_torch_thread
from gscompleter.types import SH_C0, Gaussians, View

RELAXATION = 1.7
"""Step size as a multiple of the mean residual; below 2 the rounds converge."""
DAMPED_WEIGHT = 0.05
"""Summed weight up to which colours are damped, as the images hardly show them."""


@use_one_torch_thread()
def fit_colors(
    new: Gaussians,
    frozen: Sequence[FrozenScene],
    images: Sequence[View],
    relaxations: Sequence[float],
    overshoot: float = 0.0,
) -> Gaussians:
    """Fit the colours of `new` Gaussians by SIRT (Gilbert 1972), with a step size per round.

    `frozen` is the scene in front of and behind them, at the camera of each image. The change is
    the same in all directions, and makes none brighter than what the images show, nor darker than
    black, but for `overshoot`.
    """
    change = torch.zeros_like(new.means)

    # What shows through half transparent surfaces would be fitted as far too bright, and be a white
    # spot from elsewhere.
    brightest = torch.stack([change.new_ones(()), *(view.image.amax() for view in images)]).amax()
    constant = 0.5 + SH_C0 * new.sh[:, 0]
    most = (brightest + overshoot - constant).clamp_min(0.0)
    least = (-overshoot - constant).clamp_max(0.0)

    # A GPU keeps the bins of every view, as the host waits for each new one. A CPU makes them anew,
    # since those of many photographs take more memory than time.
    plans = [scene.vary_colors(new) for scene in frozen] if change.is_cuda else None

    def measure(index: int, view: View) -> ColorSums:
        plan = frozen[index].vary_colors(new) if plans is None else plans[index]
        colors = evaluate_colors(new.sh, new.means, view.camera.center)
        return plan(colors + change, view.image)

    # Each Gaussian moves by the mean residual of the pixels that show it, by their weight, over all
    # images; the next round sees what its neighbours did.
    for relaxation in relaxations:
        sums = change.new_zeros(change.shape)
        weights = change.new_zeros(len(change))
        for pull, weight in get_view_map(change)(measure, range(len(frozen)), images):
            sums = sums + pull
            weights = weights + weight
        step = relaxation * sums / weights.clamp_min(DAMPED_WEIGHT)[:, None]
        change = (change + step).clamp(least, most)
    fitted = new.sh[:, :1] + change[:, None] / SH_C0
    return replace(new, sh=torch.cat([fitted, new.sh[:, 1:]], dim=1))
