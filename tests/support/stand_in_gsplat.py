"""The part of gsplat 1.5 that `render/gsplat.py` calls, on the reference renderer and a CPU.

Names, shapes and results are gsplat's, as far as they are used. So it tests how gsplat is called,
not gsplat itself.
"""

from __future__ import annotations

from dataclasses import replace
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from gscompleter.geometry import is_inside
from gscompleter.render.reference import Splats, composite, project
from gscompleter.types import Camera, make_observed


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float,
    eps2d: float,
    sh_degree: int,
    packed: bool,
    render_mode: str,
    rasterize_mode: str,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Rasterize for one camera: harmonics, colour and expected depth; rows keep their order."""
    assert (eps2d, packed, render_mode) == (0.3, False, "RGB+ED")
    assert rasterize_mode in ("classic", "antialiased")
    assert colors.shape == (len(means), (sh_degree + 1) ** 2, 3)
    assert viewmats.shape == (1, 4, 4)
    camera = Camera(torch.linalg.inv(viewmats[0]), Ks[0], width, height, near=100 * near_plane)
    gaussians = make_observed(means, quats, scales, opacities, colors)
    gaussians = replace(gaussians, is_antialiased=rasterize_mode == "antialiased")
    n = len(means)
    found = {
        "radii": torch.zeros(1, n, 2, dtype=torch.int32),
        "means2d": torch.full((1, n, 2), torch.nan),
        "conics": torch.full((1, n, 3), torch.nan),
        "depths": torch.full((1, n), torch.nan),
        "opacities": opacities[None] * (rasterize_mode == "classic"),
        "tile_size": 16,
        "isect_offsets": torch.zeros(1, -(-height // 16), -(-width // 16), dtype=torch.int32),
    }
    values = torch.zeros(1, n, 4)
    for i in range(n):
        own = project(gaussians[i : i + 1], camera)
        if len(own.depths) == 0 or not touches(own, camera):
            continue
        found["radii"][0, i] = 1
        found["means2d"][0, i], found["depths"][0, i] = own.centers[0], own.depths[0]
        found["conics"][0, i] = own.precisions[0].flatten()[[0, 1, 3]]
        values[0, i] = torch.cat([own.colors[0], own.depths])
        found["opacities"][0, i] = own.opacities[0]
    found["flatten_ids"] = found["radii"][0, :, 0].nonzero()[:, 0].to(torch.int32)
    tiles = (found["tile_size"], found["isect_offsets"], found["flatten_ids"])
    places = found["means2d"], found["conics"]
    seen = found["opacities"]
    sums, alphas = rasterize_to_pixels(*places, values, seen, width, height, *tiles)
    depth = sums[..., 3:] / alphas.clamp_min(1e-10)
    return torch.cat([sums[..., :3], depth], dim=-1), alphas, found


def touches(splats: Splats, camera: Camera) -> bool:
    """Return True if the box of a single splat reaches the image."""
    covariance = torch.linalg.inv(splats.precisions[0])
    reach = 3.33 * covariance.diagonal().sqrt()
    size = torch.tensor([camera.width, camera.height])
    nearest = splats.centers.clamp(min=torch.zeros(2), max=size - 0.5)
    assert is_inside(nearest, splats.depths, camera).all()
    return bool(((splats.centers[0] - nearest[0]).abs() < reach).all())


def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[Tensor, Tensor]:
    """Sum four channels by weight, and the weights, of the Gaussians in `flatten_ids`."""
    n = means2d.shape[1]
    assert means2d.shape == (1, n, 2)
    assert conics.shape == (1, n, 3)
    assert colors.shape == (1, n, 4)
    assert opacities.shape == (1, n)
    assert isect_offsets.shape == (1, -(-image_height // tile_size), -(-image_width // tile_size))
    ids = flatten_ids.long()
    order = ids[colors[0, ids, 3].argsort(stable=True)]
    precisions = conics[0, order][:, [0, 1, 1, 2]].view(-1, 2, 2)
    values = colors[0, order]
    splats = Splats(means2d[0, order], precisions, values[:, 3], opacities[0, order], values[:, :3])
    x, y = torch.arange(image_width) + 0.5, torch.arange(image_height) + 0.5
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)
    colour, depth, alpha = composite(splats, pixels)
    size = (1, image_height, image_width)
    return torch.cat([colour, depth[:, None]], dim=-1).view(*size, 4), alpha.view(*size, 1)


def module() -> ModuleType:
    """Make a module named gsplat of it."""
    made = ModuleType("gsplat")
    made.__spec__ = ModuleSpec("gsplat", None)
    made.rasterization, made.rasterize_to_pixels = rasterization, rasterize_to_pixels
    return made
