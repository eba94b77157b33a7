"""Photographs warped to the target camera through the depth of the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config.settings import COVERED
from gscompleter.generators.exposure import match_exposures
from gscompleter.generators.smooth import continue_smoothly
from gscompleter.geometry import is_inside, measure_baseline, project, sample, unproject
from gscompleter.image_ops import dilate
from gscompleter.types import Camera, GeneratorInput, Render, TensorDataclass, View

DEPTH_TOLERANCE = 0.03
"""Relative depth error at which the weight of a photograph falls to 1/e."""
SHARPNESS = 4.0
"""Exponent of the weights; larger values prefer the nearest photograph."""
MIN_WEIGHT = 1.0
"""Smallest weight, before the exponent, of a photograph that observes a surface."""
DYNAMIC_MARGIN = 4
"""Pixels around a dynamic mask without trust in the rendered colour."""


OCCLUDER_MARGIN = 0.05
"""Smallest depth of a surface behind its occluder, relative to its own."""


@dataclass(frozen=True)
class WarpedImage(TensorDataclass):
    """The known part of the target image."""

    image: Float[Tensor, "h w 3"]
    known: Bool[Tensor, "h w"]
    """True at pixels that show the scene; the others are undefined."""
    depth: Float[Tensor, "h w"]
    """z-depth in the target camera in scene units, valid if known."""
    gains: Float[Tensor, "views 3"]
    """Exposure gain applied to each photograph to match the nearest one."""


def warp_photographs(nearest: View, target: Camera, context: GeneratorInput) -> WarpedImage:
    """Blend the colours of all photographs at the surfaces that the target observes.

    A photograph counts if the scene has the same depth from its camera, so that nothing occludes
    the surface. Surfaces without a photograph keep the rendered colour if it is trusted. Dynamic
    masks and their surroundings stay unknown unless another photograph shows them. All colours are
    matched to the exposure of `nearest`.
    """
    scene = context.target_render
    known = ~context.holes
    points = unproject(scene.depth, target)
    colours, weights = [], []
    dynamic = torch.zeros_like(known)
    for view, render in zip(context.views, context.view_renders, strict=True):
        pixels, z = project(points, view.camera)
        visible = _compute_visibility(pixels, z, view, render)
        shown = (visible * _compute_closeness(points, target, view)) ** SHARPNESS
        colours.append(sample(view.image, pixels))
        weights.append(shown * ~_touches_mask(~view.static_mask, pixels))
        if view.dynamic_mask is not None:
            dynamic |= (shown > MIN_WEIGHT**SHARPNESS) & _touches_mask(view.dynamic_mask, pixels)

    baselines = [measure_baseline(nearest.camera, view.camera) for view in context.views]
    reference = baselines.index(min(baselines))
    factors = match_exposures(colours, [known & (w > 1) for w in weights], reference)
    total = torch.stack(weights).sum(dim=0)
    colour = torch.stack(
        [w[..., None] * c * g for w, c, g in zip(weights, colours, factors, strict=True)]
    ).sum(dim=0)

    rendered = scene.image / scene.alpha.clamp_min(context.max_alpha)[..., None]
    trust = (total / (total + 1e-4))[..., None]
    image = torch.lerp(rendered, colour / total.clamp_min(1e-12)[..., None], trust)
    if context.trusted_alpha is not None:
        known = known | ((scene.alpha >= context.max_alpha) & (total > MIN_WEIGHT**SHARPNESS))
    known = known & ~(dilate(dynamic, DYNAMIC_MARGIN) & (total < MIN_WEIGHT**SHARPNESS))
    return WarpedImage(image.clamp(0, 1), known, scene.depth, torch.stack(factors))


def add_unexplained(warped: WarpedImage, target: Camera, context: GeneratorInput) -> WarpedImage:
    """Fill holes with photographed content that the scene lacks.

    Its depth is unknown, so the depth around the hole is continued. Only photographs whose own
    render is empty in that direction count; others show an occluder. Some pixel must be known.
    """
    guess = fill_background_first(warped, 0)[1].exp().to(warped.depth.device)
    points = unproject(guess, target)
    colour = torch.zeros_like(warped.image)
    total = torch.zeros_like(guess)
    for view, render, gain in zip(context.views, context.view_renders, warped.gains, strict=True):
        pixels, z = project(points, view.camera)
        empty = sample(render.alpha[..., None], pixels)[..., 0] < COVERED
        unexplained = empty & is_inside(pixels, z, view.camera) & ~warped.known
        unexplained &= ~_touches_mask(~view.static_mask, pixels)
        weight = unexplained * _compute_closeness(points, target, view) ** SHARPNESS
        colour = colour + weight[..., None] * gain * sample(view.image, pixels)
        total = total + weight
    found = total > 0
    shown = (colour / total.clamp_min(1e-12)[..., None]).clamp(0, 1)
    return replace(
        warped,
        image=torch.where(found[..., None], shown, warped.image),
        known=warped.known | found,
        depth=torch.where(found, guess, warped.depth),
    )


def find_occluded(
    depth: Float[Tensor, "h w"], target: Camera, context: GeneratorInput
) -> Bool[Tensor, "h w"]:
    """Find pixels whose surface at `depth` lies behind what some photograph shows."""
    points = unproject(depth, target)
    occluded = torch.zeros_like(depth, dtype=torch.bool)
    for view, render in zip(context.views, context.view_renders, strict=True):
        pixels, z = project(points, view.camera)
        shown, alpha = sample(torch.stack([render.depth, render.alpha], dim=-1), pixels).unbind(-1)
        hides = (alpha >= COVERED) & (shown < (1 - OCCLUDER_MARGIN) * z)
        occluded |= is_inside(pixels, z, view.camera) & hides
    return occluded


def fill_background_first(
    warped: WarpedImage, num_channels: int = 3
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """Continue colour channels and log-depth beyond the known pixels, preferring far pixels.

    A hole beside an object usually shows the background, so the weight is the squared depth.
    """
    known, depth = warped.known.cpu(), warped.depth.cpu()
    middle = depth[known].median()
    relative = (depth / middle).clamp(0.1, 10.0)
    layers = torch.cat([warped.image.cpu()[..., :num_channels], relative.log()[..., None]], dim=-1)
    filled = continue_smoothly(layers, relative**2 * known)
    return filled[..., :-1], filled[..., -1] + middle.log()


def _compute_visibility(
    pixels: Float[Tensor, "h w 2"], z: Float[Tensor, "h w"], view: View, render: Render
) -> Float[Tensor, "h w"]:
    """Compute how well depth `z` matches the surface at `pixels` of a view, in [0, 1]."""
    layers = torch.stack([render.depth, render.alpha], dim=-1)
    depth, alpha = sample(layers, pixels).unbind(-1)
    error = (z - depth).abs() / (DEPTH_TOLERANCE * z.abs().clamp_min(1e-12))
    visible = is_inside(pixels, z, view.camera) & (alpha >= COVERED)
    return torch.exp(-(error**2)) * visible


def _touches_mask(
    mask: Bool[Tensor, "photo_h photo_w"], pixels: Float[Tensor, "h w 2"]
) -> Bool[Tensor, "h w"]:
    """Mark `pixels` in or beside the mask of a photograph."""
    return sample(mask[..., None].float(), pixels)[..., 0] > 0


def _compute_closeness(
    points: Float[Tensor, "h w 3"], target: Camera, view: View
) -> Float[Tensor, "h w"]:
    """Compute a weight that falls with the angle between the target's and view's rays."""
    to_target = torch.nn.functional.normalize(target.center - points, dim=-1)
    to_view = torch.nn.functional.normalize(view.camera.center - points, dim=-1)
    angle = torch.acos((to_target * to_view).sum(-1).clamp(-1, 1))
    return 1 / (angle + 0.02)
