"""Photometric trust: how well photographs confirm the Gaussians of an input splat.

The paper's hole mask thresholds alpha, but a trained splat is opaque everywhere. A Gaussian is
trusted, as seen from a camera, if photographs from similar directions match its render and show as
much of it. Alpha weighted by trust is low in unknown regions again, and the four stages apply
unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gscompleter.config import TrustConfig
from gscompleter.generators.robust import robust_affine
from gscompleter.geometry import z_depths
from gscompleter.kernels import evidence as kernels
from gscompleter.kernels.evidence import Place
from gscompleter.kernels.sharing import share, side_by_side
from gscompleter.render import FrozenView, each_view
from gscompleter.render.folded import float32
from gscompleter.threads import torch_on_one_thread
from gscompleter.types import Camera, Evidence, Gaussians, Render, View

BLUR = 0.01
"""Radius of box filters, relative to the longer side; it tolerates edges off by a pixel."""
SAMPLE = 10_000
"""Pixels that the exposure fit uses."""
EXACT = 0.02
"""Median colour difference up to which a scene counts as exact."""
ENOUGH = 0.5
"""Fraction of a Gaussian's area in a camera that a photograph has to show for full trust."""
STANDOFF = 0.5
"""Standard deviations of depth by which new Gaussians are put in front of untrusted ones."""


def gather_evidence(
    drawn: Gaussians, views: Sequence[View], frozen: Sequence[FrozenView], config: TrustConfig
) -> Evidence:
    """Measure visible area and photometric consistency of each Gaussian in each photograph."""
    with torch_on_one_thread():
        differences = side_by_side(difference, [f.context for f in frozen], views)
    usual = torch.stack([d.median() for d in differences]).median().item()
    scale = config.color_sigma * max(1.0, usual / EXACT)
    means = float32(drawn.means)
    areas, agreement = np.empty((2, len(views), len(means)), np.float32)

    def gather(k: int) -> None:
        agrees = torch.exp(-((differences[k] / scale) ** 2))
        layers = torch.stack([torch.ones_like(agrees), agrees, torch.zeros_like(agrees)], dim=-1)
        seen = (float32(frozen[k].sums(layers)), means, place_of(views[k].camera))
        share(kernels.tell, len(means), *seen, areas[k], agreement[k])

    for _ in each_view(drawn)(gather, range(len(views))):
        pass
    arrays = (torch.from_numpy(array).to(drawn.means) for array in (areas, agreement))
    return Evidence(drawn.means, torch.stack([view.camera.center for view in views]), *arrays)


def difference(render: Render, view: View) -> Float[Tensor, "h w"]:
    """Compute the absolute colour difference after an exposure fit, averaged over a few pixels."""
    shown = render.image.clamp(0, 1)
    pixels = slice(None, None, max(1, view.image[..., 0].numel() // SAMPLE))
    pairs = (image.reshape(-1, 3)[pixels] for image in (shown, view.image))
    gain, offset = robust_affine(*pairs)
    return blurred((gain * shown + offset - view.image).abs().mean(dim=-1))


def support(
    evidence: Evidence,
    sums: Float[Tensor, "m"],
    camera: Camera,
    config: TrustConfig = TrustConfig(),
) -> Float[Tensor, "m"]:
    """Compute the trust of each Gaussian from a camera: in [0, 1], 1 for invisible ones.

    `sums` are the summed compositing weights of each Gaussian in its image.
    """
    seen = (evidence.areas, evidence.agreement, evidence.means, sums)
    arrays = map(float32, (evidence.centers, *seen))
    limits = np.float32(math.radians(config.angle_sigma)), np.float32(ENOUGH)
    values = np.empty(len(sums), np.float32)
    share(kernels.support, len(values), *arrays, place_of(camera), *limits, values)
    return torch.from_numpy(values).to(sums)


def place_of(camera: Camera) -> Place:
    """Convert a camera to the form that the kernels read."""
    focal = (camera.K[0, 0] * camera.K[1, 1]).item()
    return Place(float32(camera.center), float32(camera.forward), np.float32(focal))


def shown(evidence: Evidence, sums: Float[Tensor, "m"], camera: Camera) -> Float[Tensor, "m"]:
    """Compute the largest fraction of each Gaussian's area at `camera` that a photograph shows."""
    needed = sums * pixel_areas(evidence.means, camera)
    return evidence.areas.amax(dim=0) / needed.clamp_min(1e-20)


def weight_sums(frozen: FrozenView) -> Float[Tensor, "n"]:
    """Sum the compositing weights of each Gaussian over the image."""
    return frozen.sums(torch.ones_like(frozen.context.image))[:, 0]


def believed_alpha(frozen: FrozenView, support: Float[Tensor, "n"]) -> Float[Tensor, "h w"]:
    """Render accumulated opacity with every Gaussian weighted by its trust."""
    return torch.minimum(blurred(frozen.blended(support)), frozen.context.alpha)


def front(scene: Gaussians, frozen: FrozenView, camera: Camera) -> Float[Tensor, "h w"]:
    """Compute the z-depth at which new Gaussians occlude most of `scene`, in scene units.

    Untrusted Gaussians vary in depth; `STANDOFF` deviations before the mean hide most of them.
    Nearer Gaussians would occlude the scene in photographs from the side.
    """
    render, z = frozen.context, z_depths(scene.means, camera).clamp_min(0.0)
    unit = render.depth.max().clamp_min(1e-12)
    squares = frozen.blended((z / unit).clamp_max(2.0) ** 2)
    mean = render.depth / unit
    spread = (squares / render.alpha.clamp_min(1e-6) - mean**2).clamp_min(0.0).sqrt()
    return unit * (mean - STANDOFF * spread).clamp_min(0.1 * mean)


def pixel_areas(means: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n"]:
    """Compute the area of a pixel at each Gaussian, in squared scene units."""
    z = z_depths(means, camera)
    return z.clamp_min(0.0) ** 2 / (camera.K[0, 0] * camera.K[1, 1])


def blurred(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Apply the box filter of radius `BLUR`."""
    radius = max(round(BLUR * max(values.shape)), 1)
    pooled = avg_pool2d(values[None, None], 2 * radius + 1, 1, radius, count_include_pad=False)
    return pooled[0, 0]
