"""Table of the learned depth predictors."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from gscompleter.models.weights.published import PUBLISHED
from gscompleter.reconstructors.depth_predictors import DepthPredictor


def _load_moge(name: str, weights: Path | None, device: str) -> DepthPredictor:
    """Load MoGe-2; only now its packages are imported."""
    from gscompleter.models.moge import load_moge

    return load_moge(name, weights, device)


DEPTH_PREDICTORS = {
    name: partial(_load_moge, name)
    for name, weights in PUBLISHED.items()
    if weights.gives == "monocular depth"
}
"""Loaders of monocular depth, called with the path of the weights and a device."""
