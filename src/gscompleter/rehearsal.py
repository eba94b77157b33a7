"""Each part that has kernels at work once, on a tiny scene, so that they are compiled.

The scene is a textured wall, parallel to the images of cameras that stand side by side.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from gscompleter.config import TrustConfig
from gscompleter.generators import Request, load_generator
from gscompleter.interpolation import smoothed
from gscompleter.kernels.compiled import note_compiled
from gscompleter.reconstructors import load_reconstructor
from gscompleter.render import load_renderer
from gscompleter.render.proxy import run_by_run
from gscompleter.stages.support import gather_evidence, support, weight_sums
from gscompleter.types import Camera, Gaussians, Render, SceneContext, View, observed, sh_from_rgb

SIDE = 64
"""Pixels of an image."""
SHIFT = 6
"""Pixels by which the wall moves from one image to the next."""
DEPTH = 2.0
"""Of the wall, in baselines."""


def photographs() -> list[View]:
    """The wall as two cameras see it."""
    noise = torch.rand(SIDE, SIDE + SHIFT, 3, generator=torch.Generator().manual_seed(0))
    wall = smoothed(noise, torch.ones(noise.shape[:2], dtype=torch.bool), 1)
    return [View(wall[:, SHIFT * i :][:, :SIDE].contiguous(), camera_at(i)) for i in range(2)]


def camera_at(place: int) -> Camera:
    """A camera so many baselines to the right."""
    c2w = torch.eye(4)
    c2w[0, 3] = place
    focal = SHIFT * DEPTH
    K = torch.tensor([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]])
    return Camera(c2w, K, SIDE, SIDE, near=DEPTH / 2, far=DEPTH * 4)


def render_with(renderer: str) -> None:
    """Draw some Gaussians in all the ways there are, and ask for gradients: first in those in which
    models draw, which another process is about to look for."""
    drawing, camera, gaussians = load_renderer(renderer), camera_at(0), some_gaussians()
    frozen = drawing.freeze(gaussians, camera)
    opacities = gaussians.opacities.clone().requires_grad_()
    means = gaussians.means.clone().requires_grad_()
    frozen.plan(gaussians)(opacities).image.sum().backward()
    grey = torch.full((SIDE, SIDE, 3), 0.5)
    frozen.plan_colours(gaussians)(torch.rand(len(gaussians), 3), grey)
    moved = observed(means, gaussians.quats, gaussians.scales, opacities, gaussians.sh)
    frozen.composite(moved).image.sum().backward()
    depths = torch.full((len(gaussians),), DEPTH, requires_grad=True)
    everywhere = torch.ones(SIDE, SIDE, dtype=torch.bool)
    frozen.plan_depths(gaussians, everywhere)(depths).depth.sum().backward()
    frozen.extended(gaussians)


def doubt_brought(_: str) -> None:
    """Ask what supports a scene that was brought, and fit the looks of Gaussians to it."""
    gaussians, view, config = some_gaussians(), photographs()[0], TrustConfig()
    looks = gaussians.opacities.clone().requires_grad_(), gaussians.sh.clone().requires_grad_()
    frozen = load_renderer("cpu").freeze(gaussians, view.camera)
    run_by_run(gaussians, [view.camera])
    evidence = gather_evidence(gaussians, [view], [frozen], config)
    support(evidence, weight_sums(frozen), view.camera, config)
    plan = frozen.plan_appearance(gaussians, view.counted)
    (plan(*looks).sum() + plan.compared(view.image, view.image[..., 0])(*looks)).backward()


def some_gaussians() -> Gaussians:
    """Four Gaussians on the wall."""
    means = torch.tensor([[x, y, DEPTH] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    quats, grey = torch.tensor([[1.0, 0, 0, 0]] * 4), sh_from_rgb(torch.full((4, 3), 0.5))
    return observed(means, quats, torch.full((4, 3), 0.1), torch.full((4,), 0.5), grey)


def reconstruct_with(reconstructor: str) -> None:
    """Make Gaussians of the two photographs."""
    load_reconstructor(reconstructor)(photographs())


def synthesize_with(generator: str) -> None:
    """Paint what a third camera sees, half of which is a hole."""
    views = photographs()
    depth, seen = torch.full((SIDE, SIDE), DEPTH), torch.ones(SIDE, SIDE)
    half = (torch.arange(SIDE) < SIDE // 2).expand(SIDE, SIDE).float()
    at_views = tuple(Render(view.image, depth, seen) for view in views)
    at_target = Render(views[1].image * half[..., None], depth * half, half)
    context = SceneContext(tuple(views), at_views, at_target)
    load_generator(generator).synthesize([Request(views[1], camera_at(2), context)])


PARTS: dict[str, Callable[[str], None]] = {
    "cpu": render_with,
    "brought": doubt_brought,
    "warp-inpaint": synthesize_with,
    "plane-sweep": reconstruct_with,
}
"""How each part is rehearsed."""


def rehearse(name: str) -> None:
    """Rehearse a part in this process, and remember that its kernels are compiled."""
    PARTS[name](name)
    note_compiled(name)
