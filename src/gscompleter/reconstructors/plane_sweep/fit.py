"""Fits of Gaussians to photographs: appearance for two, everything jointly for more.

Stereo gives every pixel an opaque Gaussian; views that disagree on a surface occlude each other. A
few gradient steps fade the wrong Gaussians and sharpen the colours. The depths of several views
differ by fractions of a pixel, so that their positions, sizes and rotations are fitted as well.
Each step uses one photograph.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config.settings import COVERED
from gscompleter.numerics.adam import Adam
from gscompleter.reconstructors.plane_sweep.emphasis import NUM_REFINED, Emphasis
from gscompleter.reconstructors.plane_sweep.linear_colors import fit_linear_colors
from gscompleter.render.protocols import Renderer
from gscompleter.types import DepthMap, Gaussians, View

OPACITY_STEPS = 6
"""Adam steps on the opacities of two photographs."""
FIT_OPACITY_RATE = 1.0
"""Adam step size of the opacities, in logits."""
OPACITY_BETAS = 0.7, 0.99
"""Adam decay rates of the opacities, short because there are few steps."""
REMOVAL_PENALTY = 0.01
"""Loss per unit of removed opacity; keeps Gaussians that no photograph contradicts."""

STEPS_PER_VIEW = 7
"""Number of steps of the joint fit per photograph."""
STEPS_PER_CHECK = 3
"""Number of its steps per check view, between those of the photographs."""
FIT_RATES = {"moved": 0.2, "quats": 0.0375, "grown": 0.1875, "logits": 0.75, "sh": 0.1125}
"""Initial Adam step sizes; positions are in units of the Gaussian's size."""
FINAL_RATE = 0.5
"""Final step size relative to the initial one; the decay is linear."""
BETAS = 0.8, 0.99
"""Adam decay rates of the joint fit."""
MAX_SIZE_GROWTH = 3.0
"""Largest factor by which a Gaussian grows in it; near a camera a few become a fog."""
FAINTEST = 0.02
"""Margin from 0 and 1 to which the initial opacities are clamped."""


def fit_opacities(
    gaussians: Gaussians, views: Sequence[View], renderer: Renderer
) -> tuple[Gaussians, list[DepthMap]]:
    """Minimize the L1 image difference plus a penalty on removed opacity.

    Also return the depth rendered at each view before its last step.
    """
    # Only opacities move, so that projection and depth order are computed once per view.
    nothing = gaussians[:0]
    plans = [(renderer.freeze(nothing, v.camera).vary_opacities(gaussians), v.image) for v in views]

    logits = gaussians.opacities.logit(eps=1e-4).requires_grad_()
    optimizer = Adam([(logits, FIT_OPACITY_RATE)], OPACITY_BETAS)
    # Each step has the loss of all views, estimated from one of them in turn.
    weight = REMOVAL_PENALTY * len(views) / len(gaussians)
    depths: list[DepthMap] = []
    for step in range(OPACITY_STEPS):
        plan, image = plans[step % len(plans)]
        opacities = logits.sigmoid()
        removed = (gaussians.opacities - opacities).clamp_min(0).sum()
        render = plan(opacities)
        optimizer.step(len(views) * (render.image - image).abs().mean() + weight * removed)
        depths.append(DepthMap(render.depth.detach(), render.alpha.detach() >= COVERED))
    return replace(gaussians, opacities=logits.detach().sigmoid()), depths[-len(views) :]


