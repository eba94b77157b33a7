"""Whether a splat is an object on nothing, around which nothing is missing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import add_near_plane
from gscompleter.render.lod import MAX_PREVIEW_GAUSSIANS, thin_gaussians
from gscompleter.render.protocols import Renderer
from gscompleter.types import Camera, Gaussians

WIDE = 100.0
"""Field of view, in degrees, at which the border of an image shows what is around."""
SIDE = 48
"""Width and height of these images, in pixels."""
MAX_BORDER = 0.27
"""Largest share of the border that an object covers. It was 0.02 to 0.20 for four objects, and 0.44
to 0.61 for three trained scenes."""


def is_object(scene: Gaussians, cameras: Sequence[Camera], renderer: Renderer) -> bool:
    """Tell an object from a scene: from cameras, little is seen at the border of a wide image."""
    small = thin_gaussians(scene, MAX_PREVIEW_GAUSSIANS)
    shares = [measure_border(small, camera, renderer) for camera in cameras]
    return sum(shares) / len(shares) < MAX_BORDER


def measure_border(scene: Gaussians, camera: Camera, renderer: Renderer) -> float:
    """Measure the share of the border of a wide image that is covered."""
    focal = SIDE / 2 / math.tan(math.radians(WIDE) / 2)
    K = torch.tensor([[focal, 0.0, SIDE / 2], [0.0, focal, SIDE / 2], [0.0, 0.0, 1.0]])
    wide = replace(camera, K=K.to(camera.K), width=SIDE, height=SIDE)
    covered = renderer.render(scene, add_near_plane(wide, scene.means)).alpha >= COVERED
    border = torch.cat([covered[0], covered[-1], covered[:, 0], covered[:, -1]])
    return border.float().mean().item()
