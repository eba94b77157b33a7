"""Depth of the photograph for PE-Field, positive everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.models.depth_predictors import DEPTH_PREDICTORS
from gscompleter.models.diffusion.complete import load_transformers_model
from gscompleter.models.diffusion.published import (
    announce,
    check_packages,
    convert_load_errors,
    parse_source,
)
from gscompleter.numerics.robust import fit_robust_affine
from gscompleter.numerics.smooth import continue_smoothly
from gscompleter.reconstructors.depth_predictors import DepthPredictor
from gscompleter.system.errors import InputError, quote_value
from gscompleter.types import Render, View

MONOCULAR_MODEL = "depth-anything/Depth-Anything-V2-Small-hf"
"""Small published depth model of transformers, for `monocular`. The authors use MoGe-2 (large)."""
PREDICTS_DEPTH = {"depth_anything": False, "dpt": False, "glpn": True}
"""Supported kinds of networks, and True for those that predict depth rather than disparity."""
UNUSED_TENSORS = r"fusion_stage\.layers\.0\.residual_layer1\."
"""Pattern of DPT's unused tensors in the first fusion layer; some files omit them."""


@runtime_checkable
class SourceDepth(Protocol):
    """Function from a photograph and the render at its camera to z-depth in scene units."""

    def __call__(self, photograph: View, render: Render) -> Float[Tensor, "h w"]:
        """Compute z-depth."""
        ...


def compute_context_depth(photograph: View, render: Render) -> Float[Tensor, "h w"]:
    """Return the depth of the scene, with smooth extrapolation where alpha is below 0.5.

    Raises:
        InputError: The camera sees nothing of the scene.
    """
    valid = find_valid_depth(render)
    depth = torch.where(valid, render.depth, torch.ones_like(render.depth)).detach().cpu()
    # In the logarithm, so that what is continued stays positive, and relative to the median.
    middle = depth[valid.cpu()].median()
    log_depth = (depth / middle).log()[..., None]
    filled = continue_smoothly(log_depth, valid.cpu().float())[..., 0].exp() * middle
    return torch.where(valid, render.depth, filled.to(render.depth.device))


def find_valid_depth(render: Render) -> Bool[Tensor, "h w"]:
    """Return a mask of valid depth; raises InputError if it is empty."""
    valid = render.depth_map().valid & (render.depth > 0)
    if not valid.any():
        raise InputError(
            "The camera nearest to the target sees nothing of the scene, and PE-Field needs its "
            "depth there; give a scene that the photographs show, or choose 'warp-inpaint'."
        )
    return valid


@dataclass(frozen=True)
class MonocularDepth:
    """Depth of a monocular network, fitted to the scene."""

    network: Any
    processor: Any
    device: str = "cpu"

    def __call__(self, photograph: View, render: Render) -> Float[Tensor, "h w"]:
        """Predict depth and fit it to the scene; raises the errors of `compute_context_depth`."""
        size = (photograph.camera.height, photograph.camera.width)
        pixels = (255 * photograph.image.clamp(0, 1)).round().byte().cpu().numpy()
        inputs = self.processor(images=pixels, return_tensors="pt").to(self.device)
        with torch.inference_mode():
            answer = self.network(**inputs)
        processed = self.processor.post_process_depth_estimation(answer, target_sizes=[size])
        guess = processed[0]["predicted_depth"].float().clone().to(render.depth.device)

        # Only some kinds of networks declare what they predict; the others always predict the same.
        declared = getattr(self.network.config, "depth_estimation_type", None)
        if declared is None:
            is_depth = PREDICTS_DEPTH[self.network.config.model_type]
        else:
            is_depth = declared == "metric"
        return rescale_depth(guess, render) if is_depth else convert_disparity(guess, render)


