"""Depth Anything 3 as a reconstructor Ψ: a transformer for any number of views.

The code is our own. Module names follow the authors' files, so that these load unchanged.
"""

from gscompleter.models.depth_anything.config import (
    VARIANTS,
    DepthAnythingConfig,
    MetricDepthConfig,
    NestedConfig,
)
from gscompleter.models.depth_anything.inputs import ResizeConfig
from gscompleter.models.depth_anything.metric import MetricDepthAnything
from gscompleter.models.depth_anything.nested import NestedDepthAnything
from gscompleter.models.depth_anything.network import DepthAnything
from gscompleter.models.depth_anything.normalisation import (
    compute_authors_units,
    compute_scene_units,
)
from gscompleter.models.depth_anything.reconstructor import (
    AnyViewDepth,
    AnyViewGaussians,
    Inference,
    MetricViewDepth,
)

__all__ = [
    "VARIANTS",
    "AnyViewDepth",
    "AnyViewGaussians",
    "DepthAnything",
    "DepthAnythingConfig",
    "Inference",
    "MetricDepthAnything",
    "MetricDepthConfig",
    "MetricViewDepth",
    "NestedConfig",
    "NestedDepthAnything",
    "ResizeConfig",
    "compute_authors_units",
    "compute_scene_units",
]
