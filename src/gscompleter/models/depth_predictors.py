"""Table of the learned depth predictors."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from gscompleter.models.weights.published import PUBLISHED
from gscompleter.reconstructors.depth_predictors import DepthPredictor


def _load_moge(name: str, weights: Path | None, device: str) -> DepthPredictor:
    """Load MoGe-2; only now its packages are imported."""
    from gscompleter.models.moge import load_moge

    return load_moge(name, weights, device)


def _load_depth_anything(name: str, weights: Path | None, device: str) -> DepthPredictor:
    """Load the monocular network of Depth Anything 3."""
    from gscompleter.models.depth_anything.monocular import load_monocular

    return load_monocular(name, weights, device)


def _load_moge3(name: str, weights: Path | None, device: str) -> DepthPredictor:
    """Load MoGe-3 through its own package."""
    from gscompleter.models.moge3 import load_moge3

    return load_moge3(name, weights, device)


MOGE_3 = ("moge-3-large", "moge-3-giant")
DEPTH_PREDICTORS: dict[str, Callable[[Path | None, str], DepthPredictor]] = {
    **{
        name: partial(_load_moge if weights.network is None else _load_depth_anything, name)
        for name, weights in PUBLISHED.items()
        if weights.gives == "monocular depth"
    },
    **{name: partial(_load_moge3, name) for name in MOGE_3},
}
"""Loaders of monocular depth, called with the path of the weights and a device."""
