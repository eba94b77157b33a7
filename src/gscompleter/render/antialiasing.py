"""Gaussians made for classic rendering, in a scene that is rendered antialiased."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from gscompleter.geometry import compute_z_depths
from gscompleter.render.reference import BLUR
from gscompleter.types import Camera, Gaussians


def adapt_to_mode(scene: Gaussians, gaussians: Gaussians, camera: Camera) -> Gaussians:
    """Adapt Gaussians made for the pixels of `camera` to the rendering mode of `scene`.

    Classic rendering widens each splat by the low-pass and keeps its opacity; antialiased rendering
    lowers it. So the low-pass becomes part of the Gaussians' own size, with the same total
    coverage.
    """
    if gaussians.is_antialiased or not scene.is_antialiased:
        return gaussians
    pixel = compute_z_depths(gaussians.means, camera) * 2 / (camera.K[0, 0] + camera.K[1, 1])
    scales = torch.hypot(gaussians.scales, math.sqrt(BLUR) * pixel[:, None])
    return replace(gaussians, scales=scales, encoded=None, is_antialiased=True)
