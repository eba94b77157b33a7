"""Photographs as the networks take them: resized to whole patches, and normalised."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from gscompleter.reconstructors.feed_forward.dino import PATCH

MEAN = (0.485, 0.456, 0.406)
"""Mean colour of the images that the transformer was trained on."""
DEVIATION = (0.229, 0.224, 0.225)
"""Standard deviation of their colours."""

Image = UInt8[np.ndarray, "_ _ 3"]
Side = Literal["longer", "shorter"]
"""The side of a photograph that gets a certain length."""
Fit = Literal["resized", "cropped"]
"""How a photograph gets whole patches then."""


def normalised_images(images: UInt8[Tensor, "*n h w 3"]) -> Float[Tensor, "*n 3 h w"]:
    """Colours about their mean, channels first."""
    colours = images.float() / 255
    normed = (colours - colours.new_tensor(MEAN)) / colours.new_tensor(DEVIATION)
    return normed.movedim(-1, -3)


def scaled_to(image: Image, resolution: int, side: Side) -> Image:
    """`image` with a longer or shorter side of `resolution` pixels."""
    h, w = image.shape[:2]
    factor = resolution / (max(h, w) if side == "longer" else min(h, w))
    return resized_to(image, max(1, round(h * factor)), max(1, round(w * factor)))


def whole_patches(side: int, fit: Fit) -> int:
    """Pixels of whole patches that are resized from `side` pixels, as many as come nearest (of two
    numbers the larger), or cut out of them; one patch at least."""
    patches = (2 * side + PATCH) // (2 * PATCH) if fit == "resized" else side // PATCH
    return max(1, patches) * PATCH


def resized_to(image: Image, height: int, width: int) -> Image:
    """Bicubic where a side grows, else the mean over the area of each pixel."""
    h, w = image.shape[:2]
    if (h, w) == (height, width):
        return image
    grows = height > h or width > w
    how = cv2.INTER_CUBIC if grows else cv2.INTER_AREA
    return np.asarray(cv2.resize(image, (width, height), interpolation=how))
