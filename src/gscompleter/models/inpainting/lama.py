"""LaMa (Suvorov et al., WACV 2022): inpainting by Fourier convolutions."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.models.inpainting.fill import InpaintingGenerator, run_inpainting_network
from gscompleter.models.onnx_network import OnnxNetwork, load_network
from gscompleter.models.weights.published import PUBLISHED

SIGNATURE = {"image": ("tensor(float)", 3), "mask": ("tensor(float)", 1)}
"""Type and number of channels of each input of the network."""
MULTIPLE = 32
"""Divisor of the side lengths that the network accepts if they are not fixed."""


class LaMa:
    """Fills holes with the network of LaMa.

    The network takes colours in [0, 1] and a mask, 1 in the hole, and returns colours in [0, 255].
    """

    def __init__(self, network: OnnxNetwork) -> None:
        self.network = network

    def __call__(
        self, image: Float[Tensor, "h w 3"], hole: Bool[Tensor, "h w"]
    ) -> Float[Tensor, "h w 3"]:
        """Fill the hole of an image in [0, 1], which is a window of `fill_windows`.

        It is no larger than the size that a file of LaMa fixes, and is reflected beyond its right
        and lower border to that size, or to the next valid one.
        """
        height, width = hole.shape
        rows, columns = self.network.fixed_size or (
            -(-height // MULTIPLE) * MULTIPLE,
            -(-width // MULTIPLE) * MULTIPLE,
        )
        border = ((0, rows - height), (0, columns - width))
        pixels = np.pad(image.numpy(), (*border, (0, 0)), mode="symmetric").transpose(2, 0, 1)[None]
        mask = np.pad(hole.float().numpy(), border, mode="symmetric")[None, None]
        result = run_inpainting_network(self.network, image=np.ascontiguousarray(pixels), mask=mask)
        return torch.from_numpy(result[0] / 255).permute(1, 2, 0)[:height, :width]


def load_lama(file: str | None = None, device: str = "cpu") -> InpaintingGenerator:
    """Load the generator from a file, or the published one; raises the errors of `load_network`."""
    network = load_network(PUBLISHED["lama"], SIGNATURE, file, device)
    return InpaintingGenerator(LaMa(network))
