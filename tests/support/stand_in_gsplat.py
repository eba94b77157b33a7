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

from gscompleter.numerics.geometry import is_inside
from gscompleter.render.reference import ProjectedSplats, composite_splats, project_gaussians
from gscompleter.render.spherical_harmonics import evaluate_sh_basis
from gscompleter.types import Camera, make_observed, sh_from_rgb


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
    sh_degree: None,
    packed: bool,
    render_mode: str,
    rasterize_mode: str,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Rasterize for one camera: colour and expected depth; rows keep their order."""
    assert (sh_degree, eps2d, packed, render_mode) == (None, 0.3, False, "RGB+ED")
    assert rasterize_mode in ("classic", "antialiased")
    assert colors.shape == (len(means), 3)
    assert viewmats.shape == (1, 4, 4)
    for values in (means, quats, scales, opacities, colors, viewmats, Ks):
        assert values.dtype == torch.float32
    camera = Camera(torch.linalg.inv(viewmats[0]), Ks[0], width, height, near=100 * near_plane)
    gaussians = make_observed(means, quats, scales, opacities, sh_from_rgb(colors))
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
        own = project_gaussians(gaussians[i : i + 1], camera)
        if len(own.depths) == 0 or not touches(own, camera):
            continue
        found["radii"][0, i] = 1
        found["means2d"][0, i], found["depths"][0, i] = own.centers[0], own.depths[0]
        found["conics"][0, i] = own.precisions[0].flatten()[[0, 1, 3]]
        values[0, i] = torch.cat([own.colors[0], own.depths])
        found["opacities"][0, i] = own.opacities[0]
    shown = found["radii"][0, :, 0].nonzero()[:, 0]
    nearest_first = found["depths"][0, shown].argsort(stable=True)
    found["flatten_ids"] = shown[nearest_first].to(torch.int32)
    tiles = (found["tile_size"], found["isect_offsets"], found["flatten_ids"])
    places = found["means2d"], found["conics"]
    seen = found["opacities"]
    sums, alphas = rasterize_to_pixels(*places, values, seen, width, height, *tiles)
    depth = sums[..., 3:] / alphas.clamp_min(1e-10)
    return torch.cat([sums[..., :3], depth], dim=-1), alphas, found


def touches(splats: ProjectedSplats, camera: Camera) -> bool:
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
    """Sum channels by weight, and the weights, of the Gaussians in `flatten_ids`."""
    n = means2d.shape[1]
    assert means2d.shape == (1, n, 2)
    assert conics.shape == (1, n, 3)
    assert colors.shape[:2] == (1, n)
    assert opacities.shape == (1, n)
    assert isect_offsets.shape == (1, -(-image_height // tile_size), -(-image_width // tile_size))
    order = flatten_ids.long()
    precisions = conics[0, order][:, [0, 1, 1, 2]].view(-1, 2, 2)
    # The reference sums three channels and a fourth in place of the depth.
    values = torch.nn.functional.pad(colors[0, order], (0, 4 - colors.shape[2]))
    splats = ProjectedSplats(
        means2d[0, order], precisions, values[:, 3], opacities[0, order], values[:, :3]
    )
    x, y = torch.arange(image_width) + 0.5, torch.arange(image_height) + 0.5
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)
    colour, depth, alpha = composite_splats(splats, pixels)
    size = (1, image_height, image_width)
    sums = torch.cat([colour, depth[:, None]], dim=-1)[:, : colors.shape[2]]
    return sums.view(*size, -1), alpha.view(*size, 1)


def fully_fused_projection(
    means: Tensor,
    covars: None,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float,
    near_plane: float,
    opacities: Tensor,
) -> tuple[Tensor, ...]:
    """Return the radii of Gaussians in the image, and unset memory for all else."""
    colors = torch.zeros_like(means)
    _, _, found = rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, eps2d,
        None, False, "RGB+ED", "classic",
    )  # fmt: skip
    unset = torch.full((1, len(means), 1), torch.nan)
    return found["radii"], unset, unset, unset, unset


def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor) -> Tensor:
    """Evaluate harmonics in directions of any length, without the offset of 3DGS."""
    assert dirs.dtype == coeffs.dtype == torch.float32
    assert coeffs.shape == (len(dirs), (degrees_to_use + 1) ** 2, 3)
    basis = evaluate_sh_basis(torch.nn.functional.normalize(dirs, dim=-1), coeffs.shape[1])
    return torch.einsum("nk,nkc->nc", basis, coeffs)


def module() -> ModuleType:
    """Make a module named gsplat of it."""
    made = ModuleType("gsplat")
    made.__spec__ = ModuleSpec("gsplat", None)
    for function in (
        rasterization,
        rasterize_to_pixels,
        fully_fused_projection,
        spherical_harmonics,
    ):
        setattr(made, function.__name__, function)
    return made
