"""Extrapolation of sky into holes that continue its colour (not in the paper)."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gscompleter.geometry import compute_z_depths, move_to_depths
from gscompleter.sky import compute_sky_depth, is_sky
from gscompleter.types import DepthMap, Gaussians, View

MAX_COLOR_DIFFERENCE = 0.1
"""Largest colour difference per channel between the hole and the nearest sky."""


def extrapolate_sky(
    candidates: Gaussians, pixel_index: Int[Tensor, "n"], scene: DepthMap, reference: View
) -> Gaussians:
    """Move Gaussians of holes that continue the sky to its depth.

    `scene` is the depth at the target; its invalid pixels are holes.
    """
    camera = reference.camera
    sky = scene.valid & is_sky(scene.depth, camera)
    if not sky.any():
        return candidates
    continued = find_sky_continuation(sky, scene.valid, reference.image).flatten()[pixel_index]
    depths = compute_z_depths(candidates.means, camera)
    return move_to_depths(candidates, camera, depths.where(~continued, compute_sky_depth(camera)))


def find_sky_continuation(
    sky: Bool[Tensor, "h w"], known: Bool[Tensor, "h w"], image: Float[Tensor, "h w 3"]
) -> Bool[Tensor, "h w"]:
    """Find hole pixels whose nearest known pixel is sky of a similar colour."""
    _, labels = cv2.distanceTransformWithLabels(
        (~known).cpu().numpy().astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    label = torch.from_numpy(labels).long().to(known.device)
    pixel = torch.zeros(int(label.max()) + 1, dtype=torch.long, device=known.device)
    at = torch.nonzero(known.flatten())[:, 0]
    pixel[label.flatten()[at]] = at
    nearest = pixel[label]
    colours = image.reshape(-1, 3)[nearest]
    like = (image - colours).abs().amax(dim=-1) < MAX_COLOR_DIFFERENCE
    return ~known & sky.flatten()[nearest] & like
