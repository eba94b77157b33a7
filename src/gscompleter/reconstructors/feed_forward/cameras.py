"""Cameras in batches, as the networks take them, and which views look at which."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Cameras:
    """The cameras of b scenes with v views each."""

    c2w: Float[Tensor, "b v 4 4"]
    """Camera-to-world transforms with OpenCV axes."""
    K: Float[Tensor, "b v 3 3"]
    """Normalised intrinsics: the first row in image widths, the second in image heights."""
    near: Float[Tensor, "b v"]
    """Smallest z-depth, in scene units."""
    far: Float[Tensor, "b v"]
    """Largest z-depth, in scene units."""

    def to(self, device: torch.device | str) -> Cameras:
        return Cameras(
            self.c2w.to(device), self.K.to(device), self.near.to(device), self.far.to(device)
        )

    def inverse_range(self) -> tuple[Float[Tensor, "n 1 1 1"], Float[Tensor, "n 1 1 1"]]:
        """Smallest and largest inverse depth of all n = b v views."""
        return (1 / self.far).reshape(-1, 1, 1, 1), (1 / self.near).reshape(-1, 1, 1, 1)

    def intrinsics(self, height: int, width: int) -> Float[Tensor, "b v 3 3"]:
        """Intrinsics in the pixels of maps of `height` x `width`."""
        return self.K * self.K.new_tensor([width, height, 1])[:, None]

    def sources_from_views(self, sources: Int[Tensor, "b v s"]) -> Float[Tensor, "b v s 4 4"]:
        """From the axes of each view to those of its sources."""
        with full_precision(self.c2w):
            return torch.linalg.inv(select(self.c2w, sources)) @ self.c2w[:, :, None]


def full_precision(like: Tensor) -> torch.autocast:
    """Within it, geometry on the device of `like` is computed in float32 under any autocast."""
    return torch.autocast(like.device.type, enabled=False)


def select(
    values: Float[Tensor, "b v *shape"], sources: Int[Tensor, "b w s"]
) -> Float[Tensor, "b w s *shape"]:
    """What belongs to the sources of each view."""
    return values[torch.arange(len(values), device=values.device)[:, None, None], sources]


def other_views(scenes: int, views: int, device: torch.device) -> Int[Tensor, "b v s"]:
    """For each view all others, in ascending order."""
    others = [[j for j in range(views) if j != i] for i in range(views)]
    return torch.tensor(others, device=device).expand(scenes, -1, -1)


def nearest_views(cameras: Cameras, count: int) -> Int[Tensor, "b v s"]:
    """For each view the `count` others that were taken closest to it, the closest first.

    The first of all, which is dropped, is the view itself as long as no two views share a place.
    """
    centers = cameras.c2w[..., :3, 3]
    return torch.cdist(centers, centers).argsort(-1)[..., 1 : count + 1]
