"""Carry all photographs into the target camera, through the depth of the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.coverage import COVERED
from gscompleter.generators.harmonize import gains
from gscompleter.generators.smooth import continued
from gscompleter.geometry import baseline_between, inside, project, sample, unproject
from gscompleter.masks import dilate
from gscompleter.types import Camera, Render, SceneContext, View

DEPTH_TOLERANCE = 0.03
"""Difference between the depth of a point and the depth that a photograph sees in its direction,
relative to the depth, at which the weight of the photograph has fallen to 1/e."""
SHARPNESS = 4.0
"""Power of the weights: larger ones prefer the nearest photograph to the average."""
SHOWN = 1.0
"""Weight of a photograph, before that power, from which it shows a surface: as much as one at its
depth that looks from a radian aside."""
AROUND = 4
"""Pixels around what moved in which the colour of the render is not believed: at its edges no depth
is right."""


@dataclass(frozen=True)
class Warped:
    """What is known of the target image."""

    image: Float[Tensor, "h w 3"]
    known: Bool[Tensor, "h w"]
    """True where the image shows the scene; elsewhere it means nothing."""
    depth: Float[Tensor, "h w"]
    """z-depth in the target camera, in scene units, where known."""
    gains: tuple[Float[Tensor, "3"], ...]
    """Factor that each photograph was multiplied by to match the nearest one."""

    def to(self, device: torch.device | str) -> Warped:
        return Warped(
            self.image.to(device),
            self.known.to(device),
            self.depth.to(device),
            tuple(gain.to(device) for gain in self.gains),
        )


def warp_photographs(nearest: View, target: Camera, context: SceneContext) -> Warped:
    """Colours of all photographs at the surfaces that the target sees.

    A photograph counts where the scene, seen from its camera, lies at the depth of the surface:
    elsewhere something stands before it. What no photograph shows keeps the colour of the render,
    where this is believed; where it is not, a hole remains unless a photograph shows the surface.
    What only contradicted photographs show is not known, for it moved or something moved before it,
    nor is what none shows around that.
    All are brought to the exposure of `nearest`.
    """
    scene = context.at_target
    known = ~context.holes
    points = unproject(scene.depth, target)
    colours, weights = [], []
    in_doubt = torch.zeros_like(known)
    for view, render in zip(context.views, context.at_views, strict=True):
        pixels, z = project(points, view.camera)
        visible = _visibility(pixels, z, view, render)
        shown = (visible * _closeness(points, target, view)) ** SHARPNESS
        colours.append(sample(view.image, pixels))
        weights.append(shown * _trusted(view, pixels))
        in_doubt |= (shown > SHOWN**SHARPNESS) & _contradicted(view, pixels)

    baselines = [baseline_between(nearest.camera, view.camera) for view in context.views]
    reference = baselines.index(min(baselines))
    factors = gains(colours, [known & (w > 1) for w in weights], reference)
    total = torch.stack(weights).sum(dim=0)
    colour = torch.stack(
        [w[..., None] * c * g for w, c, g in zip(weights, colours, factors, strict=True)]
    ).sum(dim=0)

    rendered = scene.image / scene.alpha.clamp_min(context.max_alpha)[..., None]
    trust = (total / (total + 1e-4))[..., None]
    image = torch.lerp(rendered, colour / total.clamp_min(1e-12)[..., None], trust)
    if context.believed is not None:
        known = known | ((scene.alpha >= context.max_alpha) & (total > SHOWN**SHARPNESS))
    known = known & ~(dilate(in_doubt, AROUND) & (total < SHOWN**SHARPNESS))
    return Warped(image.clamp(0, 1), known, scene.depth, tuple(factors))


def with_unexplained(warped: Warped, target: Camera, context: SceneContext) -> Warped:
    """`warped`, and in its holes what photographs show although the scene has a hole there too.

    A scene may lack surfaces that were photographed: captured from too few sides, or trimmed. Their
    depth is unknown, so they are carried over at the depth that continues what surrounds the hole.
    Only photographs whose own view of the scene is empty in that direction take part: elsewhere
    they show what stands before the hole. Something must be known.
    """
    guess = depth_continued(warped).exp().to(warped.depth.device)
    points = unproject(guess, target)
    colour = torch.zeros_like(warped.image)
    total = torch.zeros_like(guess)
    for view, render, gain in zip(context.views, context.at_views, warped.gains, strict=True):
        pixels, z = project(points, view.camera)
        empty = sample(render.alpha[..., None], pixels)[..., 0] < COVERED
        unexplained = empty & inside(pixels, z, view.camera) & ~warped.known
        unexplained = unexplained & _trusted(view, pixels)
        weight = unexplained * _closeness(points, target, view) ** SHARPNESS
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


def background_first(warped: Warped) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """The image and its log-depth, continued smoothly beyond what is known.

    A hole beside an object is where the object hid what stands behind it, so the farther side of
    its border counts more: with the square of its depth.
    """
    log_depth, weight, middle = _relative_depth(warped)
    layers = continued(torch.cat([warped.image.cpu(), log_depth], dim=-1), weight)
    return layers[..., :3], layers[..., 3] + middle


def depth_continued(warped: Warped) -> Float[Tensor, "h w"]:
    """The log-depth that `background_first` tells, alone."""
    log_depth, weight, middle = _relative_depth(warped)
    return continued(log_depth, weight)[..., 0] + middle


def _relative_depth(
    warped: Warped,
) -> tuple[Float[Tensor, "h w 1"], Float[Tensor, "h w"], Float[Tensor, ""]]:
    """Log-depth relative to the middle one, how much it counts, and the middle one's logarithm."""
    known, depth = warped.known.cpu(), warped.depth.cpu()
    middle = depth[known].median()
    relative = (depth / middle).clamp(0.1, 10.0)
    return relative.log()[..., None], relative**2 * known, middle.log()


def _visibility(
    pixels: Float[Tensor, "h w 2"], z: Float[Tensor, "h w"], view: View, render: Render
) -> Float[Tensor, "h w"]:
    """1 where the point at depth `z` is what the photograph shows at `pixels`, towards 0 else."""
    layers = torch.stack([render.depth, render.alpha], dim=-1)
    depth, alpha = sample(layers, pixels).unbind(-1)
    error = (z - depth).abs() / (DEPTH_TOLERANCE * z.abs().clamp_min(1e-12))
    visible = inside(pixels, z, view.camera) & (alpha >= COVERED)
    return torch.exp(-(error**2)) * visible


def _trusted(view: View, pixels: Float[Tensor, "h w 2"]) -> Bool[Tensor, "h w"]:
    """Where a photograph may be followed at `pixels`, and beside them."""
    return sample((~view.trusted)[..., None].float(), pixels)[..., 0] == 0


def _contradicted(view: View, pixels: Float[Tensor, "h w 2"]) -> Bool[Tensor, "h w"]:
    """Where others contradict a photograph at `pixels`, or beside them."""
    if view.contradicted is None:
        return torch.zeros_like(pixels[..., 0], dtype=torch.bool)
    return sample(view.contradicted[..., None].float(), pixels)[..., 0] > 0


def _closeness(points: Float[Tensor, "h w 3"], target: Camera, view: View) -> Float[Tensor, "h w"]:
    """1 where target and photograph look at a point along the same ray, less the more they turn."""
    to_target = torch.nn.functional.normalize(target.center - points, dim=-1)
    to_view = torch.nn.functional.normalize(view.camera.center - points, dim=-1)
    angle = torch.acos((to_target * to_view).sum(-1).clamp(-1, 1))
    return 1 / (angle + 0.02)
