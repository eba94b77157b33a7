"""MI-GAN (Sargsyan et al., ICCV 2023): inpainting for phones, in less than a second on a CPU."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.models.inpainting.fill import InpaintingGenerator, run_inpainting_network
from gscompleter.models.onnx_network import OnnxNetwork, load_network
from gscompleter.models.weights.published import PUBLISHED

SIGNATURE = {"image": ("tensor(uint8)", 3), "mask": ("tensor(uint8)", 1)}


class MIGAN:
    """The authors' pipeline: bytes of any size, with a mask that is 255 where known."""

    def __init__(self, network: OnnxNetwork) -> None:
        self.network = network

    def __call__(
        self, image: Float[Tensor, "h w 3"], hole: Bool[Tensor, "h w"]
    ) -> Float[Tensor, "h w 3"]:
        """Fill the hole of an image in [0, 1]."""
        pixels = (255 * image).round().byte().permute(2, 0, 1)[None]
        known = 255 * (~hole).byte()[None, None]
        result = run_inpainting_network(
            self.network, image=pixels.contiguous().numpy(), mask=known.numpy()
        )
        return torch.from_numpy(result[0]).permute(1, 2, 0).float() / 255


def load_migan(file: str | None = None, device: str = "cpu") -> InpaintingGenerator:
    """Load the generator from a file, or the published one; raises the errors of `load_network`."""
    network = load_network(PUBLISHED["migan"], SIGNATURE, file, device)
    return InpaintingGenerator(MIGAN(network))
