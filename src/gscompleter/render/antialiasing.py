"""Gaussians that were made for classic rendering, in a scene that is rendered antialiased."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from gscompleter.geometry import z_depths
from gscompleter.render.reference import BLUR
from gscompleter.types import Camera, Gaussians


def in_mode_of(scene: Gaussians, made: Gaussians, camera: Camera) -> Gaussians:
    """Adapt new Gaussians to the mode that `scene` is rendered in.

    Classic rendering widens every splat by the low-pass and keeps its opacity. Antialiased
    rendering does not keep it, and opacities end at 1, so that the low-pass at `camera` becomes
    part of the Gaussians' own size: there they cover as much in total as they did.

    Args:
        scene: What they are added to.
        made: Gaussians for the pixels of `camera`, before it.
        camera: The camera that they were made for.
    """
    if made.is_antialiased or not scene.is_antialiased:
        return made
    pixel = z_depths(made.means, camera) * 2 / (camera.K[0, 0] + camera.K[1, 1])
    scales = torch.hypot(made.scales, math.sqrt(BLUR) * pixel[:, None])
    return replace(made, scales=scales, encoded=None, is_antialiased=True)
