"""The nested network: any-view depth, scaled to metres by the metric network."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.models.depth_anything.config import NestedConfig
from gscompleter.models.depth_anything.metric import (
    MIN_PIXELS,
    MetricDepth,
    MetricDepthAnything,
    interpolate_quantile,
    set_sky_depth,
)
from gscompleter.models.depth_anything.network import DepthAnything, Prediction
from gscompleter.models.depth_anything.poses import Poses
from gscompleter.models.feed_forward.cameras import disable_autocast

MIN_METRES = 0.01
"""Smallest depth of pixels that determine the scale, in metres."""
MIN_DEPTH = 1e-3
"""Smallest depth of pixels that determine the scale, in the unit of the any-view network."""
MAX_SKY_DEPTH = 200.0
"""Largest depth of the sky, in metres."""


@dataclass(frozen=True)
class NestedPrediction:
    """Predictions of both networks for one scene."""

    any_view: Prediction
    metric: MetricDepth
    scale: float
    """Metres per unit of `any_view`; 1 if too few pixels tell it."""

    @property
    def depth(self) -> Float[Tensor, "1 v h w"]:
        """The z-depth in metres, in the sky that of the far foreground (`set_sky_depth`)."""
        return set_sky_depth(
            self.any_view.depth * self.scale, self.metric.solid_mask, MAX_SKY_DEPTH
        )

    @property
    def confidence(self) -> Float[Tensor, "1 v h w"]:
        """The confidence, from 1 upwards; 1 in the sky."""
        return self.any_view.confidence.where(self.metric.solid_mask, 1.0)


class NestedDepthAnything(nn.Module):
    """The nested network: 1690 M parameters."""

    def __init__(self, config: NestedConfig) -> None:
        super().__init__()
        self.config = config
        self.da3 = DepthAnything(config.any_view)
        self.da3_metric = MetricDepthAnything(config.metric)

    def forward(
        self, images: Float[Tensor, "1 v 3 h w"], poses: Poses | None = None
    ) -> NestedPrediction:
        """Predict like `DepthAnything`, and the scale to metres."""
        prediction = self.da3(images, poses)
        metric = self.da3_metric(images)
        with disable_autocast(images):
            return NestedPrediction(prediction, metric, fit_metres_per_unit(prediction, metric))


def fit_metres_per_unit(prediction: Prediction, metric: MetricDepth) -> float:
    """Fit the scale from any-view to metric depth on the more confident half of the foreground.

    It is 1 if hardly any pixels are left.
    """
    solid = metric.solid_mask
    if not solid.any():
        return 1.0
    # By the predicted cameras, even if poses were given, as the authors do.
    metres = metric.convert_to_metres(prediction.poses.K)
    middle = interpolate_quantile(prediction.confidence[solid], 0.5)
    deep = (metres > MIN_METRES) & (prediction.depth > MIN_DEPTH)
    counts = (prediction.confidence >= middle) & deep & solid
    if int(counts.sum()) <= MIN_PIXELS:
        return 1.0
    # Least squares without a shift: (a · b) / (b · b). On the CPU: the GPU of a Mac has no float64.
    a = metres[counts].cpu().double()
    b = prediction.depth[counts].cpu().double()
    return float((a * b).sum() / (b * b).sum())
