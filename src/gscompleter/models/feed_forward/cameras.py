"""Batches of cameras in the form that the networks expect, and choice of source views."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Cameras:
    """The cameras of b scenes with v views each, with depth ranges in scene units."""

    c2w: Float[Tensor, "b v 4 4"]
    K: Float[Tensor, "b v 3 3"]
    """Normalised intrinsics: the first row in image widths, the second in image heights."""
    near: Float[Tensor, "b v"]
    far: Float[Tensor, "b v"]

    def to(self, device: torch.device | str) -> Cameras:
        """Move all tensors to `device`."""
        return Cameras(
            self.c2w.to(device), self.K.to(device), self.near.to(device), self.far.to(device)
        )

    def compute_inverse_range(self) -> tuple[Float[Tensor, "n 1 1 1"], Float[Tensor, "n 1 1 1"]]:
        """Return the smallest and largest inverse depth of all n = b v views."""
        return (1 / self.far).reshape(-1, 1, 1, 1), (1 / self.near).reshape(-1, 1, 1, 1)

    def scale_intrinsics(self, height: int, width: int) -> Float[Tensor, "b v 3 3"]:
        """Convert the intrinsics to pixels of maps of `height` x `width`."""
        return self.K * self.K.new_tensor([width, height, 1])[:, None]

    def compute_sources_from_views(
        self, sources: Int[Tensor, "b v s"]
    ) -> Float[Tensor, "b v s 4 4"]:
        """Compute the transforms from the axes of each view to those of its sources."""
        with disable_autocast(self.c2w):
            return torch.linalg.inv(select_sources(self.c2w, sources)) @ self.c2w[:, :, None]


def disable_autocast(like: Tensor) -> torch.autocast:
    """Disable autocast on the device of `like`, so that geometry stays in float32."""
    return torch.autocast(like.device.type, enabled=False)


def select_sources(
    values: Float[Tensor, "b v *shape"], sources: Int[Tensor, "b w s"]
) -> Float[Tensor, "b w s *shape"]:
    """Select the values of the source views of each view."""
    return values[torch.arange(len(values), device=values.device)[:, None, None], sources]


def list_other_views(scenes: int, views: int, device: torch.device) -> Int[Tensor, "b v s"]:
    """List all other views for each of two or more `views`, in ascending order."""
    others = [[j for j in range(views) if j != i] for i in range(views)]
    return torch.tensor(others, device=device).expand(scenes, -1, -1)


def find_nearest_views(cameras: Cameras, count: int) -> Int[Tensor, "b v s"]:
    """Find the `count` nearest other views of each view by their centres, the nearest first."""
    centers = cameras.c2w[..., :3, 3]
    # Relative to their middle: distances between them would cancel far from the origin.
    centers = centers - centers.mean(dim=-2, keepdim=True)
    distances = torch.cdist(centers, centers)
    # Each view comes first of its own row, also before others at its position, and is left out.
    distances.diagonal(dim1=-2, dim2=-1).fill_(-1)
    return distances.argsort(-1)[..., 1 : count + 1]
