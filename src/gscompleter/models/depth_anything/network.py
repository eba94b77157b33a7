"""Depth Anything 3 (Lin et al., 2025): depth, cameras and Gaussians of any number of views."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.models.depth_anything.camera_heads import CameraDecoder, CameraEncoder
from gscompleter.models.depth_anything.config import DepthAnythingConfig
from gscompleter.models.depth_anything.dual_dpt import DualDpt
from gscompleter.models.depth_anything.gaussian_head import GaussianDpt, create_camera_gaussians
from gscompleter.models.depth_anything.poses import Poses, decode_poses, encode_poses
from gscompleter.models.depth_anything.vit import AnyViewVit, Tokens
from gscompleter.models.feed_forward.cameras import disable_autocast
from gscompleter.models.feed_forward.dino import PATCH
from gscompleter.models.feed_forward.gaussian_adapter import PixelGaussians


@dataclass(frozen=True)
class Prediction:
    """Output for a batch, with z-depth, in a frame and unit of its own."""

    depth: Float[Tensor, "b v h w"]
    confidence: Float[Tensor, "b v h w"]
    """Confidence of the z-depth, from 1 upwards."""
    poses: Poses
    """Predicted cameras, even if poses were given."""
    raw: Float[Tensor, "b v h w c"] | None
    """Raw Gaussian channels per pixel, or None without a Gaussian head."""

    def create_gaussians(self, factors: Float[Tensor, "b"]) -> PixelGaussians:
        """Create the Gaussians, with distances between cameras multiplied by `factors`."""
        assert self.raw is not None
        with disable_autocast(self.raw):
            return create_camera_gaussians(self.raw, self.depth, self.poses, factors)


class DepthAnything(nn.Module):
    """The any-view network: 34 M (small), 135 M (base), 411 M (large), 1356 M (giant) weights."""

    def __init__(self, config: DepthAnythingConfig = DepthAnythingConfig()) -> None:
        super().__init__()
        self.config = config
        channels = config.vit.num_output_channels
        head = (config.widths, config.features)
        self.backbone = nn.ModuleDict({"pretrained": AnyViewVit(config.vit)})
        self.head = DualDpt(channels, *head)
        self.cam_dec = CameraDecoder(channels)
        self.cam_enc = CameraEncoder(config.vit.channels)
        self.gs_head = GaussianDpt(channels, *head) if config.has_gaussian_head else None

    def forward(self, images: Float[Tensor, "b v 3 h w"], poses: Poses | None = None) -> Prediction:
        """Predict depth, cameras and, with a Gaussian head, raw Gaussians.

        Images are normalised and have sides divisible by 14; `poses` come from `normalize_poses`.
        """
        size = (images.shape[3], images.shape[4])
        tokens = self.compute_tokens(images, poses)
        with disable_autocast(images):
            # Heads run in float32: depth is an exponential, which half precision resolves badly.
            pyramid = self.head.compute_pyramid(tokens, size[0] // PATCH, size[1] // PATCH)
            depth, confidence = self.head.predict_depth(pyramid, size)
            # From the camera token of the last output block; as `encode_poses` gives them, with
            # quaternions that are not normalised.
            numbers = self.cam_dec(tokens[-1].camera)
            raw = None if self.gs_head is None else self.gs_head(tokens, images)
            views = images.shape[:2]
            return Prediction(
                depth.unflatten(0, views),
                confidence.unflatten(0, views),
                decode_poses(numbers, size),
                raw,
            )

    def compute_tokens(
        self, images: Float[Tensor, "b v 3 h w"], poses: Poses | None
    ) -> list[Tokens]:
        """Compute the transformer's tokens, in float32."""
        with disable_autocast(images):
            size = (images.shape[3], images.shape[4])
            cameras = None if poses is None else self.cam_enc(encode_poses(poses, size))
        return [tokens.float() for tokens in self.backbone["pretrained"](images, cameras)]
