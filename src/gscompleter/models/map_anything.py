"""MapAnything (Keetha et al., 2025) as Ψ: joint depth of posed photographs, by its own package."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gscompleter.models.depth_anything.alignment import fit_robust_similarity
from gscompleter.models.depth_anything.inputs import ResizeConfig, create_any_view_batch
from gscompleter.models.depth_anything.reconstructor import (
    normalize_confidence,
    resample_depth_maps,
)
from gscompleter.reconstructors.from_depth import FromDepth
from gscompleter.system.errors import InputError, quote_value
from gscompleter.types import DepthMap, View

PUBLISHED = "facebook/map-anything-apache"
"""Repository of the weights that allow commercial use (Apache-2.0)."""
INSTALL = "pip install git+https://github.com/facebookresearch/map-anything"
SIZING = ResizeConfig(resolution=518)
"""Size of the images in training, in multiples of 14 pixels."""


@dataclass(frozen=True)
class MapAnythingDepth:
    """Depth of several views, scaled from predicted to given camera distances."""

    model: Any
    """The model of the package, on `device`."""
    device: str = "cpu"

    def __call__(self, views: Sequence[View]) -> list[DepthMap]:
        """Predict z-depths and confidence, invalid where the model sees no surface.

        Raises:
            InputError: Fewer than two views, or all at one position.
        """
        batch = create_any_view_batch(views, SIZING, min_views=2)
        cameras = zip(batch.images[0], batch.poses.K[0], batch.poses.c2w[0], strict=True)
        inputs = [
            {
                "img": image[None].to(self.device),
                "data_norm_type": ["dinov2"],
                "intrinsics": K[None].to(self.device),
                "camera_poses": c2w[None].to(self.device),
                "is_metric_scale": torch.zeros(1, dtype=torch.bool, device=self.device),
            }
            for image, K, c2w in cameras
        ]
        with torch.no_grad():
            predictions = self.model.infer(inputs, use_amp=self.device == "cuda", apply_mask=False)

        def join(name: str) -> Tensor:
            return torch.cat([prediction[name] for prediction in predictions]).float().cpu()

        depth = join("depth_z")
        raw_confidence = join("conf")
        solid = join("non_ambiguous_mask")

        # The answer has a unit of its own, which its cameras share with its depths.
        given_centers = batch.poses.c2w[0][:, :3, 3].double().numpy()
        predicted_centers = join("camera_poses")[:, :3, 3].double().numpy()
        scale = fit_robust_similarity(given_centers, predicted_centers).scale
        confidence = normalize_confidence(raw_confidence) * solid.view_as(raw_confidence)
        # `depth_z` has the shape [v, h, w, 1].
        return resample_depth_maps(depth[..., 0] / scale, confidence, batch, views)


def load_map_anything(weights: Path | None = None, device: str = "cpu") -> FromDepth:
    """Load the published weights, or those of a folder, through the package `mapanything`.

    Raises:
        InputError: The package is missing, or the weights cannot be loaded.
    """
    if find_spec("mapanything") is None:
        raise InputError(f"The reconstructor 'mapanything' needs its package: {INSTALL}.")
    from mapanything.models import MapAnything

    place = PUBLISHED if weights is None else str(weights)
    try:
        model = MapAnything.from_pretrained(place)
    except Exception as error:  # the hub, safetensors and the package have errors of their own
        raise InputError(
            f"MapAnything was not loaded from {quote_value(weights or PUBLISHED)} "
            f"({type(error).__name__}); name a folder that holds its config.json and "
            "model.safetensors."
        ) from error
    return FromDepth(model=MapAnythingDepth(model.to(device).eval(), device))
