"""A tiny run of each part that has kernels, so that they are compiled.

The scene is a textured wall, parallel to the image planes of cameras side by side.
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
"""Image size, in pixels."""
SHIFT = 6
"""Disparity of the wall between neighbouring cameras, in pixels."""
DEPTH = 2.0
"""Depth of the wall, in baselines."""


def photographs() -> list[View]:
    """Create the photographs of two cameras."""
    noise = torch.rand(SIDE, SIDE + SHIFT, 3, generator=torch.Generator().manual_seed(0))
    wall = smoothed(noise, torch.ones(noise.shape[:2], dtype=torch.bool), 1)
    return [View(wall[:, SHIFT * i :][:, :SIDE].contiguous(), camera_at(i)) for i in range(2)]


def camera_at(place: int) -> Camera:
    """Create a camera `place` baselines to the right."""
    c2w = torch.eye(4)
    c2w[0, 3] = place
    focal = SHIFT * DEPTH
    K = torch.tensor([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]])
    return Camera(c2w, K, SIDE, SIDE, near=DEPTH / 2, far=DEPTH * 4)


def render_with(renderer: str) -> None:
    """Render in all ways that exist, with gradients, starting with those of the models."""
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
    """Compute photometric trust, and fit the appearance of Gaussians."""
    gaussians, view, config = some_gaussians(), photographs()[0], TrustConfig()
    parameters = gaussians.opacities.clone().requires_grad_(), gaussians.sh.clone().requires_grad_()
    frozen = load_renderer("cpu").freeze(gaussians, view.camera)
    run_by_run(gaussians, [view.camera])
    evidence = gather_evidence(gaussians, [view], [frozen], config)
    support(evidence, weight_sums(frozen), view.camera, config)
    plan = frozen.plan_appearance(gaussians, view.counted)
    (
        plan(*parameters).sum() + plan.compared(view.image, view.image[..., 0])(*parameters)
    ).backward()


def some_gaussians() -> Gaussians:
    """Create four Gaussians on the wall."""
    means = torch.tensor([[x, y, DEPTH] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    quats, grey = torch.tensor([[1.0, 0, 0, 0]] * 4), sh_from_rgb(torch.full((4, 3), 0.5))
    return observed(means, quats, torch.full((4, 3), 0.1), torch.full((4,), 0.5), grey)


def reconstruct_with(reconstructor: str) -> None:
    """Reconstruct the two photographs."""
    load_reconstructor(reconstructor)(photographs())


def synthesize_with(generator: str) -> None:
    """Synthesize a third camera's image, half of which is a hole."""
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


def rehearse(name: str) -> None:
    """Run a part, and record that its kernels are compiled."""
    PARTS[name](name)
    note_compiled(name)
