"""Semi-global aggregation: neighbouring pixels of like colour prefer like depths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from gscompleter.kernels import stereo
from gscompleter.matching.frames import Frame


@dataclass(frozen=True)
class AggregationConfig:
    small_penalty: float = 25.0
    """Cost of a change by one plane between neighbours."""
    large_penalty: float = 300.0
    """Cost of a jump between neighbours of the same colour."""
    edge_contrast: float = 0.06
    """Difference of colour at which the penalty of a jump has halved."""


def aggregate(
    costs: UInt8[np.ndarray, "h w d"], reference: Frame, config: AggregationConfig
) -> Float[np.ndarray, "h w d"]:
    """Costs summed along eight paths through the image; jumps are cheap at its edges."""
    image = reference.image

    def jump(a: Float[np.ndarray, "r c 3"], b: Float[np.ndarray, "r c 3"]) -> np.ndarray:
        contrast = np.abs(a - b).max(axis=-1)
        penalty = config.large_penalty / (1 + contrast / np.float32(config.edge_contrast))
        return np.maximum(penalty, 1.5 * config.small_penalty).astype(np.float32)

    return stereo.semi_global(
        costs,
        jump(image[:, 1:], image[:, :-1]),
        jump(image[1:], image[:-1]),
        jump(image[1:, 1:], image[:-1, :-1]),
        jump(image[:-1, 1:], image[1:, :-1]),
        np.float32(config.small_penalty),
    )
