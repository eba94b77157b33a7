"""A depth model of your own, for `--depth` and as a whole Ψ.

    gscompleter complete SCENE --out OUT --depth examples/06_own_depth.py:predict_depth
    gscompleter complete SCENE --out OUT --reconstructor examples/06_own_depth.py:reconstruct
    gscompleter evaluate cases.json --out OUT --depth none examples/06_own_depth.py:predict_depth

`predict_depth` gets one photograph and may be right up to an affine function of inverse depth: it
is aligned to what stereo measures. `reconstruct` gets all photographs and has to be right in scene
units. Here a slanted floor stands for a network: the lower a pixel, the nearer.
"""

from collections.abc import Sequence

import torch

import gscompleter as gsc


def predict_depth(view: gsc.View) -> gsc.DepthMap:
    """Predict z-depth [h, w] of a photograph, with a mask of the pixels where it is known."""
    height, width = view.image.shape[:2]
    near, far = view.camera.near or 1.0, view.camera.far or 10.0
    row = torch.linspace(0, 1, height, device=view.image.device)[:, None].expand(height, width)
    # Inverse depth grows linearly along a plane in the image.
    depth = 1 / torch.lerp(torch.full_like(row, 1 / far), torch.full_like(row, 1 / near), row)
    return gsc.DepthMap(depth.contiguous(), torch.ones_like(depth, dtype=torch.bool))


def predict_all(views: Sequence[gsc.View]) -> list[gsc.DepthMap]:
    """Predict the depth of each photograph, in scene units."""
    return [predict_depth(view) for view in views]


reconstruct = gsc.FromDepth(model=predict_all)
"""Ψ on top of the depth model: its depths become Gaussians that are fitted to the photographs."""
