"""What a scene that somebody trained is better without: floaters, and what no photograph needs.

The image is linear in the opacity of a single Gaussian, and the squared error of a photograph is a
parabola in it. So it is known for each Gaussian, without drawing the scene anew, how each
photograph would change if that one were not there. A Gaussian goes where some photographs gain by
that several times what others lose, or where hardly any loses anything. What goes is judged twice,
in the scene as it is and in one where all of it has faded, so that a wall is not blamed for the
floater before it. At last all is judged together, by drawing: what a photograph needs is put back,
at its own size or at half of it, for a splat that was trained on small images looks right in these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gscompleter.config.cleaning import CleaningConfig
from gscompleter.progress import track
from gscompleter.render import OpacityRender, Renderer, image_of
from gscompleter.stages.harm import error_slope, error_with_loss
from gscompleter.stages.setting_aside import error_of, without_needed
from gscompleter.stages.support import weight_sums
from gscompleter.types import Gaussians, View

FADED = 0.02
"""Most opacity that is left of a Gaussian that has faded. Without any it would not be drawn, and
would tell nothing."""
LEAST = 1e-12
"""Squared error that counts as none, so that shares of it exist."""


def superfluous(
    scene: Gaussians,
    views: Sequence[View],
    renderer: Renderer,
    config: CleaningConfig = CleaningConfig(),
) -> Bool[Tensor, "n"]:
    """Which Gaussians of `scene` can be taken out of it together.

    Only what was given can; what no photograph shows stays, for nothing is known of it.

    Args:
        scene: The n Gaussians.
        views: The photographs, whose cameras know the depth range.
        renderer: Draws the scene.
        config: What is taken out, and how much worse a photograph may become.
    """
    doubtful = torch.zeros_like(scene.generated, dtype=torch.bool)
    doubtful = unwanted(scene, doubtful, views, renderer, config) & (scene.generated == 0)
    doubtful = unwanted(scene, doubtful, views, renderer, config) & doubtful
    judges = [*views, *map(halved, views)]
    allowed = [
        error_with_loss(error_of(scene, view, renderer).item(), config.tolerance) for view in judges
    ]
    taken = without_needed(scene, doubtful, judges, allowed, renderer)
    return guarded(scene, taken, judges, allowed, renderer)


def unwanted(
    scene: Gaussians,
    faded: Bool[Tensor, "n"],
    views: Sequence[View],
    renderer: Renderer,
    config: CleaningConfig,
) -> Bool[Tensor, "n"]:
    """Which Gaussians the photographs would not miss, each judged by itself where some of the
    others have `faded`."""
    generator = torch.Generator().manual_seed(0)
    gained, lost = torch.zeros_like(scene.opacities), torch.zeros_like(scene.opacities)
    equal_share = 0.0
    for view in track(views, "Weighing"):
        change = change_without(scene, faded, view, renderer, config.probes, generator)
        gained += (-change).clamp_min(0)
        lost += change.clamp_min(0)
        equal_share += 1 / max(int((change != 0).sum()), 1) / len(views)
    shown = gained + lost > 0
    return shown & (lost < gained / config.min_ratio + config.idle * equal_share)


def change_without(
    scene: Gaussians,
    faded: Bool[Tensor, "n"],
    view: View,
    renderer: Renderer,
    probes: int,
    generator: torch.Generator,
) -> Float[Tensor, "n"]:
    """How much larger the squared error of a photograph is without a Gaussian than with all of it,
    as a share of the error where some have `faded`; n is the number of Gaussians."""
    plan = renderer.freeze(scene[:0], view.camera).plan(scene)
    full = scene.opacities
    left = torch.where(faded, full.clamp_max(FADED), full)
    error, slope = error_slope(image_of(plan), view, left)
    square = mean_squares(plan, left, probes, generator)
    # The parabola about `left`, at no opacity less at full opacity.
    return (square * (left**2 - (full - left) ** 2) - slope * full) / max(error, LEAST)


def mean_squares(
    plan: OpacityRender,
    opacities: Float[Tensor, "n"],
    probes: int,
    generator: torch.Generator,
) -> Float[Tensor, "n"]:
    """Mean over the image of the squared slope of its colours in each opacity.

    Estimated without bias: summed with random signs, slopes of different pixels cancel in the
    mean of the square.
    """
    with torch.enable_grad():
        variable = opacities.detach().clone().requires_grad_()
        image = plan(variable).image
        squares = torch.zeros_like(opacities)
        for _ in range(probes):
            signs = torch.randint(0, 2, image.shape, generator=generator).to(image) * 2 - 1
            (slope,) = torch.autograd.grad((signs * image).sum(), variable, retain_graph=True)
            squares += slope**2
    return squares / probes / image.numel()


def guarded(
    scene: Gaussians,
    taken: Bool[Tensor, "n"],
    views: Sequence[View],
    allowed: Sequence[float],
    renderer: Renderer,
) -> Bool[Tensor, "n"]:
    """`taken` but for all that is shown by photographs whose error is not allowed without it.

    What is put back for one photograph may change another, so they are asked until all agree.
    """
    before = None
    while before is None or not torch.equal(taken, before):
        before = taken
        for view, error in zip(views, allowed, strict=True):
            if error_of(scene[~taken], view, renderer).item() > error:
                taken = taken & ~(weight_sums(renderer.freeze(scene, view.camera)) > 0)
    return taken


def halved(view: View) -> View:
    """A photograph at half of its size."""
    image = avg_pool2d(view.image.permute(2, 0, 1), 2).permute(1, 2, 0)
    K = view.camera.K * view.camera.K.new_tensor([[0.5], [0.5], [1.0]])
    camera = replace(view.camera, K=K, height=image.shape[0], width=image.shape[1])
    return replace(view, image=image, camera=camera, depth=None, ignored=None)
