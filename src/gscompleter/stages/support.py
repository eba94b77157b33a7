"""What the photographs support of a scene that was brought.

The paper's hole is where alpha is low, which holds for a feed-forward scene. Somebody's trained
scene is opaque everywhere: where no photograph looked it has shreds, and where it was trained
badly it shows what the photographs do not. A Gaussian is supported, as a camera sees it, as far as
photographs taken from a similar direction look like the scene where they show it, and show as
much of it as the camera does. Counted by that, alpha is low again where nothing is known, and the
four stages go on from there.
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
"""Radius over which differences of colour, and support, are averaged, of the longer side of an
image: an edge may lie a pixel aside."""
SAMPLE = 10_000
"""Pixels by which the exposure of a photograph is known."""
EXACT = 0.02
"""Median difference of colour up to which a scene counts as exact."""
ENOUGH = 0.5
"""Share of what a camera sees of a Gaussian that a photograph has to show for full support."""
STANDOFF = 0.5
"""Standard deviations of depth along the ray by which something new stands before what is doubted
and has to stay."""


def gather_evidence(
    drawn: Gaussians, views: Sequence[View], frozen: Sequence[FrozenView], config: TrustConfig
) -> Evidence:
    """What photographs show of each Gaussian, and how far the scene looks like them there.

    Args:
        drawn: The m Gaussians that the scene is drawn with.
        views: The k photographs, whose cameras know the depth range.
        frozen: The same Gaussians, frozen at each of them.
        config: How different is too different.
    """
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
    told = (torch.from_numpy(array).to(drawn.means) for array in (areas, agreement))
    return Evidence(drawn.means, torch.stack([view.camera.center for view in views]), *told)


def difference(render: Render, view: View) -> Float[Tensor, "h w"]:
    """Absolute difference of colour once the photograph's exposure is fitted, over a few pixels."""
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
    """How far the photographs support each Gaussian as `camera` sees it, in [0, 1]; 1 where it sees
    nothing.

    Args:
        evidence: What the photographs show of m Gaussians.
        sums: The sum of the compositing weights of each over the image of `camera`.
        camera: Who asks.
        config: From how far aside a photograph still tells something.
    """
    seen = (evidence.areas, evidence.agreement, evidence.means, sums)
    told = map(float32, (evidence.centers, *seen))
    limits = np.float32(math.radians(config.angle_sigma)), np.float32(ENOUGH)
    values = np.empty(len(sums), np.float32)
    share(kernels.support, len(values), *told, place_of(camera), *limits, values)
    return torch.from_numpy(values).to(sums)


def place_of(camera: Camera) -> Place:
    """Where a camera stands, as the kernels want it."""
    focal = (camera.K[0, 0] * camera.K[1, 1]).item()
    return Place(float32(camera.center), float32(camera.forward), np.float32(focal))


def shown(evidence: Evidence, sums: Float[Tensor, "m"], camera: Camera) -> Float[Tensor, "m"]:
    """How much of each Gaussian the photograph that shows most of it shows, as a share of what
    `camera` sees; large where it sees nothing. The arguments are those of `support`."""
    needed = sums * pixel_areas(evidence.means, camera)
    return evidence.areas.amax(dim=0) / needed.clamp_min(1e-20)


def weight_sums(frozen: FrozenView) -> Float[Tensor, "n"]:
    """The sum over the image of the compositing weights of each Gaussian of a frozen view."""
    return frozen.sums(torch.ones_like(frozen.context.image))[:, 0]


def believed_alpha(frozen: FrozenView, support: Float[Tensor, "n"]) -> Float[Tensor, "h w"]:
    """Alpha of a scene from a camera, each of its n Gaussians counted by its support."""
    return torch.minimum(blurred(frozen.blended(support)), frozen.context.alpha)


def front(scene: Gaussians, frozen: FrozenView, camera: Camera) -> Float[Tensor, "h w"]:
    """z-depth at which something new hides most of what `scene` shows, per pixel, in scene units.

    What is unsupported is seldom a surface. Something new stands `STANDOFF` standard deviations of
    depth before the mean: nearer, photographs from aside would see it stand before the scene.

    Args:
        scene: The Gaussians.
        frozen: The same, frozen at `camera`.
        camera: Who looks.
    """
    drawn, z = frozen.context, z_depths(scene.means, camera).clamp_min(0.0)
    unit = drawn.depth.max().clamp_min(1e-12)
    squares = frozen.blended((z / unit).clamp_max(2.0) ** 2)
    mean = drawn.depth / unit
    spread = (squares / drawn.alpha.clamp_min(1e-6) - mean**2).clamp_min(0.0).sqrt()
    return unit * (mean - STANDOFF * spread).clamp_min(0.1 * mean)


def pixel_areas(means: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n"]:
    """The area that a pixel covers at each Gaussian, in squared scene units."""
    z = z_depths(means, camera)
    return z.clamp_min(0.0) ** 2 / (camera.K[0, 0] * camera.K[1, 1])


def blurred(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Means over a square of `BLUR`."""
    radius = max(round(BLUR * max(values.shape)), 1)
    pooled = avg_pool2d(values[None, None], 2 * radius + 1, 1, radius, count_include_pad=False)
    return pooled[0, 0]
