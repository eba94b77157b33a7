"""Scenes that all renderers draw alike, and the gradients that are compared."""

from dataclasses import replace
from functools import cache

import torch

from gscompleter import Camera, Gaussians, load_renderer
from scenes import Room, camera_at, gaussians_of, random_gaussians, view_of

CAMERA = camera_at(size=48)
REFERENCE = load_renderer("reference")
PARAMETERS = ("means", "quats", "scales", "opacities", "sh")


def in_dtype(gaussians: Gaussians, dtype: torch.dtype) -> Gaussians:
    return replace(gaussians, **{n: getattr(gaussians, n).to(dtype) for n in PARAMETERS})


def strange(sh_degree: int = 0) -> Gaussians:
    """Make Gaussians behind, before the near plane, outside, transparent, huge and tiny."""
    gaussians = random_gaussians(60, seed=4, sh_degree=sh_degree)
    gaussians.means[0:5, 2] = -2.0
    gaussians.means[5:10, 2] = 0.003
    gaussians.means[10:15, 0] += 3.0
    gaussians.opacities[15:20] = 0.0
    gaussians.scales[20:24] = torch.tensor([4.0, 3.0, 2.0])
    gaussians.scales[24:29] = 1e-7
    gaussians.quats[30:40] *= 37.0
    return gaussians


def smooth(gaussians: Gaussians) -> Gaussians:
    """Avoid parameters without comparable gradients: round Gaussians, and the kink at black."""
    flat = gaussians.scales * torch.tensor([1.2, 1.0, 0.5])
    turned = gaussians.quats + torch.tensor([0.0, 0.3, -0.2, 0.4])
    return replace(gaussians, sh=0.9 * gaussians.sh, scales=flat, quats=turned)


SCENES = {
    "random": random_gaussians(300),
    "harmonics": random_gaussians(200, seed=1, sh_degree=3),
    "strange": strange(),
    "strange-harmonics": strange(sh_degree=2),
    "room": smooth(gaussians_of(view_of(Room(), camera_at(0.2, size=24)))),
}
SCENES |= {
    f"antialiased-{name}": replace(SCENES[name], is_antialiased=True)
    for name in ("random", "harmonics", "strange", "room")
}


@cache
def find_covered_pixels(name: str) -> torch.Tensor:
    """Find the pixels of a scene whose depth is compared.

    The reference in float64 decides for all renderers: where alpha is at the threshold up to
    rounding, two renderers that decide by themselves would compare different pixels.
    """
    return REFERENCE.render(in_dtype(SCENES[name], torch.float64), CAMERA).alpha > 0.05


def compute_gradients(
    renderer, gaussians: Gaussians, covered: torch.Tensor, camera=CAMERA
) -> dict[str, torch.Tensor]:
    """Compute gradients of a fixed random weighting of image, depth and alpha.

    The depth counts in the `covered` pixels [h, w].
    """
    leaves = {n: getattr(gaussians, n).detach().clone().requires_grad_() for n in PARAMETERS}
    render = renderer.render(replace(gaussians, **leaves), camera)
    generator = torch.Generator().manual_seed(9)
    weight = torch.randn(camera.height, camera.width, 5, generator=generator).to(render.image)
    covered = covered.to(render.image)
    loss = (render.image * weight[..., :3]).sum() + (render.alpha * weight[..., 3]).sum()
    loss = loss + (render.depth * weight[..., 4] * covered).sum()
    return dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())), strict=True))


def beside(camera: Camera) -> Gaussians:
    """Make Gaussians that are long in depth, in the image of a camera and on all sides beside it.

    A renderer that clamps their tangents elsewhere draws others.
    """
    gaussians = random_gaussians(60, seed=11, sh_degree=1)
    depths = 2.0 + gaussians.means[:, 2].frac().abs()
    # From the centre of the image to 60 % of its size beyond its border
    tangents = torch.linspace(0.0, 1.1, 60)[:, None] * camera.width / camera.K.diagonal()[:2]
    angles = 2.4 * torch.arange(60)
    directions = torch.stack([angles.cos(), angles.sin()], dim=-1)
    points = torch.cat([tangents * directions, torch.ones(60, 1)], dim=-1) * depths[:, None]
    means = camera.center + points @ camera.c2w[:3, :3].T
    long = gaussians.scales * torch.tensor([1.0, 1.0, 5.0])
    turned = torch.nn.functional.normalize(
        torch.tensor([1.0, 0.0, 0.0, 0.0]) + 0.1 * gaussians.quats, dim=-1
    )
    return replace(gaussians, means=means, scales=long, quats=turned)
