"""Depth maps as images: viridis over the logarithm of z-depth, grey without depth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from gscompleter.io.files import replacing
from gscompleter.io.image import COMPRESSION
from gscompleter.types import DepthMap

NONE = (128, 128, 128)
TAIL = 0.01
"""Fraction of the depths at either end that the colours do not resolve."""


def colours() -> UInt8[np.ndarray, "256 3"]:
    """Make the palette: grey for no depth, then viridis from near to far."""
    steps = np.linspace(0, 255, 255).round().astype(np.uint8)
    viridis = cv2.applyColorMap(steps, cv2.COLORMAP_VIRIDIS).reshape(-1, 3)[:, ::-1]
    return np.concatenate([np.array([NONE], np.uint8), viridis])


def limits_of(maps: Sequence[DepthMap]) -> tuple[float, float] | None:
    """Compute the nearest and farthest depth of the colours, or None without any depth."""
    known = np.concatenate([depths_of(m)[is_known(m)] for m in maps])
    if len(known) == 0:
        return None
    near, far = np.quantile(known, [TAIL, 1 - TAIL]).tolist()
    return near, max(far, 1.001 * near)


def write_depth(path: Path, depth: DepthMap, limits: tuple[float, float]) -> None:
    """Write a depth map as a palette PNG with colours between `limits`."""
    near, far = np.log(limits)
    known = is_known(depth)
    place = (np.log(depths_of(depth), where=known, out=np.zeros(known.shape)) - near) / (far - near)
    indices = np.where(known, 1 + np.rint(254 * place.clip(0, 1)), 0).astype(np.uint8)
    image = Image.fromarray(indices)
    image.putpalette(colours().tobytes())
    with replacing(path) as file:
        image.save(file, format="PNG", compress_level=COMPRESSION)


def depths_of(depth: DepthMap) -> np.ndarray:
    """Copy z-depths [h, w] to the CPU."""
    return depth.depth.detach().cpu().double().numpy()


def is_known(depth: DepthMap) -> np.ndarray:
    """Compute the mask [h, w] of pixels with a depth."""
    finite = torch.isfinite(depth.depth) & (depth.depth > 0)
    return (depth.valid & finite).cpu().numpy()
