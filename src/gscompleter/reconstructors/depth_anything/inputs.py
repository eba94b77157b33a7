"""From views to what the networks take, and their maps back to the pixels of the views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.geometry import sample
from gscompleter.reconstructors.depth_anything.images import (
    Fit,
    Image,
    Side,
    normalised_images,
    resized_to,
    scaled_to,
    whole_patches,
)
from gscompleter.reconstructors.depth_anything.poses import Poses
from gscompleter.reconstructors.feed_forward.dino import PATCH
from gscompleter.types import Camera, DepthMap, View


@dataclass(frozen=True)
class Sizing:
    """How photographs are resized. As it stands it is the authors' `upper_bound_resize`."""

    resolution: int = 504
    """Length of one side, in pixels, as in training."""
    side: Side = "longer"
    """Which side that is."""
    fit: Fit = "resized"
    """How both sides become multiples of 14 pixels then."""


@dataclass(frozen=True)
class Window:
    """The part of a resized photograph that the network sees."""

    top: int
    left: int
    height: int
    width: int
    across: float
    """Pixels of the resized photograph to one of the original's, along a row."""
    down: float
    """Likewise, along a column."""

    def cropped(self, height: int, width: int) -> Window:
        """The middle of it."""
        top = self.top + (self.height - height) // 2
        left = self.left + (self.width - width) // 2
        return replace(self, top=top, left=left, height=height, width=width)

    def intrinsics(self, camera: Camera) -> Float[Tensor, "3 3"]:
        """Of `camera`, in pixels of the window."""
        K = camera.K.float() * torch.tensor([[self.across], [self.down], [1.0]]).to(camera.K.device)
        K[0, 2] -= self.left
        K[1, 2] -= self.top
        return K

    def places(self, camera: Camera) -> Float[Tensor, "h w 2"]:
        """Where in the window each pixel of the photograph lies; some lie outside."""
        x = (torch.arange(camera.width) + 0.5) * self.across - self.left
        y = (torch.arange(camera.height) + 0.5) * self.down - self.top
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)

    def pixel_index(self, camera: Camera) -> Int[Tensor, "n"]:
        """Row-major number of the photograph's pixel in which each pixel of the window lies."""
        x = ((torch.arange(self.width) + 0.5 + self.left) / self.across).long()
        y = ((torch.arange(self.height) + 0.5 + self.top) / self.down).long()
        rows, columns = y.clamp(max=camera.height - 1), x.clamp(max=camera.width - 1)
        return (rows[:, None] * camera.width + columns).flatten()

    def depth_map(
        self,
        depth: Float[Tensor, "{self.height} {self.width}"],
        confidence: Float[Tensor, "{self.height} {self.width}"],
        camera: Camera,
    ) -> DepthMap:
        """A map of the window as one of the photograph.

        Inverse depths are interpolated, for that of a plane is linear in the pixel. Outside of the
        window the border goes on, and nothing is valid.
        """
        places = self.places(camera).to(depth.device)
        inverse = sample(1 / depth[..., None], places)[..., 0]
        sure = sample(confidence[..., None], places, "nearest")[..., 0]
        size = places.new_tensor([self.width, self.height])
        valid = ((places >= 0) & (places <= size)).all(-1) & (sure > 0)
        return DepthMap(1 / inverse, valid, sure * valid)


@dataclass(frozen=True)
class Batch:
    """One scene as the networks take it."""

    images: Float[Tensor, "1 v 3 h w"]
    """Normalised."""
    poses: Poses
    """Of the given cameras, in world coordinates and scene units."""
    windows: tuple[Window, ...]


def batch_of(views: Sequence[View], sizing: Sizing, fewest: int) -> Batch:
    """`views`, resized and cropped about their centres to one size.

    Raises:
        InputError: where there are fewer than `fewest` views, or an image smaller than a patch.
    """
    if len(views) < fewest:
        raise InputError(
            f"{len(views)} view was given, and the model matches at least {fewest}; name more "
            "frames."
        )
    seen = [seen_of(eight_bit(view), sizing) for view in views]
    height, width = (min(image.shape[side] for image, _ in seen) for side in (0, 1))
    windows = tuple(window.cropped(height, width) for _, window in seen)
    images = np.stack([centre_of(image, height, width) for image, _ in seen])
    c2w = torch.stack([view.camera.c2w.cpu() for view in views]).float()
    K = torch.stack([w.intrinsics(v.camera).cpu() for v, w in zip(views, windows, strict=True)])
    return Batch(
        normalised_images(torch.from_numpy(images))[None], Poses(c2w[None], K[None]), windows
    )


def seen_of(image: Image, sizing: Sizing) -> tuple[Image, Window]:
    """What the network sees of a photograph, and where that lies in it.

    Raises:
        InputError: where it is smaller than a patch once it is resized.
    """
    h, w = image.shape[:2]
    scaled = scaled_to(image, sizing.resolution, sizing.side)
    if min(scaled.shape[:2]) < PATCH:
        raise InputError(
            f"An image of {w} x {h} pixels is {scaled.shape[1]} x {scaled.shape[0]} where this "
            f"model looks at it, and it needs at least {PATCH} x {PATCH}; use a less narrow one."
        )
    height, width = (whole_patches(side, sizing.fit) for side in scaled.shape[:2])
    if sizing.fit == "resized":
        scaled = resized_to(scaled, height, width)
    rows, columns = scaled.shape[:2]
    whole = Window(0, 0, rows, columns, across=columns / w, down=rows / h)
    return centre_of(scaled, height, width), whole.cropped(height, width)


def centre_of(image: Image, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
    """The middle of an image."""
    top, left = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
    return image[top : top + height, left : left + width]


def eight_bit(view: View) -> UInt8[np.ndarray, "h w 3"]:
    """The image in 256 levels, as the authors' code takes it."""
    return (view.image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
