"""A Ψ whose depths are wrong as those of a learned network are, for the ablations of the paper.

    gscompleter evaluate CASES --reconstructor benchmarks/erring_psi.py:reconstruct --out OUT \
        --table ablation refinement dof alignment

Plane-sweep measures depth by cameras that are given: its scale is right, its calls agree, and
depth alignment and ray correction have nothing to mend. A network errs anew in each call.

Here each call draws one affine error of inverse depth, and each view a smooth warp. Gaussians go
along with the depth of their pixel, as those of a pixel-aligned network do. The draws follow from
the cameras and the images of a call alone, so that a run repeats byte for byte.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

import gscompleter as gsc

SCALE_DEVIATION = 0.08
"""Standard deviation of the scale of inverse depth of a call."""
SHIFT_DEVIATION = 0.03
"""Standard deviation of its shift, relative to the median inverse depth of the call."""
WARP_DEVIATION = 0.03
"""Standard deviation of the smooth relative error of the depth of each view."""
WARP_CELLS = 4
"""Independent values of this error along each side of an image."""


@dataclass(frozen=True)
class Erring:
    """Ψ: plane-sweep with the errors of a learned network."""

    inner: gsc.Reconstructor
    name: str = "plane-sweep with drawn errors"

    def __call__(self, views: Sequence[gsc.View]) -> gsc.Reconstruction:
        """Reconstruct the views, and draw the errors of this call."""
        true = self.inner(views)
        assert true.view_index is not None
        assert true.pixel_index is not None
        rng = np.random.default_rng(make_seed(views))
        inverse = torch.cat([1 / depth.depth[depth.valid] for depth in true.depths])
        scale = 1 + SCALE_DEVIATION * rng.standard_normal()
        shift = SHIFT_DEVIATION * rng.standard_normal() * float(inverse.median())

        means, scales = true.gaussians.means.clone(), true.gaussians.scales.clone()
        depths = []
        for number, (view, depth) in enumerate(zip(views, true.depths, strict=True)):
            warp = draw_warp(rng, depth.depth)
            wrong = warp / (scale / depth.depth.clamp_min(1e-6) + shift).clamp_min(1e-6)
            wrong = wrong.where(depth.valid, depth.depth)
            depths.append(replace(depth, depth=wrong))
            # A Gaussian slides along the ray of its pixel, and keeps its size in the image.
            rows = (true.view_index == number).nonzero()[:, 0]
            factors = (wrong / depth.depth.clamp_min(1e-6)).flatten()[true.pixel_index[rows]]
            center = view.camera.center
            means[rows] = center + factors[:, None] * (means[rows] - center)
            scales[rows] *= factors[:, None]
        gaussians = replace(true.gaussians, means=means, scales=scales)
        return replace(true, gaussians=gaussians, depths=tuple(depths))


def make_seed(views: Sequence[gsc.View]) -> int:
    """Make a seed of what a call is given."""
    digest = hashlib.sha256()
    for view in views:
        for part in (view.camera.c2w, view.camera.K, view.image):
            digest.update(part.detach().cpu().numpy().tobytes())
    return int.from_bytes(digest.digest()[:8], "little")


def draw_warp(rng: np.random.Generator, depth: Tensor) -> Tensor:
    """Draw a smooth field [h, w] around 1."""
    coarse = rng.standard_normal((1, 1, WARP_CELLS, WARP_CELLS)) * WARP_DEVIATION
    field = torch.from_numpy(coarse).to(depth)
    size = (depth.shape[0], depth.shape[1])
    return 1 + interpolate(field, size, mode="bicubic", align_corners=True)[0, 0]


def reconstruct(views: Sequence[gsc.View]) -> gsc.Reconstruction:
    """Reconstruct views with the errors of a learned Ψ; as a file's function this is a Ψ."""
    return Erring(gsc.load_reconstructor("plane-sweep"))(views)
