"""Sparse z-depth from laser points."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.geometry import is_inside, project
from gscompleter.types import Camera


def compute_sparse_depth(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "h w"]:
    """Project points to z-depth in scene units: the nearest per pixel, 0 without one.

    Points behind an unmeasured surface remain visible.
    """
    pixels, z = project(points, camera)
    seen = is_inside(pixels, z, camera)
    x, y = pixels[seen].long().unbind(-1)
    nearest = torch.full((camera.height * camera.width,), torch.inf)
    nearest = nearest.scatter_reduce(0, y * camera.width + x, z[seen], "amin")
    return nearest.where(nearest.isfinite(), 0.0).view(camera.height, camera.width)
