"""From views to what the networks take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.reconstructors.feed_forward.cameras import Cameras
from gscompleter.types import View


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
        self, values: Float[Tensor, "{self.height} {self.width}"], height: int, width: int
    ) -> tuple[Float[Tensor, "{height} {width}"], Bool[Tensor, "{height} {width}"]]:
        """`values` of the window in the whole image, and where that is; 0 outside."""
        whole = values.new_zeros(height, width)
        within = torch.zeros(height, width, dtype=torch.bool, device=values.device)
        whole[self.rows, self.columns] = values
        within[self.rows, self.columns] = True
        return whole, within

    def pixel_index(self, width: int) -> Int[Tensor, "n"]:
        """Row-major numbers that the pixels of the window have in an image of `width` columns."""
        rows = torch.arange(self.height)[:, None] + self.top
        return (rows * width + torch.arange(self.width) + self.left).flatten()


def central_crop(height: int, width: int, patch: int) -> Crop:
    """The largest window about the centre whose sides are multiples of `patch`.

    Raises:
        InputError: where the image is smaller than one patch.
    """
    if height < patch or width < patch:
        raise InputError(
            f"The images have {height} x {width} pixels, and this model needs at least "
            f"{patch} x {patch}; use larger ones."
        )
    h, w = height // patch * patch, width // patch * patch
    return Crop((height - h) // 2, (width - w) // 2, h, w)


def batch_of(
    views: Sequence[View], patch: int, near: float, far: float
) -> tuple[Float[Tensor, "1 v 3 h w"], Cameras, Crop]:
    """`views` as a batch of one scene, cropped about the centre to whole patches.

    Args:
        views: At least two, of one size.
        patch: Sides of the crop are multiples of it, in pixels.
        near: Smallest z-depth, for cameras that know none.
        far: Largest z-depth, for cameras that know none.

    Raises:
        InputError: fewer than two views, views of several sizes, images smaller than one patch,
            an empty depth range.
    """
    if len(views) < 2:
        raise InputError(
            f"{len(views)} view was given, and the model matches at least 2; name more frames."
        )
    sizes = {(view.camera.height, view.camera.width) for view in views}
    if len(sizes) > 1:
        listed = " and ".join(f"{height} x {width}" for height, width in sorted(sizes))
        raise InputError(
            f"The views have {listed} pixels, and the model takes views of one size; "
            "give a --resolution."
        )
    crop = central_crop(*sizes.pop(), patch)
    ranges = [depth_range(view, near, far) for view in views]
    images = torch.stack([view.image[crop.rows, crop.columns].movedim(-1, 0) for view in views])
    cameras = Cameras(
        c2w=torch.stack([view.camera.c2w for view in views])[None].float(),
        K=torch.stack([cropped_intrinsics(view, crop) for view in views])[None],
        near=images.new_tensor([[low for low, _ in ranges]]),
        far=images.new_tensor([[high for _, high in ranges]]),
    )
    return images[None], cameras, crop


def cropped_intrinsics(view: View, crop: Crop) -> Float[Tensor, "3 3"]:
    """Intrinsics of the crop, in its widths and heights.

    The principal point keeps its place in the image. The authors' loaders leave (cx, cy) as
    they are, which is the same where it lies at the centre, as it does in their data.
    """
    K = view.camera.K.float().clone()
    K[0, 2] -= crop.left
    K[1, 2] -= crop.top
    return K / K.new_tensor([crop.width, crop.height, 1])[:, None]


def depth_range(view: View, near: float, far: float) -> tuple[float, float]:
    """Near and far z-depth of a view: as its camera knows them, else `near` and `far`."""
    low = near if view.camera.near is None else view.camera.near
    high = far if view.camera.far is None else view.camera.far
    if not 0 < low < high:
        raise InputError(
            f"The depth range {low:g} to {high:g} is empty; near must be positive and less than "
            "far."
        )
    return low, high
