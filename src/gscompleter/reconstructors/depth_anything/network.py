"""Depth Anything 3 (Lin et al., 2025): depth, cameras and Gaussians of any number of views.

Modules carry the names of the published weights, so that these load as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.reconstructors.depth_anything.camera_heads import CameraDecoder, CameraEncoder
from gscompleter.reconstructors.depth_anything.config import DepthAnythingConfig
from gscompleter.reconstructors.depth_anything.dual_dpt import DualDpt
from gscompleter.reconstructors.depth_anything.gaussian_head import GaussianDpt, gaussians_from
from gscompleter.reconstructors.depth_anything.poses import Poses, decoded, encoded
from gscompleter.reconstructors.depth_anything.vit import AnyViewVit, Tokens
from gscompleter.reconstructors.feed_forward.cameras import full_precision
from gscompleter.reconstructors.feed_forward.dino import PATCH
from gscompleter.reconstructors.feed_forward.gaussian_adapter import PixelGaussians


@dataclass(frozen=True)
class Prediction:
    """What a network makes of a batch, in a frame and unit of its own."""

    depth: Float[Tensor, "b v h w"]
    """z-depth."""
    confidence: Float[Tensor, "b v h w"]
    """How sure it is of it, from 1 upwards."""
    numbers: Float[Tensor, "b v 9"]
    """Of the predicted cameras, as in `poses.encoded`, but with quaternions of any length."""
    poses: Poses
    """The predicted cameras, also where poses were given."""
    raw: Float[Tensor, "b v h w c"] | None
    """Raw channels of a Gaussian for each pixel, where the network has a head for them."""

    def gaussians(self, factors: Float[Tensor, "b"]) -> PixelGaussians:
        """The Gaussians, once the predicted cameras are `factors` times as far apart."""
        assert self.raw is not None
        with full_precision(self.raw):
            return gaussians_from(self.raw, self.depth, self.poses, factors)


class DepthAnything(nn.Module):
    """The whole network: 34 M (small), 135 M (base), 411 M (large) or 1356 M (giant) parameters."""

    def __init__(self, config: DepthAnythingConfig = DepthAnythingConfig()) -> None:
        super().__init__()
        self.config = config
        channels, head = config.vit.described, (config.widths, config.features)
        self.backbone = nn.ModuleDict({"pretrained": AnyViewVit(config.vit)})
        self.head = DualDpt(channels, *head)
        self.cam_dec = CameraDecoder(channels)
        self.cam_enc = CameraEncoder(config.vit.channels)
        self.gs_head = GaussianDpt(channels, *head) if config.gaussians else None

    def forward(self, images: Float[Tensor, "b v 3 h w"], poses: Poses | None = None) -> Prediction:
        """Depth, cameras and, where there is a head for them, Gaussians.

        Args:
            images: Normalised, their sides multiples of 14.
            poses: Of the cameras, as `seen_from_first`; None where they are not known.
        """
        size = (images.shape[3], images.shape[4])
        tokens = self.described(images, poses)
        with full_precision(images):
            pyramid = self.head.pyramid(tokens, size[0] // PATCH, size[1] // PATCH)
            depth, confidence = self.head.depth(pyramid, size)
            numbers = self.cam_dec(tokens[-1].camera)
            raw = None if self.gs_head is None else self.gs_head(tokens, images)
            views = images.shape[:2]
            return Prediction(
                depth.unflatten(0, views),
                confidence.unflatten(0, views),
                numbers,
                decoded(numbers, size),
                raw,
            )

    def described(self, images: Float[Tensor, "b v 3 h w"], poses: Poses | None) -> list[Tokens]:
        """What the transformer hands on, in float32."""
        with full_precision(images):
            size = (images.shape[3], images.shape[4])
            cameras = None if poses is None else self.cam_enc(encoded(poses, size))
        return [tokens.float() for tokens in self.backbone["pretrained"](images, cameras)]
