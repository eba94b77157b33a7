"""What the photographs support of a scene that was brought.

The paper's hole is where alpha is low, which holds for a feed-forward scene. Somebody's trained
scene is opaque everywhere: where no photograph looked it has shreds, and where it was trained
badly it shows what the photographs do not. A Gaussian is supported, as a camera sees it, as far as
photographs taken from a similar direction look like the scene where they show it, and show as
much of it as the camera does. Counted by that, alpha is low again where nothing is known, and the
four stages go on from there.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from gscompleter.config import SupportConfig
from gscompleter.generators.robust import robust_affine
from gscompleter.geometry import z_depths
from gscompleter.render import FrozenView
from gscompleter.types import Camera, Evidence, Gaussians, Render, View

BLUR = 0.01
"""Radius over which differences of colour, and support, are averaged, of the longer side of an
image: an edge may lie a pixel aside."""
EXACT = 0.02
"""Median difference of colour up to which a scene counts as exact."""
ENOUGH = 0.5
"""Share of what a camera sees of a Gaussian that a photograph has to show for full support."""
STANDOFF = 0.5
"""Standard deviations of depth along the ray by which something new stands before what is doubted
and has to stay."""
LEAST = 1e-6
"""What a photograph from the opposite direction says, so that it still says something where no
other does."""


def gather_evidence(
    scene: Gaussians, views: Sequence[View], frozen: Sequence[FrozenView], config: SupportConfig
) -> Evidence:
    """What photographs show of each Gaussian, and how far the scene looks like them there.

    Args:
        scene: The n Gaussians.
        views: The k photographs, whose cameras know the depth range.
        frozen: The scene frozen at each of them.
        config: How different is too different.
    """
    differences = [difference(f.context, v) for f, v in zip(frozen, views, strict=True)]
    usual = torch.stack([d.median() for d in differences]).median().item()
    scale = config.max_difference * max(1.0, usual / EXACT)
    areas = scene.means.new_empty((len(scene), len(views)))
    agreement = torch.empty_like(areas)
    for k, (view, different) in enumerate(zip(views, differences, strict=True)):
        agrees = torch.exp(-((different / scale) ** 2))
        layers = torch.stack([torch.ones_like(agrees), agrees, torch.zeros_like(agrees)], dim=-1)
        sums, agreeing, _ = frozen[k].sums(layers).unbind(-1)
        areas[:, k] = sums * pixel_areas(scene.means, view.camera)
        agreement[:, k] = agreeing / sums.clamp_min(1e-9)
    return Evidence(torch.stack([view.camera.center for view in views]), areas, agreement)


def difference(render: Render, view: View) -> Float[Tensor, "h w"]:
    """Absolute difference of colour once the photograph's exposure is fitted, over a few pixels."""
    shown = render.image.clamp(0, 1)
    gain, offset = robust_affine(shown.reshape(-1, 3), view.image.reshape(-1, 3))
    return blurred((gain * shown + offset - view.image).abs().mean(dim=-1))


def support(
    evidence: Evidence,
    means: Float[Tensor, "n 3"],
    sums: Float[Tensor, "n"],
    camera: Camera,
    config: SupportConfig = SupportConfig(),
) -> Float[Tensor, "n"]:
    """How far the photographs support each Gaussian as `camera` sees it, in [0, 1].

    Args:
        evidence: What the photographs show of n Gaussians.
        means: Where these are, in world coordinates.
        sums: The sum of the compositing weights of each over the image of `camera`.
        camera: Who asks.
        config: From how far aside a photograph still tells something.
    """
    rays = normalize(means - camera.center, dim=-1)
    agreeing, weights = torch.zeros_like(sums), torch.zeros_like(sums)
    for k, center in enumerate(evidence.centers):
        rows = evidence.areas[:, k].nonzero()[:, 0]
        turn = degrees_between(normalize(means[rows] - center, dim=-1), rays[rows])
        weight = evidence.areas[rows, k] * (torch.exp(-((turn / config.max_turn) ** 2)) + LEAST)
        agreeing.index_add_(0, rows, weight * evidence.agreement[rows, k])
        weights.index_add_(0, rows, weight)
    share = (shown(evidence, means, sums, camera) / ENOUGH).clamp_max(1.0)
    return share * agreeing / weights.clamp_min(1e-20)


def degrees_between(a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Angle between unit vectors, in degrees."""
    return torch.rad2deg(torch.acos((a * b).sum(-1).clamp(-1, 1)))


def shown(
    evidence: Evidence, means: Float[Tensor, "n 3"], sums: Float[Tensor, "n"], camera: Camera
) -> Float[Tensor, "n"]:
    """How much of each Gaussian the photograph that shows most of it shows, as a share of what
    `camera` sees; large where it sees nothing. The arguments are those of `support`."""
    needed = sums * pixel_areas(means, camera)
    return evidence.areas.amax(dim=1) / needed.clamp_min(1e-20)


def weight_sums(frozen: FrozenView) -> Float[Tensor, "n"]:
    """The sum over the image of the compositing weights of each Gaussian of a frozen view."""
    return frozen.sums(torch.ones_like(frozen.context.image))[:, 0]


def believed_alpha(frozen: FrozenView, support: Float[Tensor, "n"]) -> Float[Tensor, "h w"]:
    """Alpha of a scene from a camera, each of its n Gaussians counted by its support."""
    return torch.minimum(blurred(composited(support, frozen)), frozen.context.alpha)


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
    squares = composited((z / unit).clamp_max(2.0) ** 2, frozen)
    mean = drawn.depth / unit
    spread = (squares / drawn.alpha.clamp_min(1e-6) - mean**2).clamp_min(0.0).sqrt()
    return unit * (mean - STANDOFF * spread).clamp_min(0.1 * mean)


def composited(values: Float[Tensor, "n"], frozen: FrozenView) -> Float[Tensor, "h w"]:
    """The sum over the Gaussians of compositing weight times value, from 0 up."""
    return frozen.repainted(values[:, None].expand(-1, 3))[..., 0]


def pixel_areas(means: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n"]:
    """The area that a pixel covers at each Gaussian, in squared scene units."""
    z = z_depths(means, camera)
    return z.clamp_min(0.0) ** 2 / (camera.K[0, 0] * camera.K[1, 1])


def blurred(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Means over a square of `BLUR`."""
    radius = max(round(BLUR * max(values.shape)), 1)
    pooled = avg_pool2d(values[None, None], 2 * radius + 1, 1, radius, count_include_pad=False)
    return pooled[0, 0]
