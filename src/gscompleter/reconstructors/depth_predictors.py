"""Monocular depth by name, which supports stereo where that measures nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.numerics.value_checks import check_depth
from gscompleter.reconstructors.own_models import load_own_model
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.plugins import is_in_file, load_plugins
from gscompleter.types import DepthMap, View

DepthPredictor = Callable[[View], DepthMap]
"""Monocular depth of a view, right up to an affine function of inverse depth."""


def predict_nothing(view: View) -> DepthMap:
    """Predict no depth: surfaces continue what stereo measured."""
    depth = torch.ones_like(view.image[..., 0])
    return DepthMap(depth, torch.zeros_like(depth, dtype=torch.bool))


@dataclass(frozen=True, eq=False)
class StoredDepth:
    """Predictor that takes the depth of photographs from maps, by their frames; of others none."""

    depths: Mapping[int, Float[Tensor, "h w"]]
    """z-depth, 0 where unknown."""

    def __call__(self, view: View) -> DepthMap:
        """Return the map of the frame of a view, if it has the size of the view."""
        stored = None if view.frame is None else self.depths.get(view.frame)
        if stored is None or stored.shape != view.image.shape[:2]:
            return predict_nothing(view)
        depth = stored.to(view.image)
        return DepthMap(depth.where(depth > 0, 1.0), depth > 0)


def predict_depth(predict: DepthPredictor, view: View) -> DepthMap:
    """Predict the depth of a view; raise InputError if it does not fit the view."""
    depth = predict(view)
    check_depth(depth, view)
    return depth


def give_prediction(views: Sequence[View], predict: DepthPredictor) -> list[View]:
    """Give a single photograph the predicted depth, in the scale of the predictor.

    Without stereo nothing else measures; several photographs and a given depth stay as they are.
    Pixels at infinity, such as the sky, get none: no surface is there.
    """
    if len(views) != 1 or len(views[0].known_depths):
        return list(views)
    predicted = predict_depth(predict, views[0])
    is_surface = predicted.valid & predicted.depth.isfinite()
    return [replace(views[0], given_depth=predicted.depth.where(is_surface, 0.0))]


DEPTH_PREDICTORS: dict[str, Callable[[Path | None, str], DepthPredictor]] = {
    "none": lambda weights, device: predict_nothing
}
"""Loader of each built-in predictor: (weights path or None for the published, device)."""

DEPTH_PLUGINS = "gscompleter.depth_predictors"
"""Group of entry points that name further tables of this form."""


def load_depth_predictor(
    name: str, weights: Path | None = None, device: str = "cpu"
) -> DepthPredictor:
    """Load a predictor by name or from `file.py:function`; raise InputError if there is none."""
    if is_in_file(name):
        form = "a View to a DepthMap"
        own: DepthPredictor = load_own_model(name, "depth", form, weights, "depth-weights")
        return own
    loaders = DEPTH_PREDICTORS | load_plugins(DEPTH_PLUGINS)
    if name not in loaders:
        raise InputError(
            f"There is no depth '{quote_value(name)}'; choose one of {', '.join(loaders)}, or name "
            "a function as file.py:function.",
            "depth",
        )
    return loaders[name](weights, device)
