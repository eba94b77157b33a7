"""Depth maps as images: viridis over the logarithm of z-depth, grey without depth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from gscompleter.io.files import replace_file
from gscompleter.io.image import PNG_COMPRESSION
from gscompleter.types import DepthMap

NO_DEPTH_COLOR = (128, 128, 128)
TAIL_FRACTION = 0.01
"""Fraction of the depths at either end that the colours do not resolve."""


def make_palette() -> UInt8[np.ndarray, "256 3"]:
    """Make the palette: grey for no depth, then viridis from near to far."""
    steps = np.linspace(0, 255, 255).round().astype(np.uint8)
    viridis = cv2.applyColorMap(steps, cv2.COLORMAP_VIRIDIS).reshape(-1, 3)[:, ::-1]
    return np.concatenate([np.array([NO_DEPTH_COLOR], np.uint8), viridis])


def compute_depth_limits(maps: Sequence[DepthMap]) -> tuple[float, float] | None:
    """Compute the nearest and farthest depth of the colours, or None without any depth."""
    known = np.concatenate([copy_depths(m)[compute_known_mask(m)] for m in maps])
    if len(known) == 0:
        return None
    near, far = np.quantile(known, [TAIL_FRACTION, 1 - TAIL_FRACTION]).tolist()
    return near, max(far, 1.001 * near)


def write_depth_image(path: Path, depth: DepthMap, limits: tuple[float, float]) -> None:
    """Write a depth map as a palette PNG with colours between `limits`."""
    near, far = np.log(limits)
    known = compute_known_mask(depth)
    place = (np.log(copy_depths(depth), where=known, out=np.zeros(known.shape)) - near) / (
        far - near
    )
    indices = np.where(known, 1 + np.rint(254 * place.clip(0, 1)), 0).astype(np.uint8)
    image = Image.fromarray(indices)
    image.putpalette(make_palette().tobytes())
    with replace_file(path) as file:
        image.save(file, format="PNG", compress_level=PNG_COMPRESSION)


def copy_depths(depth: DepthMap) -> np.ndarray:
    """Copy z-depths [h, w] to the CPU."""
    return depth.depth.detach().cpu().double().numpy()


def compute_known_mask(depth: DepthMap) -> np.ndarray:
    """Compute the mask [h, w] of pixels with a depth."""
    finite = torch.isfinite(depth.depth) & (depth.depth > 0)
    return (depth.valid & finite).cpu().numpy()
