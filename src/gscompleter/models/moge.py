"""MoGe-2 (Wang et al., 2025): metric depth of single photographs, in the authors' ONNX export.

Tested with tiny networks of the published signature. Not tested: published weights, and a GPU.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.optimize import least_squares

from gscompleter.models.onnx_network import ADVICE, OnnxNetwork, load_network
from gscompleter.models.weights.published import PUBLISHED
from gscompleter.system.errors import InputError
from gscompleter.types import Camera, DepthMap, View

SIGNATURE = {"image": ("tensor(float)", 3), "num_tokens": ("tensor(int64)", None)}
"""Inputs of the network: the type of each, and the channels of the one that is an image."""
NUM_OUTPUTS = 4
"""Points in the axes of the camera, normals, scores of the mask, and metres per unit of points."""
NUM_TOKENS = np.array(1800, np.int64)
"""Patches of the transformer per image, as in the authors' export; they train with 1200 to 3600."""
MIN_MASK = 0.5
"""Score from which a pixel has a depth; the sky has none."""
FIT_SIDE = 64
"""Rows and columns of pixels that the shift is fitted to."""


@dataclass(frozen=True)
class MoGe:
    """Metric depth of single views."""

    network: OnnxNetwork

    def __call__(self, view: View) -> DepthMap:
        """Predict z-depth in metres; raise InputError if the answer has another shape.

        The network gives points up to a shift along the optical axis, which the known focal length
        of the camera determines.
        """
        pixels = view.image.detach().cpu().float().permute(2, 0, 1)[None].contiguous().numpy()
        points, _, mask, scale = self.network(image=pixels, num_tokens=NUM_TOKENS)
        size = pixels.shape[2:]
        if points.shape != (1, *size, 3) or mask.shape != (1, *size) or scale.size != 1:
            raise InputError(
                f"The network answered an image of {size} by points of {points.shape}, a mask of "
                f"{mask.shape} and a scale of {scale.shape}; {ADVICE}."
            )
        valid = mask[0] >= MIN_MASK
        depth = scale.item() * (points[0, ..., 2] + fit_shift(points[0], valid, view.camera))
        valid &= np.isfinite(depth) & (depth > 0)
        # Invalid pixels get any positive depth, which nobody reads.
        filled = torch.from_numpy(np.where(valid, depth, 1).astype(np.float32))
        device = view.image.device
        return DepthMap(filled.to(device), torch.from_numpy(valid).to(device))


def fit_shift(
    points: Float[ndarray, "h w 3"], valid: Bool[ndarray, "h w"], camera: Camera
) -> float:
    """Fit the shift along z, in the unit of the points, after which they project to their pixels.

    `points` are in the axes of the camera, and `valid` are those that have a depth. It is NaN where
    fewer than two points tell it: their depths are then unknown, and 0 would pass for a
    measurement.
    """
    h, w = valid.shape
    # A grid of some pixels is enough for one number. A small image has fewer than that.
    rows = np.unique(np.linspace(0, h - 1, FIT_SIDE).round().astype(int))
    columns = np.unique(np.linspace(0, w - 1, FIT_SIDE).round().astype(int))
    points = points[np.ix_(rows, columns)].astype(np.float64)
    used = valid[np.ix_(rows, columns)] & np.isfinite(points).all(axis=-1) & (points[..., 2] > 0)
    if used.sum() < 2:
        return math.nan

    # The network assumes a central principal point: rays at z = 1 from the middle of the image.
    fx = camera.K[0, 0].item()
    fy = camera.K[1, 1].item()
    x = (columns + 0.5 - w / 2) / fx
    y = (rows + 0.5 - h / 2) / fy
    rays = np.stack(np.meshgrid(x, y), axis=-1)[used]
    used_points = points[used]

    def miss(shift: Float[ndarray, "1"]) -> Float[ndarray, "n"]:
        return (used_points[:, :2] / (used_points[:, 2:] + shift) - rays).ravel()

    return float(least_squares(miss, 0.0, ftol=1e-3, method="lm").x[0])


def load_moge(name: str, weights: Path | None = None, device: str = "cpu") -> MoGe:
    """Load a published size, or a file; raises the errors of `load_network`."""
    network = load_network(
        PUBLISHED[name], SIGNATURE, weights, device, "depth_weights", NUM_OUTPUTS
    )
    return MoGe(network)