@dataclass(frozen=True)
class PredictedDepth:
    """Depth of a predictor, fitted to the scene; the sky is as far as the farthest surface."""

    predict: DepthPredictor

    def __call__(self, photograph: View, render: Render) -> Float[Tensor, "h w"]:
        """Predict depth and fit it to the scene; raises the errors of `compute_context_depth`."""
        predicted = self.predict(photograph)
        farthest = predicted.depth.where(predicted.valid, 0.0).max()
        filled = predicted.depth.where(predicted.valid, farthest)
        # What was filled in measures nothing, so that it does not take part in the fit.
        return rescale_depth(filled, render, predicted.valid)


def rescale_depth(
    guess: Float[Tensor, "h w"], render: Render, measured: Bool[Tensor, "h w"] | None = None
) -> Float[Tensor, "h w"]:
    """Scale depth by the median ratio to the depth of the scene where it was `measured`.

    None is everywhere. Raises InputError if the scene shows nothing there.
    """
    valid = find_valid_depth(render)
    if measured is not None:
        valid = valid & measured
        if not valid.any():
            raise InputError(
                "The predicted depth of the photograph nearest to the target has no surface where "
                "the scene has one, and so no scale; choose the depth 'context'."
            )
    guess = guess.clamp_min(1e-6 * float(guess.abs().max().clamp_min(1e-12)))
    return guess * (render.depth[valid] / guess[valid]).median()


def convert_disparity(guess: Float[Tensor, "h w"], render: Render) -> Float[Tensor, "h w"]:
    """Convert disparity to depth, with scale and shift fitted to the scene."""
    valid = find_valid_depth(render)
    middle = render.depth[valid].median()
    inverse = middle / render.depth[valid]
    # Disparities have any unit. The robust fit expects values like its own, so that they first get
    # the median and the deviation of the scene's.
    spread = compute_deviation(inverse)
    own_spread = compute_deviation(guess[valid])
    alike = (guess - guess[valid].median()) * (spread / own_spread.clamp_min(1e-12)) + 1.0
    gain, offset = fit_robust_affine(alike[valid][:, None], inverse[:, None])
    # Disparity near 0 is far away: at most ten times as far as the scene reaches.
    least = middle / (10 * render.depth[valid].max())
    return middle / (gain * alike + offset).clamp_min(float(least))


def compute_deviation(values: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Compute the median absolute deviation."""
    return (values - values.median()).abs().median()


def load_source_depth(name: str, device: str = "cpu") -> SourceDepth:
    """Load a depth by its name: `context`, `monocular` (the published model) or a predictor.

    Any other name is a model of transformers, as in `load_monocular`.
    """
    if name == "context":
        return compute_context_depth
    if name in DEPTH_PREDICTORS:
        return load_predicted(name, device)
    return load_monocular(MONOCULAR_MODEL if name == "monocular" else name, device)


@lru_cache(maxsize=1)
def load_predicted(name: str, device: str = "cpu") -> PredictedDepth:
    """Load one of `DEPTH_PREDICTORS`; it stays loaded, since each target asks for it."""
    return PredictedDepth(DEPTH_PREDICTORS[name](None, device))


@lru_cache(maxsize=1)
def load_monocular(path: str = MONOCULAR_MODEL, device: str = "cpu") -> MonocularDepth:
    """Load a depth model of transformers from a folder, USER/NAME or USER/NAME@COMMIT."""
    check_packages("pe-field")
    source = parse_source(path, "transformers")
    announce([source])
    with convert_load_errors(source, "depth"):
        from transformers import AutoImageProcessor, AutoModelForDepthEstimation

        network = load_transformers_model(
            AutoModelForDepthEstimation, source, "network", unused=UNUSED_TENSORS
        )
        processor = AutoImageProcessor.from_pretrained(source.location, **source.load_arguments)
    kind = network.config.model_type
    if kind not in PREDICTS_DEPTH:
        raise InputError(
            f"The depth network of {quote_value(Path(path))} is of the unsupported kind {kind}; "
            f"choose one of {', '.join(PREDICTS_DEPTH)}."
        )
    return MonocularDepth(network.eval().to(device), processor, device)
