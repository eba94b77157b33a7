"""A tiny run of each part that has kernels, so that they are compiled.

The scene is a textured wall, parallel to the image planes of cameras side by side.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from gscompleter.config import TrustConfig
from gscompleter.generators import GeneratorRequest, load_generator
from gscompleter.image_ops import smooth_masked
from gscompleter.kernels.compiled import mark_compiled
from gscompleter.reconstructors import load_reconstructor
from gscompleter.render import load_renderer
from gscompleter.render.lod import simplify_scene
from gscompleter.trust.photometric import compute_trust, gather_observations, sum_weights
from gscompleter.types import (
    Camera,
    Gaussians,
    GeneratorInput,
    Render,
    View,
    make_observed,
    sh_from_rgb,
)

IMAGE_SIZE_PX = 64
"""Image size, in pixels."""
DISPARITY_PX = 6
"""Disparity of the wall between neighbouring cameras, in pixels."""
WALL_DEPTH = 2.0
"""Depth of the wall, in baselines."""


def make_photographs() -> list[View]:
    """Create the photographs of two cameras."""
    noise = torch.rand(
        IMAGE_SIZE_PX, IMAGE_SIZE_PX + DISPARITY_PX, 3, generator=torch.Generator().manual_seed(0)
    )
    wall = smooth_masked(noise, torch.ones(noise.shape[:2], dtype=torch.bool), 1)
    return [
        View(wall[:, DISPARITY_PX * i :][:, :IMAGE_SIZE_PX].contiguous(), make_wall_camera(i))
        for i in range(2)
    ]


def make_wall_camera(place: int) -> Camera:
    """Create a camera `place` baselines to the right."""
    c2w = torch.eye(4)
    c2w[0, 3] = place
    focal = DISPARITY_PX * WALL_DEPTH
    K = torch.tensor([[focal, 0, IMAGE_SIZE_PX / 2], [0, focal, IMAGE_SIZE_PX / 2], [0, 0, 1]])
    return Camera(c2w, K, IMAGE_SIZE_PX, IMAGE_SIZE_PX, near=WALL_DEPTH / 2, far=WALL_DEPTH * 4)


def render_with(renderer: str) -> None:
    """Render in all ways that exist, with gradients, starting with those of the models."""
    drawing, camera, gaussians = load_renderer(renderer), make_wall_camera(0), make_wall_gaussians()
    frozen = drawing.freeze(gaussians, camera)
    opacities = gaussians.opacities.clone().requires_grad_()
    means = gaussians.means.clone().requires_grad_()
    frozen.vary_opacities(gaussians)(opacities).image.sum().backward()
    grey = torch.full((IMAGE_SIZE_PX, IMAGE_SIZE_PX, 3), 0.5)
    frozen.vary_colors(gaussians)(torch.rand(len(gaussians), 3), grey)
    moved = make_observed(means, gaussians.quats, gaussians.scales, opacities, gaussians.sh)
    frozen.composite(moved).image.sum().backward()
    depths = torch.full((len(gaussians),), WALL_DEPTH, requires_grad=True)
    everywhere = torch.ones(IMAGE_SIZE_PX, IMAGE_SIZE_PX, dtype=torch.bool)
    frozen.vary_depths(gaussians, everywhere)(depths).depth.sum().backward()
    frozen.extend(gaussians)


def compute_trust_with(_: str) -> None:
    """Compute photometric trust."""
    gaussians, view, config = make_wall_gaussians(), make_photographs()[0], TrustConfig()
    frozen = load_renderer("cpu").freeze(gaussians, view.camera)
    simplify_scene(gaussians, [view.camera])
    evidence = gather_observations(gaussians, [view], [frozen], config)
    compute_trust(evidence, sum_weights(frozen), view.camera, config)


def make_wall_gaussians() -> Gaussians:
    """Create four Gaussians on the wall."""
    means = torch.tensor([[x, y, WALL_DEPTH] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    quats, grey = torch.tensor([[1.0, 0, 0, 0]] * 4), sh_from_rgb(torch.full((4, 3), 0.5))
    return make_observed(means, quats, torch.full((4, 3), 0.1), torch.full((4,), 0.5), grey)


def reconstruct_with(reconstructor: str) -> None:
    """Reconstruct the two photographs."""
    load_reconstructor(reconstructor)(make_photographs())


def synthesize_with(generator: str) -> None:
    """Synthesize a third camera's image, half of which is a hole."""
    views = make_photographs()
    seen = torch.ones(IMAGE_SIZE_PX, IMAGE_SIZE_PX)
    depth, half = WALL_DEPTH * seen, seen.clone()
    half[:, IMAGE_SIZE_PX // 2 :] = 0
    at_views = tuple(Render(view.image, depth, seen) for view in views)
    at_target = Render(views[1].image * half[..., None], depth * half, half)
    context = GeneratorInput(tuple(views), at_views, at_target)
    load_generator(generator).synthesize([GeneratorRequest(views[1], make_wall_camera(2), context)])


PARTS: dict[str, Callable[[str], None]] = {
    "cpu": render_with,
    "brought": compute_trust_with,
    "warp-inpaint": synthesize_with,
    "plane-sweep": reconstruct_with,
}


def rehearse(name: str) -> None:
    """Run a part, and record that its kernels are compiled."""
    PARTS[name](name)
    mark_compiled(name)
