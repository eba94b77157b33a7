"""Learned reconstructors Ψ that predict Gaussians from posed photographs in a single pass.

The code is our own. Module names follow the authors' checkpoints, so that these load unchanged.
"""

from gscompleter.models.feed_forward.depthsplat import VARIANTS, DepthSplat, DepthSplatConfig
from gscompleter.models.feed_forward.mvsplat import MVSplat, MVSplatConfig
from gscompleter.models.feed_forward.reconstructor import FeedForward
from gscompleter.models.feed_forward.volsplat import VolSplat, VolSplatConfig

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
