"""Resizing and normalisation of photographs for the networks."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from gscompleter.models.feed_forward.cnn import normalize_images
from gscompleter.models.feed_forward.dino import PATCH

Image = UInt8[np.ndarray, "_ _ 3"]
Side = Literal["longer", "shorter"]
"""Side of a photograph that is scaled to a given length."""
Fit = Literal["resized", "cropped"]
"""Method to obtain whole patches."""


def normalize_colors(images: UInt8[Tensor, "*n h w 3"]) -> Float[Tensor, "*n 3 h w"]:
    """Move channels first, and normalise colours as for networks trained on ImageNet."""
    return normalize_images(images.movedim(-1, -3).float() / 255)


def scale_side(image: Image, resolution: int, side: Side) -> Image:
    """Scale an image as a whole, so that its longer or shorter side has `resolution` pixels."""
    h, w = image.shape[:2]
    factor = resolution / (max(h, w) if side == "longer" else min(h, w))
    return resize_photograph(image, max(1, round(h * factor)), max(1, round(w * factor)))


def round_to_patches(side: int, fit: Fit) -> int:
    """Round `side` to whole patches: to the nearest if resized (ties up), down if cropped."""
    patches = (2 * side + PATCH) // (2 * PATCH) if fit == "resized" else side // PATCH
    return max(1, patches) * PATCH


def resize_photograph(image: Image, height: int, width: int) -> Image:
    """Resize an image: bicubically if a side grows, and else by averages over areas."""
    h, w = image.shape[:2]
    if (h, w) == (height, width):
        return image
    grows = height > h or width > w
    how = cv2.INTER_CUBIC if grows else cv2.INTER_AREA
    return np.asarray(cv2.resize(image, (width, height), interpolation=how))
