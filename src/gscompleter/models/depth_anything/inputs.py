"""Conversion of views to network inputs, and of network maps to view pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from gscompleter.models.depth_anything.images import (
    Fit,
    Image,
    Side,
    normalize_colors,
    resize_photograph,
    round_to_patches,
    scale_side,
)
from gscompleter.models.depth_anything.poses import Poses
from gscompleter.models.feed_forward.dino import PATCH
from gscompleter.numerics.geometry import sample
from gscompleter.system.errors import InputError
from gscompleter.types import Camera, DepthMap, View


@dataclass(frozen=True)
class ResizeConfig:
    """Settings of the resizing. The defaults equal the authors' `upper_bound_resize`."""

    resolution: int = 504
    """Length of the scaled side, in pixels, as in training."""
    side: Side = "longer"
    fit: Fit = "resized"
    """Method to make both sides multiples of 14 pixels."""


@dataclass(frozen=True)
class Window:
    """The part of a resized photograph that the network processes, in pixels of the latter."""

    top: int
    left: int
    height: int
    width: int
    scale_x: float
    """Horizontal scale of the resized photograph relative to the original."""
    scale_y: float
    """Vertical scale of the resized photograph relative to the original."""

    def crop_center_window(self, height: int, width: int) -> Window:
        """Crop the centre of the window, in which `crop_center` crops the image."""
        top = self.top + (self.height - height) // 2
        left = self.left + (self.width - width) // 2
        return replace(self, top=top, left=left, height=height, width=width)

    def compute_intrinsics(self, camera: Camera) -> Float[Tensor, "3 3"]:
        """Compute the intrinsics of `camera` in pixels of the window."""
        scales = torch.tensor([[self.scale_x], [self.scale_y], [1.0]])
        K = camera.K.float() * scales.to(camera.K.device)
        K[0, 2] -= self.left
        K[1, 2] -= self.top
        return K

    def locate_pixels(self, camera: Camera) -> Float[Tensor, "h w 2"]:
        """Compute the position (x, y) in the window of the centre of each pixel of the photograph.

        In pixels of the window; some are outside.
        """
        x = (torch.arange(camera.width) + 0.5) * self.scale_x - self.left
        y = (torch.arange(camera.height) + 0.5) * self.scale_y - self.top
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)

    def compute_pixel_indices(self, camera: Camera) -> Int[Tensor, "n"]:
        """Compute the row-major index of the photograph's pixel below each window pixel."""
        # The centre of each window pixel, back in the photograph.
        x = ((torch.arange(self.width) + 0.5 + self.left) / self.scale_x).long()
        y = ((torch.arange(self.height) + 0.5 + self.top) / self.scale_y).long()
        rows = y.clamp(max=camera.height - 1)
        columns = x.clamp(max=camera.width - 1)
        return (rows[:, None] * camera.width + columns).flatten()

    def resample_depth_map(
        self,
        depth: Float[Tensor, "{self.height} {self.width}"],
        confidence: Float[Tensor, "{self.height} {self.width}"],
        camera: Camera,
    ) -> DepthMap:
        """Resample z-depth of the window to the photograph.

        Pixels outside of the window, and those whose nearest pixel of it has no confidence, are
        invalid.
        """
        places = self.locate_pixels(camera).to(depth.device)
        # Inverse depth is linear in the image on a plane; confidence may be a mask, and is not
        # mixed. Depth without confidence may be 0, whose inverse times a weight of 0 is no number.
        inverse = 1 / depth[..., None]
        mixed = sample(inverse.where(confidence[..., None] > 0, 0.0), places)[..., 0]
        sure = sample(confidence[..., None], places, "nearest")[..., 0]
        # Depth without confidence, as that of the sky, is any number, and is not mixed either.
        unsure = sample((confidence[..., None] <= 0).to(depth), places)[..., 0]
        mixed = mixed.where(unsure == 0, sample(inverse, places, "nearest")[..., 0])
        size = places.new_tensor([self.width, self.height])
        valid = ((places >= 0) & (places <= size)).all(-1) & (sure > 0)
        return DepthMap(1 / mixed, valid, sure * valid)


@dataclass(frozen=True)
class Batch:
    """Network inputs for one scene, on the CPU."""

    images: Float[Tensor, "1 v 3 h w"]
    """Normalised as for networks trained on ImageNet."""
    poses: Poses
    """Cameras in the world and unit of the views, with intrinsics in pixels of the windows."""
    windows: tuple[Window, ...]
    """Place of each image in its photograph."""


def create_any_view_batch(views: Sequence[View], sizing: ResizeConfig, min_views: int) -> Batch:
    """Create a batch of views, resized and centrally cropped to one size.

    Raises:
        InputError: Fewer than `min_views` views, or one that is too narrow.
    """
    if len(views) < min_views:
        raise InputError(
            f"{len(views)} view was given, and the model matches at least {min_views}; name more "
            "frames."
        )
    resized = [crop_to_patches(quantize_image(view), sizing) for view in views]

    # Photographs of several shapes are cropped to what all of them have.
    height = min(image.shape[0] for image, _ in resized)
    width = min(image.shape[1] for image, _ in resized)
    windows = tuple(window.crop_center_window(height, width) for _, window in resized)
    images = np.stack([crop_center(image, height, width) for image, _ in resized])

    c2w = torch.stack([view.camera.c2w.cpu() for view in views]).float()
    K = torch.stack(
        [
            window.compute_intrinsics(view.camera).cpu()
            for view, window in zip(views, windows, strict=True)
        ]
    )
    colours = normalize_colors(torch.from_numpy(images))
    return Batch(colours[None], Poses(c2w[None], K[None]), windows)


def crop_to_patches(image: Image, sizing: ResizeConfig) -> tuple[Image, Window]:
    """Resize and crop a photograph to whole patches, and return it with its window."""
    h, w = image.shape[:2]
    scaled = scale_side(image, sizing.resolution, sizing.side)
    if min(scaled.shape[:2]) < PATCH:
        raise InputError(
            f"An image of {w} x {h} pixels is resized to {scaled.shape[1]} x {scaled.shape[0]} for "
            f"this model, which needs at least {PATCH} x {PATCH}; use a less narrow one."
        )
    height = round_to_patches(scaled.shape[0], sizing.fit)
    width = round_to_patches(scaled.shape[1], sizing.fit)
    # The second resizing may stretch the image by up to half a patch, as the authors' does. After
    # it the crop is all of the image.
    if sizing.fit == "resized":
        scaled = resize_photograph(scaled, height, width)
    rows, columns = scaled.shape[:2]
    whole = Window(0, 0, rows, columns, scale_x=columns / w, scale_y=rows / h)
    return crop_center(scaled, height, width), whole.crop_center_window(height, width)


def crop_center(image: Image, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
    """Crop the centre of an image."""
    top = (image.shape[0] - height) // 2
    left = (image.shape[1] - width) // 2
    return image[top : top + height, left : left + width]


def quantize_image(view: View) -> UInt8[np.ndarray, "h w 3"]:
    """Quantise the image to 8 bits, as the authors' code does."""
    return (view.image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
