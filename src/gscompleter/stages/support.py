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
from gscompleter.render import Renderer
from gscompleter.types import SH_C0, Camera, Evidence, Gaussians, Render, View, observed

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
    scene: Gaussians, views: Sequence[View], renderer: Renderer, config: SupportConfig
) -> Evidence:
    """What photographs show of each Gaussian, and how far the scene looks like them there.

    Args:
        scene: The n Gaussians.
        views: The k photographs, whose cameras know the depth range.
        renderer: Draws the scene.
        config: How different is too different.
    """
    differences = [difference(renderer.render(scene, v.camera), v) for v in views]
    usual = torch.stack([d.median() for d in differences]).median().item()
    scale = config.max_difference * max(1.0, usual / EXACT)
    columns = []
    for view, different in zip(views, differences, strict=True):
        agrees = torch.exp(-((different / scale) ** 2))
        layers = torch.stack([torch.ones_like(agrees), agrees], dim=-1)
        shown, agreeing = pixel_sums(scene, view.camera, renderer, layers).unbind(-1)
        columns.append((shown * pixel_areas(scene, view.camera), agreeing / shown.clamp_min(1e-9)))
    areas, agreement = zip(*columns, strict=True)
    centers = torch.stack([view.camera.center for view in views])
    return Evidence(centers, torch.stack(areas, dim=1), torch.stack(agreement, dim=1))


def difference(render: Render, view: View) -> Float[Tensor, "h w"]:
    """Absolute difference of colour once the photograph's exposure is fitted, over a few pixels."""
    shown = render.image.clamp(0, 1)
    gain, offset = robust_affine(shown.reshape(-1, 3), view.image.reshape(-1, 3))
    return blurred((gain * shown + offset - view.image).abs().mean(dim=-1))


def support(
    evidence: Evidence,
    scene: Gaussians,
    camera: Camera,
    renderer: Renderer,
    config: SupportConfig = SupportConfig(),
) -> Float[Tensor, "n"]:
    """How far the photographs support each Gaussian as `camera` sees it, in [0, 1].

    Args:
        evidence: What the photographs show of `scene`.
        scene: The n Gaussians.
        camera: Who asks.
        renderer: Draws the scene.
        config: From how far aside a photograph still tells something.
    """
    rays = normalize(scene.means - camera.center, dim=-1)
    agreeing, weights = torch.zeros_like(rays[:, 0]), torch.zeros_like(rays[:, 0])
    for k, center in enumerate(evidence.centers):
        rows = evidence.areas[:, k].nonzero()[:, 0]
        turn = degrees_between(normalize(scene.means[rows] - center, dim=-1), rays[rows])
        weight = evidence.areas[rows, k] * (torch.exp(-((turn / config.max_turn) ** 2)) + LEAST)
        agreeing.index_add_(0, rows, weight * evidence.agreement[rows, k])
        weights.index_add_(0, rows, weight)
    share = (shown(evidence, scene, camera, renderer) / ENOUGH).clamp_max(1.0)
    return share * agreeing / weights.clamp_min(1e-20)


def degrees_between(a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Angle between unit vectors, in degrees."""
    return torch.rad2deg(torch.acos((a * b).sum(-1).clamp(-1, 1)))


def shown(
    evidence: Evidence, scene: Gaussians, camera: Camera, renderer: Renderer
) -> Float[Tensor, "n"]:
    """How much of each Gaussian the photograph that shows most of it shows, as a share of what
    `camera` sees; large where it sees nothing."""
    layers = torch.ones((camera.height, camera.width, 1), device=scene.means.device)
    needed = pixel_sums(scene, camera, renderer, layers)[:, 0] * pixel_areas(scene, camera)
    return evidence.areas.amax(dim=1) / needed.clamp_min(1e-20)


def believed_alpha(
    drawn: Render,
    scene: Gaussians,
    support: Float[Tensor, "n"],
    camera: Camera,
    renderer: Renderer,
) -> Float[Tensor, "h w"]:
    """Alpha of `scene` as `camera` sees it, each Gaussian counted by its support.

    `drawn` is the same scene from the same camera.
    """
    return torch.minimum(blurred(composited(support, scene, camera, renderer)), drawn.alpha)


def front(
    scene: Gaussians, drawn: Render, camera: Camera, renderer: Renderer
) -> Float[Tensor, "h w"]:
    """z-depth at which something new hides most of what `scene` shows, per pixel, in scene units.

    What is unsupported is seldom a surface. Something new stands `STANDOFF` standard deviations of
    depth before the mean: nearer, photographs from aside would see it stand before the scene.
    """
    z = z_depths(scene.means, camera).clamp_min(0.0)
    unit = drawn.depth.max().clamp_min(1e-12)
    squares = composited((z / unit).clamp_max(2.0) ** 2, scene, camera, renderer)
    mean = drawn.depth / unit
    spread = (squares / drawn.alpha.clamp_min(1e-6) - mean**2).clamp_min(0.0).sqrt()
    return unit * (mean - STANDOFF * spread).clamp_min(0.1 * mean)


def composited(
    values: Float[Tensor, "n"], scene: Gaussians, camera: Camera, renderer: Renderer
) -> Float[Tensor, "h w"]:
    """The sum over the Gaussians of compositing weight times value in [0, 1]."""
    sh = ((values - 0.5) / SH_C0)[:, None, None].expand(-1, 1, 3)
    return renderer.render(coloured(scene, sh), camera).image.mean(dim=-1)


def pixel_sums(
    scene: Gaussians, camera: Camera, renderer: Renderer, layers: Float[Tensor, "h w c"]
) -> Float[Tensor, "n c"]:
    """The sum of each of up to three layers over the image, by the weights of each Gaussian.

    A compositing weight is the slope of a pixel's colour in the colour of the Gaussian.
    """
    weights = torch.nn.functional.pad(layers, (0, 3 - layers.shape[-1]))
    plan = renderer.freeze(scene[:0], camera).plan_colours(scene)
    with torch.enable_grad():
        colours = scene.means.new_full((len(scene), 3), 0.5).requires_grad_()
        (slope,) = torch.autograd.grad((weights * plan(colours).image).sum(), colours)
    return slope[:, : layers.shape[-1]]


def coloured(scene: Gaussians, sh: Float[Tensor, "n 1 3"]) -> Gaussians:
    """The same Gaussians in other colours."""
    return observed(scene.means, scene.quats, scene.scales, scene.opacities, sh)


def pixel_areas(scene: Gaussians, camera: Camera) -> Float[Tensor, "n"]:
    """The area that a pixel covers at each Gaussian, in squared scene units."""
    z = z_depths(scene.means, camera)
    return z.clamp_min(0.0) ** 2 / (camera.K[0, 0] * camera.K[1, 1])


def blurred(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Means over a square of `BLUR`."""
    radius = max(round(BLUR * max(values.shape)), 1)
    pooled = avg_pool2d(values[None, None], 2 * radius + 1, 1, radius, count_include_pad=False)
    return pooled[0, 0]
