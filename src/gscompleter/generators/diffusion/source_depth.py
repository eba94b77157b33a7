"""Depth of the photograph that PE-Field carries into the target camera: positive everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.generators.diffusion.complete import loaded
from gscompleter.generators.diffusion.published import (
    announce,
    needs_diffusers,
    reading,
    source_of,
)
from gscompleter.generators.robust import robust_affine
from gscompleter.generators.smooth import continued
from gscompleter.types import Render, View

MONOCULAR = "depth-anything/Depth-Anything-V2-Small-hf"
"""A published model. The authors of PE-Field took MoGe-2, which transformers does not have."""
METRIC = {"depth_anything": False, "dpt": False, "glpn": True}
"""Kinds of networks, and whether they give depth rather than its inverse up to scale and shift. The
configuration of a network may say otherwise."""
NEVER_USED = r"fusion_stage\.layers\.0\.residual_layer1\."
"""Of DPT's first fusion layer, which has nothing to fuse. Some published files lack them."""


@runtime_checkable
class SourceDepth(Protocol):
    """A photograph and the scene as its camera sees it -> z-depth in scene units."""

    def __call__(self, photograph: View, render: Render) -> Float[Tensor, "h w"]: ...


def context_depth(photograph: View, render: Render) -> Float[Tensor, "h w"]:
    """Depth of the scene itself, so that the image fits it without any further alignment.

    Where the scene does not cover half of a pixel, the logarithm of the depth is continued
    smoothly from what surrounds it: next to the border the nearest depths, far from it the mean of
    all.

    Raises:
        InputError: where the photograph's camera sees nothing of the scene.
    """
    valid = seen(render)
    depth = torch.where(valid, render.depth, torch.ones_like(render.depth)).detach().cpu()
    middle = depth[valid.cpu()].median()
    log_depth = (depth / middle).log()[..., None]
    filled = continued(log_depth, valid.cpu().float())[..., 0].exp() * middle
    return torch.where(valid, render.depth, filled.to(render.depth.device))


def seen(render: Render) -> Bool[Tensor, "h w"]:
    """Where the scene has a depth; an InputError where that is nowhere."""
    valid = render.depth_map().valid & (render.depth > 0)
    if not valid.any():
        raise InputError(
            "The camera nearest to the target sees nothing of the scene, and PE-Field needs its "
            "depth there; bring a scene that the photographs show, or choose 'warp-inpaint'."
        )
    return valid


@dataclass(frozen=True)
class MonocularDepth:
    """Depth that a network guesses from the photograph, brought to the unit of the scene."""

    network: Any
    """A depth estimation model of transformers."""
    processor: Any
    """Its image processor."""
    device: str = "cpu"
    """Where it runs."""

    def __call__(self, photograph: View, render: Render) -> Float[Tensor, "h w"]:
        """Its depth, fitted to that of the scene where it has one; errors as `context_depth`."""
        size = (photograph.camera.height, photograph.camera.width)
        pixels = (255 * photograph.image.clamp(0, 1)).round().byte().cpu().numpy()
        inputs = self.processor(images=pixels, return_tensors="pt").to(self.device)
        with torch.inference_mode():
            answer = self.network(**inputs)
        found = self.processor.post_process_depth_estimation(answer, target_sizes=[size])
        guess = found[0]["predicted_depth"].float().clone().to(render.depth.device)
        told = getattr(self.network.config, "depth_estimation_type", None)
        metric = METRIC[self.network.config.model_type] if told is None else told == "metric"
        return rescaled(guess, render) if metric else from_disparity(guess, render)


def rescaled(guess: Float[Tensor, "h w"], render: Render) -> Float[Tensor, "h w"]:
    """`guess`, a depth in another unit, by the median ratio to the depth of the scene."""
    valid = seen(render)
    guess = guess.clamp_min(1e-6 * float(guess.abs().max().clamp_min(1e-12)))
    return guess * (render.depth[valid] / guess[valid]).median()


def from_disparity(guess: Float[Tensor, "h w"], render: Render) -> Float[Tensor, "h w"]:
    """The depth of which `guess` is the inverse up to scale and shift, both fitted to the scene.

    Depths end at ten times the largest of the scene, for a disparity of zero is infinitely far.
    """
    valid = seen(render)
    middle = render.depth[valid].median()
    inverse = middle / render.depth[valid]
    spread, own_spread = deviation(inverse), deviation(guess[valid])
    alike = (guess - guess[valid].median()) * (spread / own_spread.clamp_min(1e-12)) + 1.0
    gain, offset = robust_affine(alike[valid][:, None], inverse[:, None])
    least = middle / (10 * render.depth[valid].max())
    return middle / (gain * alike + offset).clamp_min(float(least))


def deviation(values: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Median distance from the median."""
    return (values - values.median()).abs().median()


def source_depth_named(name: str, device: str = "cpu") -> SourceDepth:
    """`context`, `monocular` (the published model), or what `load_monocular` makes of a path."""
    if name == "context":
        return context_depth
    return load_monocular(MONOCULAR if name == "monocular" else name, device)


@lru_cache(maxsize=1)
def load_monocular(path: str = MONOCULAR, device: str = "cpu") -> MonocularDepth:
    """A depth estimation model of transformers from a folder, USER/NAME or USER/NAME@COMMIT.

    Raises:
        InputError: where packages are missing or the model cannot be had.
    """
    needs_diffusers("pe-field")
    source = source_of(path, "transformers")
    announce([source])
    with reading(source, "depth"):
        from transformers import AutoImageProcessor, AutoModelForDepthEstimation

        network = loaded(AutoModelForDepthEstimation, source, "network", unused=NEVER_USED)
        processor = AutoImageProcessor.from_pretrained(source.place, **source.arguments)
    kind = network.config.model_type
    if kind not in METRIC:
        raise InputError(
            f"The depth network of {path} is a {kind}, of which it is not known whether it gives "
            f"depth or its inverse; choose one of {', '.join(METRIC)}."
        )
    return MonocularDepth(network.eval().to(device), processor, device)
