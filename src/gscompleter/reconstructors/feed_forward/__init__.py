"""Learned reconstructors Ψ that predict Gaussians from posed photographs in a single pass.

The code is our own. Module names follow the authors' checkpoints, so that these load unchanged.
"""

from gscompleter.reconstructors.feed_forward.depthsplat import (
    VARIANTS,
    DepthSplat,
    DepthSplatConfig,
)
from gscompleter.reconstructors.feed_forward.mvsplat import MVSplat, MVSplatConfig
from gscompleter.reconstructors.feed_forward.reconstructor import FeedForward
from gscompleter.reconstructors.feed_forward.volsplat import VolSplat, VolSplatConfig

__all__ = [
    "VARIANTS",
    "DepthSplat",
    "DepthSplatConfig",
    "FeedForward",
    "MVSplat",
    "MVSplatConfig",
    "VolSplat",
    "VolSplatConfig",
]
