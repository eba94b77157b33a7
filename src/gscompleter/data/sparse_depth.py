"""Sparse z-depth: what a laser measured, at the pixels of a camera."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.geometry import inside, project
from gscompleter.types import Camera


def sparse_depth(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "h w"]:
    """z-depth, in scene units, of the points that fall into each pixel; 0 where none does.

    The nearest of several wins. A point that only a surface between two measured ones hides stays.
    """
    pixels, z = project(points, camera)
    seen = inside(pixels, z, camera)
    x, y = pixels[seen].long().unbind(-1)
    nearest = torch.full((camera.height * camera.width,), torch.inf)
    nearest = nearest.scatter_reduce(0, y * camera.width + x, z[seen], "amin")
    return nearest.where(nearest.isfinite(), 0.0).view(camera.height, camera.width)
