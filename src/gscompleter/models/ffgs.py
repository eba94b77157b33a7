"""Models of the package `ffgs` (libgs, 2026) as Ψ: one interface for feed-forward 3DGS.

The calls follow its source, version 0.1.0.dev1. Tested with a stand-in of the same interface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.models.feed_forward.inputs import compute_central_crops
from gscompleter.models.feed_forward.reconstructor import MAX_COEFFICIENTS
from gscompleter.models.packages import choose_weights, import_authors_module
from gscompleter.numerics.value_checks import find_finite
from gscompleter.render.loading import load_renderer
from gscompleter.system.errors import InputError, quote_value
from gscompleter.types import Gaussians, Reconstruction, View, make_observed

INSTALL = "pip install --pre ffgs"
"""Command that installs the package, which has pre-releases only."""
PREFIX = "ffgs:"
"""Beginning of the names of its models among the reconstructors."""


@dataclass(frozen=True)
class PipelineGaussians:
    """Gaussians of a pipeline of `ffgs`, in the frame and unit of the cameras."""

    pipeline: Any
    """A `GSPipeline` with its model on `device`."""
    make_views: Callable[..., Any]
    """The class `Views` of the package."""
    device: str = "cpu"

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Reconstruct Gaussians; the depth of each view is that of their render.

        Raises:
            InputError: Too few views, or poses that the model cannot place.
        """
        # A padded target is cropped to what all images have.
        crops = compute_central_crops([view.camera for view in views], patch=1)
        images = []
        intrinsics = []
        for view, crop in zip(views, crops, strict=True):
            images.append(view.image[crop.rows, crop.columns].permute(2, 0, 1))  # channels first
            # In pixels of the crop: its rays stay those of the view.
            K = view.camera.K.clone()
            K[0, 2] -= crop.left
            K[1, 2] -= crop.top
            intrinsics.append(K)
        given = self.make_views(
            torch.stack(images).float().to(self.device),
            torch.stack(intrinsics).float().to(self.device),
            torch.stack([view.camera.c2w for view in views]).float().to(self.device),
        )
        try:
            with torch.no_grad():
                output = self.pipeline(given).to_world()
        except (ValueError, KeyError) as error:  # what the package refuses
            raise InputError(
                f"The model of ffgs refuses these photographs ({quote_value(str(error), 120)}); "
                "choose others, or another model."
            ) from error
        device = views[0].image.device
        gaussians = convert_gaussians(output.gaussians).to(device)
        renderer = load_renderer(device.type)
        with torch.no_grad():
            renders = [renderer.render(gaussians, view.camera) for view in views]
        return Reconstruction(gaussians, tuple(render.depth_map() for render in renders))


def convert_gaussians(predicted: Any) -> Gaussians:
    """Convert the Gaussians of the only scene of a batch [1, n, ...].

    The package has our conventions: linear scales, opacities up to 1, quaternions wxyz of any
    length, and `sh()` [1, n, k, 3] in the 3DGS basis. Left out are the padding of the batch, and
    what has NaN, infinity or no rotation.
    """

    def take_scene(values: Tensor) -> Tensor:
        return values[0].detach().float().contiguous()

    whole = make_observed(
        take_scene(predicted.means),
        normalize(take_scene(predicted.quats), dim=1),
        take_scene(predicted.scales),
        take_scene(predicted.opacities).clamp(max=1),
        # Degree 4 has coefficients that no renderer takes.
        take_scene(predicted.sh()[:, :, :MAX_COEFFICIENTS]),
    )
    # Opacity 0 marks the padding.
    kept = find_finite(whole) & (whole.opacities > 0)
    if not bool(kept.any()):
        raise InputError("The model of ffgs returned no visible Gaussian; choose another one.")
    return whole[kept]


def load_ffgs(variant: str, weights: Path | None = None, device: str = "cpu") -> PipelineGaussians:
    """Load FAMILY/VARIANT of the model zoo of ffgs, or a folder of its `save_pretrained`.

    Raises:
        InputError: The package is missing, or the model cannot be loaded.
    """
    place = choose_weights(weights, variant, "weights", "folder")
    title = f"The reconstructor '{PREFIX}{quote_value(variant)}'"
    ffgs = import_authors_module("ffgs", title, INSTALL, "reconstructor")
    try:
        pipeline = ffgs.GSPipeline.from_pretrained(place, device=device)
    except Exception as error:  # the hub, safetensors and the package have errors of their own
        raise InputError(
            f"ffgs did not load {quote_value(place)} ({type(error).__name__}: "
            f"{quote_value(str(error), 100)}); name FAMILY/VARIANT of its model zoo, or a folder.",
            "reconstructor" if weights is None else "weights",
        ) from error
    return PipelineGaussians(pipeline, ffgs.Views, device)
