"""Registration of pixels in holes, where nothing can be compared (not in the paper).

A hole is lifted in the same stereo pair as the pixels around it, so that its depth has the same
error. The sky is continued by colour, since no stereo measures it.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gscompleter.numerics.geometry import compute_z_depths, move_to_depths
from gscompleter.numerics.image_ops import fill_smoothly
from gscompleter.numerics.sky import compute_sky_depth, is_sky
from gscompleter.types import Camera, DepthMap, Gaussians, View

MAX_DEPTH_ERROR = 0.02
"""Largest relative depth error of a pixel whose correction is extrapolated into holes."""
MAX_COLOR_DIFFERENCE = 0.1
"""Largest colour difference per channel between a hole and the sky that is extrapolated."""


def extrapolate_into_holes(
    coarse: Gaussians,
    registered: Gaussians,
    pixels: Int[Tensor, "n"],
    scene: DepthMap,
    camera: Camera,
) -> Float[Tensor, "h w"]:
    """Compute the correction d' / d of each pixel; well registered ones are extrapolated smoothly.

    `pixels` are those of the Gaussians, where `scene` is valid; it is extrapolated elsewhere.
    """
    # Corrections are factors, so that their logarithms are interpolated.
    depths = compute_z_depths(registered.means, camera)
    correction = torch.zeros_like(scene.depth).flatten()
    correction[pixels] = (depths / compute_z_depths(coarse.means, camera)).log()

    # A Gaussian that did not reach the scene's depth is stuck, and says nothing about its
    # neighbours.
    error = (depths / scene.depth.flatten()[pixels].clamp_min(1e-12) - 1).abs()
    is_registered = torch.zeros_like(scene.valid).flatten()
    is_registered[pixels] = error < MAX_DEPTH_ERROR

    correction = correction.view_as(scene.depth)
    extrapolated = fill_smoothly(correction, is_registered.view_as(scene.valid))
    return torch.where(scene.valid, correction, extrapolated).exp()


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
    continues_sky = find_sky_continuation(sky, scene.valid, reference.image).flatten()[pixel_index]
    depths = compute_z_depths(candidates.means, camera)
    depths = depths.where(~continues_sky, compute_sky_depth(camera))
    return move_to_depths(candidates, camera, depths)


def find_sky_continuation(
    sky: Bool[Tensor, "h w"], known: Bool[Tensor, "h w"], image: Float[Tensor, "h w 3"]
) -> Bool[Tensor, "h w"]:
    """Find hole pixels whose nearest known pixel is sky of a similar colour."""
    # OpenCV gives each known pixel a label of its own, and each hole pixel that of the nearest one.
    _, labels = cv2.distanceTransformWithLabels(
        (~known).cpu().numpy().astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    label = torch.from_numpy(labels).long().to(known.device)

    # Labels are in no documented order: look up which pixel has each of them.
    known_pixels = torch.nonzero(known.flatten())[:, 0]
    pixel_of_label = torch.zeros(int(label.max()) + 1, dtype=torch.long, device=known.device)
    pixel_of_label[label.flatten()[known_pixels]] = known_pixels
    nearest = pixel_of_label[label]

    difference = (image - image.reshape(-1, 3)[nearest]).abs().amax(dim=-1)
    return ~known & sky.flatten()[nearest] & (difference < MAX_COLOR_DIFFERENCE)