def fit_jointly(
    gaussians: Gaussians,
    views: Sequence[View],
    gains: Float[Tensor, "views 3"],
    renderer: Renderer,
    emphasis: Emphasis = Emphasis(),
    skies: Sequence[Bool[Tensor, "_ _"]] = (),
) -> Gaussians:
    """Minimize the squared image error, with renders scaled by each view's exposure gain.

    The images are linear in the colours, so that these are then fitted alone, by direction, to all
    views at once and without gradients. The check views of `emphasis`, in the exposure of the
    scene, are photographs that no Gaussian comes from: what looks right to `views` alone is wrong
    there. Views near its targets get further steps, and their colours count most.

    Each step is drawn before a backdrop of a random colour, in the exposure of the scene, so that
    surfaces become opaque. Before black, one that lets 5 % through only gets brighter, and what is
    added behind it shines through (decision 141). In the `skies` of the views, of which
    `gaussians` hold nothing, the photograph itself is the backdrop (decision 156).
    """
    check_views = emphasis.check_views
    order = shuffle_views(len(views), len(check_views), emphasis.find_refined(views))
    backdrops = torch.rand(len(order), 3, generator=torch.Generator().manual_seed(0)).to(gains)
    # Check views are fitted to where surfaces cover them.
    skies = [*(skies or map(find_no_sky, views)), *map(find_no_sky, check_views)]
    views = [*views, *check_views]
    gains = torch.cat([gains, gains.new_ones(len(check_views), 3)])
    unknown = init_parameters(gaussians)
    optimizer = Adam([(unknown[name], rate) for name, rate in FIT_RATES.items()], BETAS)
    for step, number in enumerate(order):
        view = views[number]
        fitted = apply_parameters(gaussians, unknown)
        render = renderer.render(fitted, view.camera)
        # In ignored pixels the scene is wanted as it was, which may be open there.
        is_open = (1 - render.alpha) * view.valid_mask
        sky_image = view.image / gains[number]
        backdrop = sky_image.where(skies[number][..., None], backdrops[step])
        image = render.image + is_open[..., None] * backdrop
        rate_factor = 1 - (1 - FINAL_RATE) * step / len(order)
        optimizer.step((gains[number] * image - view.image).square().mean(), rate_factor)
        with torch.no_grad():
            unknown["grown"].clamp_(max=math.log(MAX_SIZE_GROWTH))

    fitted = apply_parameters(gaussians, {name: v.detach() for name, v in unknown.items()})
    renders = [renderer.render(fitted, view.camera) for view in views]
    shown = []
    for view, gain, sky, render in zip(views, gains, skies, renders, strict=True):
        # The scene has one exposure, so that each photograph is divided by its own. What surfaces
        # leave open of the sky is not theirs.
        share = render.alpha.where(sky & view.valid_mask, 1.0)
        shown.append(replace(view, image=share[..., None] * view.image / gain))
    depths = [render.depth_map() for render in renders]
    weights = emphasis.weigh_colors(views)
    return fit_linear_colors(fitted, shown, depths, renderer, weights)


def find_no_sky(view: View) -> Bool[Tensor, "h w"]:
    """Return an empty mask of the size of a view."""
    return torch.zeros_like(view.image[..., 0], dtype=torch.bool)


def init_parameters(gaussians: Gaussians) -> dict[str, Tensor]:
    """Initialize the optimized parameters, with the keys of `FIT_RATES`.

    `moved` is an offset in units of the Gaussian's size and `grown` the logarithm of a factor of
    its size, so that one step size suits Gaussians of all sizes and units.
    """
    start = {
        "moved": torch.zeros_like(gaussians.means),
        "quats": gaussians.quats,
        "grown": torch.zeros_like(gaussians.scales),
        "logits": gaussians.opacities.logit(eps=FAINTEST),
        "sh": gaussians.sh,
    }
    return {name: value.detach().clone().requires_grad_() for name, value in start.items()}


def apply_parameters(gaussians: Gaussians, unknown: dict[str, Tensor]) -> Gaussians:
    """Apply the parameters of `init_parameters` to the Gaussians that they began with."""
    size = gaussians.scales.amax(dim=-1, keepdim=True)
    return replace(
        gaussians,
        means=gaussians.means + size * unknown["moved"],
        quats=unknown["quats"],
        scales=gaussians.scales * unknown["grown"].exp(),
        opacities=unknown["logits"].sigmoid(),
        sh=unknown["sh"],
    )


def shuffle_views(count: int, num_checks: int = 0, refined: Sequence[int] = ()) -> list[int]:
    """Create a random order of `count` views, `STEPS_PER_VIEW` times each, and of check views.

    These are numbered after the views, and occur `STEPS_PER_CHECK` times each, in the first rounds.
    Each round ends with steps for up to `NUM_REFINED` of the `refined` views.
    """
    generator = torch.Generator().manual_seed(0)
    order: list[int] = []
    for number in range(STEPS_PER_VIEW):
        size = count + num_checks if number < STEPS_PER_CHECK else count
        order += torch.randperm(size, generator=generator).tolist()
        if refined:
            shuffled = torch.randperm(len(refined), generator=generator).tolist()
            order += [refined[place] for place in shuffled[:NUM_REFINED]]
    return order
