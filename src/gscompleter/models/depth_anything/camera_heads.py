"""Conversion between cameras and transformer tokens."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.models.depth_anything.vit import Block
from gscompleter.models.feed_forward.dino import Attention, Mlp

NUM_CAMERA_HEADS = 16
"""Number of attention heads of the camera encoder, for all network sizes."""
NUM_CAMERA_LAYERS = 4
"""Number of layers of the camera encoder."""


class PoseBranch(nn.Module):
    """Two linear layers from nine camera parameters to a token."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(9, channels // 2)
        self.fc2 = nn.Linear(channels // 2, channels)

    def forward(self, numbers: Float[Tensor, "b v 9"]) -> Float[Tensor, "b v c"]:
        """Apply both layers."""
        return self.fc2(F.gelu(self.fc1(numbers)))


class CameraEncoder(nn.Module):
    """Transformer that encodes the cameras of a scene as tokens."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.pose_branch = PoseBranch(channels)
        self.token_norm = nn.LayerNorm(channels)
        self.trunk = nn.Sequential(
            *(
                Block(channels, Attention(channels, NUM_CAMERA_HEADS), Mlp(channels), eps=1e-5)
                for _ in range(NUM_CAMERA_LAYERS)
            )
        )
        self.trunk_norm = nn.LayerNorm(channels)

    def forward(self, numbers: Float[Tensor, "b v 9"]) -> Float[Tensor, "b v c"]:
        """Encode parameters from `encode_poses`."""
        return self.trunk_norm(self.trunk(self.token_norm(self.pose_branch(numbers))))


class CameraDecoder(nn.Module):
    """Layers that predict a camera from its token."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.backbone = nn.Sequential(
            nn.Linear(channels, channels), nn.ReLU(), nn.Linear(channels, channels), nn.ReLU()
        )
        self.fc_t = nn.Linear(channels, 3)
        self.fc_qvec = nn.Linear(channels, 4)
        self.fc_fov = nn.Sequential(nn.Linear(channels, 2), nn.ReLU())

    def forward(self, tokens: Float[Tensor, "b v c"]) -> Float[Tensor, "b v 9"]:
        """Predict parameters for `decode_poses`; quaternions are not normalised."""
        x = self.backbone(tokens)
        return torch.cat([self.fc_t(x), self.fc_qvec(x), self.fc_fov(x)], dim=-1)
