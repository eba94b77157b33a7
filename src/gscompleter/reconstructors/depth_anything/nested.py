"""The nested network: any number of views, brought to metres by the metric network."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from gscompleter.reconstructors.depth_anything.config import NestedConfig
from gscompleter.reconstructors.depth_anything.metric import (
    MIN_PIXELS,
    MetricDepth,
    MetricDepthAnything,
    quantile,
    with_far_sky,
)
from gscompleter.reconstructors.depth_anything.network import DepthAnything, Prediction
from gscompleter.reconstructors.depth_anything.poses import Poses
from gscompleter.reconstructors.feed_forward.cameras import full_precision

MIN_METRES = 0.01
"""Depth, in metres, under which a pixel tells nothing of the scale."""
MIN_DEPTH = 1e-3
"""Likewise, in the unit of the any-view network."""
FARTHEST = 200.0
"""Metres at which the sky is put at most."""


@dataclass(frozen=True)
class NestedPrediction:
    """What the network makes of one scene."""

    any_view: Prediction
    """In the unit of its own."""
    metric: MetricDepth
    scale: float
    """Metres to that unit."""

    @property
    def depth(self) -> Float[Tensor, "1 v h w"]:
        """z-depth in metres; the sky lies behind nearly all else, 200 m away at most."""
        return with_far_sky(self.any_view.depth * self.scale, self.metric.solid, FARTHEST)

    @property
    def confidence(self) -> Float[Tensor, "1 v h w"]:
        """How sure the network is of it, from 1 upwards: 1 of the sky."""
        return self.any_view.confidence.where(self.metric.solid, 1.0)


class NestedDepthAnything(nn.Module):
    """Both networks: 1690 M parameters."""

    def __init__(self, config: NestedConfig) -> None:
        super().__init__()
        self.config = config
        self.da3 = DepthAnything(config.any_view)
        self.da3_metric = MetricDepthAnything(config.metric)

    def forward(
        self, images: Float[Tensor, "1 v 3 h w"], poses: Poses | None = None
    ) -> NestedPrediction:
        """As `DepthAnything`, and how long its unit is in metres."""
        prediction = self.da3(images, poses)
        metric = self.da3_metric(images)
        with full_precision(images):
            return NestedPrediction(prediction, metric, metres_per_unit(prediction, metric))


def metres_per_unit(prediction: Prediction, metric: MetricDepth) -> float:
    """The factor by which the depth of the any-view network fits that of the metric one best.

    The surer half of what is no sky counts. Where there is hardly anything else than sky it is 1,
    for nothing tells it.
    """
    metres = metric.in_metres(prediction.poses.K)
    counts = counted(prediction, metric, metres)
    if int(counts.sum()) <= MIN_PIXELS:
        return 1.0
    a, b = metres[counts].double(), prediction.depth[counts].double()
    return float((a * b).sum() / (b * b).sum())


def counted(
    prediction: Prediction, metric: MetricDepth, metres: Float[Tensor, "b v h w"]
) -> Bool[Tensor, "b v h w"]:
    """The pixels that tell the scale."""
    if not metric.solid.any():
        return torch.zeros_like(metric.solid)
    sure = prediction.confidence >= quantile(prediction.confidence[metric.solid], 0.5)
    deep = (metres > MIN_METRES) & (prediction.depth > MIN_DEPTH)
    return sure & deep & metric.solid
