"""Colours of Gaussians fitted to an image, which is linear in them."""

from __future__ import annotations

from dataclasses import replace

import torch

from gscompleter.cpu_threads import use_one_torch_thread
from gscompleter.render import FrozenScene
from gscompleter.render.spherical_harmonics import evaluate_colors
from gscompleter.types import SH_C0, Gaussians, View

RELAXATION = 1.7
"""Step size as a multiple of the mean residual; below 2 the rounds converge."""
MIN_WEIGHT = 0.05
"""Summed weight up to which colours are damped, as the image hardly shows them."""


@use_one_torch_thread()
def fit_colors(new: Gaussians, frozen: FrozenScene, image: View, rounds: int) -> Gaussians:
    """Fit the colours of `new` Gaussians by SIRT (Gilbert 1972).

    `frozen` is the scene in front of and behind them, at the camera of the image. The change is the
    same in all directions.
    """
    errors = frozen.vary_colors(new)
    colors = evaluate_colors(new.sh, new.means, image.camera.center)
    change = torch.zeros_like(colors)
    for _ in range(rounds):
        sums, weights = errors(colors + change, image.image)
        change = change + RELAXATION * sums / weights.clamp_min(MIN_WEIGHT)[:, None]
    sh = torch.cat([new.sh[:, :1] + change[:, None] / SH_C0, new.sh[:, 1:]], dim=1)
    return replace(new, sh=sh, encoded=None)
