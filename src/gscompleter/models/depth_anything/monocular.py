"""The monocular network of Depth Anything 3: relative depth, and no depth in the sky."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from gscompleter.models.depth_anything.config import VARIANTS, MetricDepthConfig
from gscompleter.models.depth_anything.inputs import create_any_view_batch
from gscompleter.models.depth_anything.metric import MetricDepthAnything
from gscompleter.models.depth_anything.reconstructor import (
    Inference,
    get_device,
    resample_depth_maps,
)
from gscompleter.models.feed_forward.precision import lower_precision
from gscompleter.models.weights import PUBLISHED, fetch, load_strictly, read_state_dict
from gscompleter.types import DepthMap, View


@dataclass(frozen=True)
class MonocularDepth:
    """Relative depth of single views; the architecture is that of the metric network."""

    network: MetricDepthAnything
    inference: Inference = Inference()

    def __call__(self, view: View) -> DepthMap:
        """Predict z-depth in a unit of its own, invalid in the sky."""
        batch = create_any_view_batch([view], self.inference.sizing, min_views=1)
        device = get_device(self.network)
        with torch.no_grad(), lower_precision(device, self.inference.dtype):
            predicted = self.network(batch.images.to(device))
        solid = predicted.solid_mask[0].float()
        (depth_map,) = resample_depth_maps(predicted.depth[0], solid, batch, [view])
        return depth_map


def load_monocular(name: str, weights: Path | None = None, device: str = "cpu") -> MonocularDepth:
    """Load the published network, or a file; raises the errors of `fetch` and `load_strictly`."""
    published = PUBLISHED[name]
    path = fetch(published, weights)
    config = VARIANTS[name]
    assert isinstance(config, MetricDepthConfig)
    network = MetricDepthAnything(config)
    state = read_state_dict(path, published)
    load_strictly(network, state, path)
    return MonocularDepth(network.eval().requires_grad_(False).to(device))
