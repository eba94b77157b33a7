"""From views to what the networks take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.matching.depth_range import depth_range_of
from gscompleter.reconstructors.feed_forward.cameras import Cameras
from gscompleter.types import Camera, DepthMap, View


@dataclass(frozen=True)
class Crop:
    """The window of an image that a network sees."""

    top: int
    left: int
    height: int
    width: int

    @property
    def rows(self) -> slice:
        return slice(self.top, self.top + self.height)

    @property
    def columns(self) -> slice:
        return slice(self.left, self.left + self.width)

    def padded(
        self, depth: Float[Tensor, "{self.height} {self.width}"], camera: Camera
    ) -> DepthMap:
        """z-depth of the window in the whole image of `camera`, and where that is; 0 outside."""
        whole = depth.new_zeros(camera.height, camera.width)
        within = torch.zeros_like(whole, dtype=torch.bool)
        whole[self.rows, self.columns] = depth
        within[self.rows, self.columns] = True
        return DepthMap(whole, within)

    def pixel_index(self, width: int) -> Int[Tensor, "n"]:
        """Row-major numbers that the pixels of the window have in an image of `width` columns."""
        rows = torch.arange(self.height)[:, None] + self.top
        return (rows * width + torch.arange(self.width) + self.left).flatten()


def central_crops(cameras: Sequence[Camera], patch: int) -> list[Crop]:
    """The largest windows of one size about the centres of all images, in whole patches.

    Images of several sizes are not resized: where one view is wider than the others, as is the
    target with its margin, the network sees as much of it as of the others.

    Raises:
        InputError: where an image is smaller than one patch.
    """
    height = min(camera.height for camera in cameras)
    width = min(camera.width for camera in cameras)
    if height < patch or width < patch:
        raise InputError(
            f"All images have {height} x {width} pixels in common, and this model needs at "
            f"least {patch} x {patch}; use larger ones."
        )
    height, width = height // patch * patch, width // patch * patch
    return [
        Crop((camera.height - height) // 2, (camera.width - width) // 2, height, width)
        for camera in cameras
    ]


def batch_of(
    views: Sequence[View], patch: int, near: float, far: float
) -> tuple[Float[Tensor, "1 v 3 h w"], Cameras, list[Crop]]:
    """`views` as a batch of one scene, and the windows of them that it holds.

    Args:
        views: At least two.
        patch: Sides of the windows are multiples of it, in pixels.
        near: Smallest z-depth, for cameras that know none.
        far: Largest z-depth, for cameras that know none.

    Raises:
        InputError: fewer than two views, images smaller than one patch, an empty depth range.
    """
    if len(views) < 2:
        raise InputError(
            f"{len(views)} view was given, and the model matches at least 2; name more frames."
        )
    crops = central_crops([view.camera for view in views], patch)
    pairs = list(zip(views, crops, strict=True))
    ranges = [depth_range_of([view], lambda _: (near, far)) for view in views]
    images = torch.stack([v.image[c.rows, c.columns].movedim(-1, 0) for v, c in pairs])
    cameras = Cameras(
        c2w=torch.stack([view.camera.c2w for view in views])[None].float(),
        K=torch.stack([cropped_intrinsics(v.camera, c) for v, c in pairs])[None],
        near=images.new_tensor([[low for low, _ in ranges]]),
        far=images.new_tensor([[high for _, high in ranges]]),
    )
    return images[None], cameras, crops


def cropped_intrinsics(camera: Camera, crop: Crop) -> Float[Tensor, "3 3"]:
    """Intrinsics of the crop, in its widths and heights.

    The principal point keeps its place in the image. The authors' loaders leave (cx, cy) as
    they are, which is the same where it lies at the centre, as it does in their data.
    """
    K = camera.K.float().clone()
    K[0, 2] -= crop.left
    K[1, 2] -= crop.top
    return K / K.new_tensor([crop.width, crop.height, 1])[:, None]
