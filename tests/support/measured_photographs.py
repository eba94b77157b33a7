"""What sensors measured beside photographs, for tests of the formats that hold it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.data.given_depth import give_depth
from gscompleter.data.moving_boxes import mask_moving
from gscompleter.data.photographs import Photographs, Resolution
from gscompleter.types import View


def give_depths(
    photographs: Photographs, frames: Sequence[int], resolution: Resolution = None
) -> list[View]:
    """Load photographs whose measured depth constrains the reconstruction and scores nothing."""
    views = photographs.views(frames, resolution)
    return [
        give_depth(view, photographs.frame(number), photographs.origin)
        for view, number in zip(views, frames, strict=True)
    ]


def find_moving(
    photographs: Photographs, frame: int, resolution: Resolution = None
) -> Bool[Tensor, "h w"] | None:
    """Return True where a photograph shows a moving box, or None without boxes."""
    boxes = photographs.frame(frame).boxes
    if boxes is None:
        return None
    camera = photographs.camera(frame, resolution)
    return torch.from_numpy(mask_moving(boxes(), camera, photographs.origin))
