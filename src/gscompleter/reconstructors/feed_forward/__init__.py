"""Ψ with weights: networks that turn posed photographs into Gaussians in a single pass.

The code is our own, written from descriptions of the models; the modules are named as in the
authors' checkpoints, so that these load without renaming.
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
