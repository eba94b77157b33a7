"""Models of the package `ffgs` (libgs, 2026) as Ψ: one interface for feed-forward 3DGS.

The calls follow its source, version 0.1.0.dev1. Tested with a stand-in of the same interface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch.nn.functional import normalize

from gscompleter.models.feed_forward.inputs import compute_central_crops
from gscompleter.models.feed_forward.reconstructor import MAX_COEFFICIENTS
from gscompleter.models.packages import choose_weights, import_authors_module
from gscompleter.render.loading import load_renderer
from gscompleter.system.errors import InputError, quote_value
from gscompleter.types import Gaussians, Reconstruction, View, make_observed

INSTALL = "pip install --pre ffgs"
PREFIX = "ffgs:"


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
        # A padded target is cropped to what all images have. Its rays stay those of the view, as
        # the principal point moves with the crop.
        crops = compute_central_crops([view.camera for view in views], patch=1)
        pairs = list(zip(views, crops, strict=True))
        # Channels first, and K in pixels of these images.
        images = torch.stack([v.image[c.rows, c.columns].permute(2, 0, 1) for v, c in pairs])
        offsets = torch.tensor([[float(c.left), float(c.top)] for c in crops])
        Ks = torch.stack([view.camera.K for view in views]).float()
        Ks[:, :2, 2] -= offsets.to(Ks)
        c2w = torch.stack([view.camera.c2w for view in views]).float()
        given = self.make_views(
            images.float().to(self.device), Ks.to(self.device), c2w.to(self.device)
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
    """Convert the Gaussians of the first scene of a batch [1, n, ...]; padding is left out."""
    # `sh` is [1, n, k, 3] in the 3DGS basis. Degree 4 has coefficients that no renderer takes.
    sh = predicted.sh()[0, :, :MAX_COEFFICIENTS]
    parts = [predicted.means[0], predicted.quats[0], predicted.scales[0], predicted.opacities[0]]
    means, quats, scales, opacities = (part.detach().float() for part in parts)
    finite = [part.isfinite().flatten(1).all(dim=1) for part in (means, quats, scales, sh)]
    # Opacity 0 marks the padding of a batch.
    kept = torch.stack(finite).all(dim=0) & (opacities > 0)
    if not bool(kept.any()):
        raise InputError("The model of ffgs returned no visible Gaussian; choose another one.")
    return make_observed(
        means[kept].contiguous(),
        normalize(quats[kept], dim=1),
        scales[kept].contiguous(),
        opacities[kept].clamp(0, 1).contiguous(),
        sh.detach().float()[kept].contiguous(),
    )


def load_ffgs(variant: str, weights: Path | None = None, device: str = "cpu") -> PipelineGaussians:
    """Load FAMILY/VARIANT of the model zoo of ffgs, or a folder of its `save_pretrained`.

    Raises:
        InputError: The package is missing, or the model cannot be loaded.
    """
    place = choose_weights(weights, variant, "weights")
    title = f"The reconstructor '{PREFIX}{quote_value(variant)}'"
    ffgs = import_authors_module("ffgs", title, INSTALL, "reconstructor")
    try:
        pipeline = ffgs.GSPipeline.from_pretrained(place, device=device)
    except Exception as error:  # the hub, safetensors and the package have errors of their own
        raise InputError(
            f"ffgs did not load {quote_value(place)} ({type(error).__name__}: "
            f"{quote_value(str(error), 100)}); name FAMILY/VARIANT of its model zoo, or a folder.",
            "reconstructor",
        ) from error
    return PipelineGaussians(pipeline, ffgs.Views, device)
