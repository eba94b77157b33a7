"""Conversion of views to the inputs of the networks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gscompleter.models.feed_forward.cameras import Cameras
from gscompleter.reconstructors.features.depth_range import estimate_depth_range, get_depth_range
from gscompleter.system.errors import InputError
from gscompleter.types import Camera, DepthMap, View


@dataclass(frozen=True)
class Crop:
    """The part of an image that a network processes, in pixels."""

    top: int
    left: int
    height: int
    width: int

    @property
    def rows(self) -> slice:
        """The rows of the crop."""
        return slice(self.top, self.top + self.height)

    @property
    def columns(self) -> slice:
        """The columns of the crop."""
        return slice(self.left, self.left + self.width)

    def pad_depth(
        self, depth: Float[Tensor, "{self.height} {self.width}"], camera: Camera
    ) -> DepthMap:
        """Place the z-depth of the crop in the image of `camera`; pixels outside are invalid."""
        whole = depth.new_zeros(camera.height, camera.width)
        within = torch.zeros_like(whole, dtype=torch.bool)
        whole[self.rows, self.columns] = depth
        within[self.rows, self.columns] = True
        return DepthMap(whole, within)

    def compute_pixel_indices(self, width: int) -> Int[Tensor, "n"]:
        """Compute the row-major indices of the crop's pixels in an image of `width` columns."""
        rows = torch.arange(self.height)[:, None] + self.top
        return (rows * width + torch.arange(self.width) + self.left).flatten()


def compute_central_crops(cameras: Sequence[Camera], patch: int) -> list[Crop]:
    """Compute the largest central crops of one size for all images, in whole patches.

    Images are not resized, so a padded target is cropped to the size of the other views.
    """
    height = min(camera.height for camera in cameras)
    width = min(camera.width for camera in cameras)
    if height < patch or width < patch:
        raise InputError(
            f"All images have {height} x {width} pixels in common, and this model needs at "
            f"least {patch} x {patch}; use larger ones."
        )
    height = height // patch * patch
    width = width // patch * patch
    return [
        Crop((camera.height - height) // 2, (camera.width - width) // 2, height, width)
        for camera in cameras
    ]


def create_batch(
    views: Sequence[View], patch: int, depth_range: tuple[float, float] | None = None
) -> tuple[Float[Tensor, "1 v 3 h w"], Cameras, list[Crop]]:
    """Create a batch of one scene from the central crops of `views`.

    Side lengths are multiples of `patch`. Cameras without near and far get `depth_range` (scene
    units), or if that is None an estimate from matched features.

    Raises:
        InputError: Fewer than two views, an image below one patch, or an empty depth range.
    """
    if len(views) < 2:
        raise InputError(
            f"{len(views)} view was given, and the model matches at least 2; name more frames."
        )
    crops = compute_central_crops([view.camera for view in views], patch)
    pairs = list(zip(views, crops, strict=True))

    def fall_back(_: Sequence[View]) -> tuple[float, float]:
        return depth_range or estimate_depth_range(views)

    ranges = [get_depth_range([view], fall_back) for view in views]
    images = torch.stack([v.image[c.rows, c.columns].movedim(-1, 0) for v, c in pairs])
    cameras = Cameras(
        c2w=torch.stack([view.camera.c2w for view in views])[None].float(),
        K=torch.stack([crop_intrinsics(v.camera, c) for v, c in pairs])[None],
        near=images.new_tensor([[low for low, _ in ranges]]),
        far=images.new_tensor([[high for _, high in ranges]]),
    )
    return images[None], cameras, crops


def crop_intrinsics(camera: Camera, crop: Crop) -> Float[Tensor, "3 3"]:
    """Compute the intrinsics of the crop, in units of its width and height."""
    # The authors' loaders keep (cx, cy) as fractions, which is the same for a central principal
    # point and an even number of cropped pixels. Here the rest of the completion projects with the
    # exact camera, so the network gets it too; `AuthorsCrop` makes the authors' cameras for their
    # data sets, before the views come here.
    K = camera.K.float().clone()
    K[0, 2] -= crop.left
    K[1, 2] -= crop.top
    return K / K.new_tensor([crop.width, crop.height, 1])[:, None]
