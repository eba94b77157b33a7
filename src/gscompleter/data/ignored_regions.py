"""Regions that are the same in all photographs, such as the bonnet of a car, and do not count."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from gscompleter.system.files.image import read_mask

Polygon = tuple[tuple[float, float], ...]
"""Corners (x, y) from the upper left of a photograph, as shares of its width and height."""


@dataclass(frozen=True)
class IgnoredRegions:
    """Regions of every photograph that are ignored like what masks hide."""

    polygons: tuple[Polygon, ...] = ()
    mask: Path | None = None
    """Image whose black pixels are ignored, of any size."""

    def draw(self, width: int, height: int) -> Bool[np.ndarray, "h w"]:
        """Return True where a photograph of this size is ignored; raises as `read_mask`."""
        ignored = np.zeros((height, width), np.uint8)
        for polygon in self.polygons:
            # Centres of pixels have whole coordinates here.
            corners = np.array(polygon) * [width, height] - 0.5
            cv2.fillPoly(ignored, [corners.round().astype(np.int32)], 1)
        if self.mask is not None:
            black = read_mask(self.mask).astype(np.uint8)
            resized = cv2.resize(black, (width, height), interpolation=cv2.INTER_NEAREST)
            return (ignored > 0) | (np.asarray(resized) > 0)
        return ignored > 0
