"""Photographs warped to the target camera through the depth of the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config.settings import COVERED
from gscompleter.generators.exposure import match_exposures
from gscompleter.generators.lines import continue_lines
from gscompleter.numerics.geometry import is_inside, measure_baseline, project, sample, unproject
from gscompleter.numerics.image_ops import dilate, smooth_masked
from gscompleter.numerics.smooth import continue_smoothly, fit_membrane
from gscompleter.types import Camera, GeneratorInput, Render, TensorDataclass, View

WARP_DEPTH_TOLERANCE = 0.03
"""Relative depth error at which the weight of a photograph falls to 1/e."""
NEAREST_SHARPNESS = 4.0
"""Exponent of the weights; larger values prefer the nearest photograph."""
MIN_OBSERVING_WEIGHT = 1.0
"""Smallest weight, before the exponent, of a photograph that observes a surface."""
DYNAMIC_MARGIN = 4
"""Pixels around a dynamic mask without trust in the rendered colour."""
OCCLUDER_MARGIN = 0.05
"""Smallest distance in depth to an occluder, relative to the depth of the surface."""
OCCLUSION_RADIUS = 4
"""Radius in pixels over which the mask of occluded hole pixels is averaged."""
BORDER_WIDTH = 4
"""Width in pixels around a hole that networks paint, too, as depth at its border is unsure."""
LINE_FIDELITY = 0.1
"""Weight of a line in the membrane, relative to a known pixel."""


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
    min_weight = MIN_OBSERVING_WEIGHT**NEAREST_SHARPNESS
    colours = []
    weights = []
    dynamic = torch.zeros_like(known)
    for view, render in zip(context.views, context.view_renders, strict=True):
        pixels, z = project(points, view.camera)
        visible = _compute_visibility(pixels, z, view, render)
        # The high power prefers the photograph from the most similar direction.
        weight = (visible * _compute_closeness(points, target, view)) ** NEAREST_SHARPNESS
        colours.append(sample(view.image, pixels))
        weights.append(weight * ~_touches_mask(~view.static_mask, pixels))
        if view.dynamic_mask is not None:
            dynamic |= (weight > min_weight) & _touches_mask(view.dynamic_mask, pixels)

    # Exposures are matched to the nearest photograph, which is one of the views.
    baselines = [measure_baseline(nearest.camera, view.camera) for view in context.views]
    reference = baselines.index(min(baselines))
    gains = match_exposures(colours, [known & (weight > 1) for weight in weights], reference)
    total = torch.stack(weights).sum(dim=0)
    weighted = [
        weight[..., None] * colour * gain
        for weight, colour, gain in zip(weights, colours, gains, strict=True)
    ]
    colour = torch.stack(weighted).sum(dim=0)

    # The render is over black, so its colours are divided by alpha, where that is no hole. It shows
    # where no photograph counts.
    rendered = scene.image / scene.alpha.clamp_min(context.max_alpha)[..., None]
    photo_share = (total / (total + 1e-4))[..., None]
    image = torch.lerp(rendered, colour / total.clamp_min(1e-12)[..., None], photo_share)

    # What a photograph shows is known, even if the Gaussians there are not trusted. What moved is
    # unknown, unless another photograph shows the surface.
    if context.trusted_alpha is not None:
        known = known | ((scene.alpha >= context.max_alpha) & (total > min_weight))
    known = known & ~(dilate(dynamic, DYNAMIC_MARGIN) & (total < min_weight))
    return WarpedImage(image.clamp(0, 1), known, scene.depth, torch.stack(gains))


def fill_background_first(warped: WarpedImage) -> WarpedImage:
    """Continue colours and log-depth smoothly beyond the known pixels, preferring far pixels.

    A hole beside an object usually shows the background, so the weight is the squared depth. Some
    pixel must be known.
    """
    known = warped.known.cpu()
    depth = warped.depth.cpu()
    # In multiples of the median, so that the unit of the scene does not matter.
    median = depth[known].median()
    relative = (depth / median).clamp(0.1, 10.0)
    layers = torch.cat([warped.image.cpu(), relative.log()[..., None]], dim=-1)
    filled = continue_smoothly(layers, relative**2 * known).to(warped.depth.device)
    # Known pixels keep their own depth, which the range of relative depths may have clamped.
    filled_depth = median.to(filled) * filled[..., 3].exp()
    depth = torch.where(warped.known, warped.depth, filled_depth)
    return replace(warped, image=filled[..., :3], depth=depth)


def add_unexplained(filled: WarpedImage, target: Camera, context: GeneratorInput) -> WarpedImage:
    """Show photographed content that the scene lacks in the holes of a filled image.

    Its depth is unknown, so that of the filling is used. Only photographs whose own render is
    empty in that direction count; others show an occluder.
    """
    points = unproject(filled.depth, target)
    colour = torch.zeros_like(filled.image)
    total = torch.zeros_like(filled.depth)
    for view, render, gain in zip(context.views, context.view_renders, filled.gains, strict=True):
        pixels, z = project(points, view.camera)
        empty = sample(render.alpha[..., None], pixels)[..., 0] < COVERED
        unexplained = empty & is_inside(pixels, z, view.camera) & ~filled.known
        unexplained &= ~_touches_mask(~view.static_mask, pixels)
        weight = unexplained * _compute_closeness(points, target, view) ** NEAREST_SHARPNESS
        colour = colour + weight[..., None] * gain * sample(view.image, pixels)
        total = total + weight
    is_shown = total > 0
    shown = (colour / total.clamp_min(1e-12)[..., None]).clamp(0, 1)
    image = torch.where(is_shown[..., None], shown, filled.image)
    return replace(filled, image=image, known=filled.known | is_shown)


def continue_image(
    filled: WarpedImage, target: Camera, context: GeneratorInput
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"], Float[Tensor, "h w 1"]]:
    """Continue tone and lines beyond the known pixels; returns tone, lines and their weight.

    The tone is a membrane over what is known and what lines carry. A membrane does not know depth,
    so what an object hid keeps the filling. Beyond the frame nothing was hidden and all depths
    count alike: the sky does not cover the ground.
    """
    image = filled.image.cpu()
    known = filled.known.cpu()
    occluded = find_occluded(filled, target, context).cpu()[..., None].float()
    # Averaged, so that the filling and the membrane fade into each other.
    background_share = smooth_masked(occluded, ~known, OCCLUSION_RADIUS)
    lines, weight = continue_lines(image, known)
    # What an object hid keeps the filling, so that lines do not count there.
    weight = weight[..., None] * (1 - background_share)

    # As data of the membrane, with a small weight, lines carry the tone of their ends into the hole
    # (decision 042).
    known = known[..., None]
    fidelity = torch.where(known, 1.0, LINE_FIDELITY * weight)[..., 0]
    tone = fit_membrane(torch.where(known, image, lines), fidelity)
    tone = torch.where(known, image, torch.lerp(tone, image, background_share))
    return tone, lines, weight


def warp_and_fill(nearest: View, target: Camera, context: GeneratorInput) -> WarpedImage:
    """Warp the photographs and fill the holes smoothly; the mean colour where nothing is known."""
    warped = warp_photographs(nearest, target, context)
    if not warped.known.any():
        return replace(warped, image=nearest.image.mean(dim=(0, 1)).expand_as(warped.image))
    return add_unexplained(fill_background_first(warped), target, context)


def complete_warp(nearest: View, target: Camera, context: GeneratorInput) -> WarpedImage:
    """Warp the photographs to the target and continue their tone and lines into the holes."""
    warped = warp_and_fill(nearest, target, context)
    if not warped.known.any():
        return warped
    image = torch.lerp(*continue_image(warped, target, context)).clamp(0, 1)
    return replace(warped, image=image.to(warped.image.device))


def find_occluded(
    warped: WarpedImage, target: Camera, context: GeneratorInput
) -> Bool[Tensor, "h w"]:
    """Find the pixels whose surface lies behind what some photograph shows."""
    points = unproject(warped.depth, target)
    occluded = torch.zeros_like(warped.known)
    for view, render in zip(context.views, context.view_renders, strict=True):
        pixels, z = project(points, view.camera)
        layers = torch.stack([render.depth, render.alpha], dim=-1)
        depth, alpha = sample(layers, pixels).unbind(-1)
        hides = (alpha >= COVERED) & (depth < (1 - OCCLUDER_MARGIN) * z)
        occluded |= is_inside(pixels, z, view.camera) & hides
    return occluded


def _compute_visibility(
    pixels: Float[Tensor, "h w 2"], z: Float[Tensor, "h w"], view: View, render: Render
) -> Float[Tensor, "h w"]:
    """Compute how well depth `z` matches the surface at `pixels` of a view, in [0, 1]."""
    layers = torch.stack([render.depth, render.alpha], dim=-1)
    depth, alpha = sample(layers, pixels).unbind(-1)
    error = (z - depth).abs() / (WARP_DEPTH_TOLERANCE * z.abs().clamp_min(1e-12))
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
    return 1 / (angle + 0.02)  # finite at equal rays; 0.02 are about one degree
