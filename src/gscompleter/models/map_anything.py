"""MapAnything (Keetha et al., 2025) as Ψ: joint depth of posed photographs, by its own package.

The calls follow its source; tested with a stand-in of the same interface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
from gscompleter.models.packages import choose_weights, import_authors_module
from gscompleter.reconstructors.from_depth import FromDepth
from gscompleter.system.errors import InputError, quote_value
from gscompleter.types import DepthMap, View

PUBLISHED = "facebook/map-anything-apache"
"""Repository of the weights that allow commercial use (Apache-2.0)."""
INSTALL = "pip install git+https://github.com/facebookresearch/map-anything"
SIZING = ResizeConfig(resolution=518)
"""As in training: the longer side has 518 pixels, and the other a multiple of 14."""


@dataclass(frozen=True)
class MapAnythingDepth:
    """Depth of several views, in the unit of their cameras."""

    model: Any
    """A `MapAnything` of the package, on `device`."""
    device: str = "cpu"

    def __call__(self, views: Sequence[View]) -> list[DepthMap]:
        """Predict z-depths and confidence of each view, invalid where the model sees no surface.

        Depths are scaled by the distances between the given cameras, relative to those between the
        cameras that the model predicts.

        Raises:
            InputError: Fewer than two views, or all at one position, given or predicted.
        """
        batch = create_any_view_batch(views, SIZING, min_views=2)
        cameras = zip(batch.images[0], batch.poses.K[0], batch.poses.c2w[0], strict=True)
        # One dictionary for each view, in a batch of one; poses are camera-to-world in OpenCV axes.
        inputs = [
            {
                "img": image[None].to(self.device),
                # Colours of the batch are normalised as DINOv2 takes them.
                "data_norm_type": ["dinov2"],
                "intrinsics": K[None].to(self.device),
                "camera_poses": c2w[None].to(self.device),
                # Given cameras have any unit.
                "is_metric_scale": torch.zeros(1, dtype=torch.bool, device=self.device),
            }
            for image, K, c2w in cameras
        ]
        with torch.no_grad():
            # Its own mask would also set depths at edges to 0.
            predictions = self.model.infer(inputs, use_amp=self.device == "cuda", apply_mask=False)

        def join(name: str) -> Tensor:
            return torch.cat([prediction[name] for prediction in predictions]).float().cpu()

        depth = join("depth_z")[..., 0]  # [v, h, w, 1] before
        # 1 where there is a surface, and 0 in the sky [v, h, w].
        solid = join("non_ambiguous_mask")
        confidence = normalize_confidence(join("conf")) * solid

        # The answer has a unit of its own, which its cameras share with its depths.
        given_centers = batch.poses.c2w[0][:, :3, 3].double().numpy()
        predicted_centers = join("camera_poses")[:, :3, 3].double().numpy()
        scale = fit_robust_similarity(given_centers, predicted_centers).scale
        return resample_depth_maps(depth / scale, confidence, batch, views)


def load_map_anything(weights: Path | None = None, device: str = "cpu") -> FromDepth:
    """Load the published weights, or those of a folder, through the package `mapanything`.

    Raises:
        InputError: The package is missing, or the weights cannot be loaded.
    """
    place = choose_weights(weights, PUBLISHED, "weights", "folder")
    title = "The reconstructor 'mapanything'"
    package = import_authors_module("mapanything.models", title, INSTALL, "reconstructor")
    try:
        model = package.MapAnything.from_pretrained(place)
    except Exception as error:  # the hub, safetensors and the package have errors of their own
        raise InputError(
            f"MapAnything was not loaded from {quote_value(weights or PUBLISHED)} "
            f"({type(error).__name__}); name a folder that holds its config.json and "
            "model.safetensors.",
            "weights",
        ) from error
    return FromDepth(model=MapAnythingDepth(model.to(device).eval(), device))
