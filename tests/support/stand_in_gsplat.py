"""The part of gsplat 1.5 that `render/gsplat.py` calls, on the reference renderer and a CPU.

Names, shapes and results are gsplat's, as far as they are used. So it tests how gsplat is called,
not gsplat itself.
"""

from __future__ import annotations

from dataclasses import replace
from importlib.machinery import ModuleSpec
from types import ModuleType

import torch
from torch import Tensor

from gscompleter.numerics.geometry import is_inside
from gscompleter.render.reference import ProjectedSplats, composite_splats, project_gaussians
from gscompleter.render.spherical_harmonics import evaluate_sh_basis
from gscompleter.types import Camera, make_observed


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
    calc_compensations: bool,
    opacities: Tensor,
) -> tuple[Tensor | None, ...]:
    """Project into one image per camera; rows of Gaussians outside are unset memory."""
    assert covars is None
    assert eps2d == 0.3
    for values in (means, quats, scales, opacities, viewmats, Ks):
        assert values.dtype == torch.float32
    count, n = len(viewmats), len(means)
    assert viewmats.shape == (count, 4, 4)
    # Colours do not matter here.
    gaussians = make_observed(means, quats, scales, opacities, torch.zeros(n, 1, 3))
    gaussians = replace(gaussians, is_antialiased=calc_compensations)
    radii = torch.zeros(count, n, 2, dtype=torch.int32)
    means2d, conics = torch.full((count, n, 2), torch.nan), torch.full((count, n, 3), torch.nan)
    depths, compensations = torch.full((count, n), torch.nan), torch.zeros(count, n)
    for number in range(count):
        pose = torch.linalg.inv(viewmats[number])
        camera = Camera(pose, Ks[number], width, height, near=100 * near_plane)
        for i in range(n):
            own = project_gaussians(gaussians[i : i + 1], camera)
            if len(own.depths) == 0 or not touches(own, camera):
                continue
            radii[number, i] = 1
            means2d[number, i], depths[number, i] = own.centers[0], own.depths[0]
            conics[number, i] = own.precisions[0].flatten()[[0, 1, 3]]
            if opacities[i] > 0:
                compensations[number, i] = own.opacities[0] / opacities[i]
    return radii, means2d, depths, conics, compensations if calc_compensations else None


def isect_tiles(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    n_images: int,
) -> tuple[None, Tensor, Tensor]:
    """List the Gaussians of each image, the nearest first, as if it were one tile."""
    assert means2d.shape == radii.shape == (n_images, depths.shape[1], 2)
    images, rows = [], []
    for image in range(n_images):
        shown = (radii[image, :, 0] > 0).nonzero()[:, 0]
        shown = shown[depths[image, shown].argsort(stable=True)]
        images.append(torch.full_like(shown, image))
        rows.append(shown + image * depths.shape[1])
    return None, torch.cat(images), torch.cat(rows).to(torch.int32)


def isect_offset_encode(
    isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int
) -> Tensor:
    """Return where the list of each image begins, for all of its tiles."""
    starts = torch.searchsorted(isect_ids, torch.arange(n_images)).to(torch.int32)
    return starts[:, None, None].expand(-1, tile_height, tile_width)


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
    count, n, channels = colors.shape
    assert means2d.shape == (count, n, 2)
    assert conics.shape == (count, n, 3)
    assert opacities.shape == (count, n)
    tiles = (-(-image_height // tile_size), -(-image_width // tile_size))
    assert isect_offsets.shape == (count, *tiles)
    x, y = torch.arange(image_width) + 0.5, torch.arange(image_height) + 0.5
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)
    ends = [*isect_offsets[1:, 0, 0].tolist(), len(flatten_ids)]
    sums, alphas = [], []
    for start, end in zip(isect_offsets[:, 0, 0].tolist(), ends, strict=True):
        order = flatten_ids[start:end].long()
        precisions = conics.flatten(0, 1)[order][:, [0, 1, 1, 2]].view(-1, 2, 2)
        # The reference sums three channels and a fourth in place of the depth.
        values = torch.nn.functional.pad(colors.flatten(0, 1)[order], (0, 4 - channels))
        splats = ProjectedSplats(
            means2d.flatten(0, 1)[order],
            precisions,
            values[:, 3],
            opacities.flatten()[order],
            values[:, :3],
        )
        colour, depth, alpha = composite_splats(splats, pixels)
        sums.append(torch.cat([colour, depth[:, None]], dim=-1)[:, :channels])
        alphas.append(alpha)
    size = (count, image_height, image_width)
    return torch.stack(sums).view(*size, -1), torch.stack(alphas).view(*size, 1)


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
        fully_fused_projection,
        isect_tiles,
        isect_offset_encode,
        rasterize_to_pixels,
        spherical_harmonics,
    ):
        setattr(made, function.__name__, function)
    return made
