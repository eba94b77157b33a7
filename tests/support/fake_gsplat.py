"""gsplat on the fake CUDA device: its own Python, with small kernels for its compiled module.

The kernels compute what gsplat 1.5.3's do: tiles of any size, boxes by opacity, float32 alone,
contiguous inputs. Where the real ones leave memory unset (rows of Gaussians that no tile names)
they put NaN. Projection and harmonics are gsplat's own functions for torch.
"""

from __future__ import annotations

import importlib.util
import math
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numba
import numpy as np
import torch
from torch import Tensor

from fake_cuda import FakeCudaTensor, fake_cuda, get_device
from gscompleter.render.gsplat_kernels import explain_missing_renderer
from paths import ROOT

WHEEL = "gsplat-1.5.3-py3-none-any.whl"
FOLDERS = (ROOT / os.environ.get("WHEELS", ".whl"), Path(sys.prefix) / "wheels")
"""Where the wheel may lie: carried along (benchmarks/fetch_gpu_wheels.sh), or fetched for tests."""
MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4
MAX_SIGMA = 3.33
"""Half the side of a Gaussian's box, in standard deviations: alpha 1 falls to 1/255 there."""


def find_gsplat() -> Path | None:
    """Find the folder or wheel to import gsplat from, or None."""
    return find_package("gsplat", WHEEL)


def find_package(name: str, wheel: str) -> Path | None:
    """Find the folder or wheel to import a package of Python alone from, or None."""
    installed = importlib.util.find_spec(name)
    if installed is not None and installed.origin is not None:
        return Path(installed.origin).parents[1]
    return next((folder / wheel for folder in FOLDERS if (folder / wheel).is_file()), None)


@contextmanager
def fake_gsplat() -> Iterator[Any]:
    """Let gsplat draw on the fake CUDA device inside the block; yield what the device counts."""
    place = find_gsplat()
    assert place is not None
    kernels = ModuleType("gsplat.csrc")
    for kernel in (
        projection_ewa_3dgs_fused_fwd,
        projection_ewa_3dgs_fused_bwd,
        intersect_tile,
        intersect_offset,
        rasterize_to_pixels_3dgs_fwd,
        rasterize_to_pixels_3dgs_bwd,
        spherical_harmonics_fwd,
        spherical_harmonics_bwd,
    ):
        setattr(kernels, kernel.__name__, kernel)
    # gsplat looks for each part of "CameraModelType.PINHOLE" in the module itself.
    vars(kernels).update(CameraModelType=CameraModelType, PINHOLE=CameraModelType.PINHOLE)
    others = remove_gsplat()
    explain_missing_renderer.cache_clear()
    try:
        sys.modules["gsplat.csrc"] = kernels
        with patch.object(sys, "path", [str(place), *sys.path]), fake_cuda() as counts:
            yield counts
    finally:
        remove_gsplat()
        sys.modules.update(others)
        explain_missing_renderer.cache_clear()


def remove_gsplat() -> dict[str, ModuleType]:
    """Remove gsplat from the loaded modules, and return what was removed."""
    names = [name for name in sys.modules if name.partition(".")[0] == "gsplat"]
    return {name: sys.modules.pop(name) for name in names}


class CameraModelType(Enum):
    """The cameras that gsplat knows; ours are all of the first kind."""

    PINHOLE = 0


def check_inputs(**tensors: Tensor | None) -> list[Any]:
    """Check tensors as the compiled module does; return their values.

    Raises:
        RuntimeError: a tensor is not on the device, not contiguous, or holds float64.
    """
    values = []
    for name, tensor in tensors.items():
        if tensor is None:
            values.append(None)
            continue
        if not isinstance(tensor, FakeCudaTensor):
            raise RuntimeError(f"{name} must be a CUDA tensor")
        if not tensor.is_contiguous():
            raise RuntimeError(f"{name} must be contiguous")
        if tensor.dtype in (torch.float64, torch.float16, torch.bfloat16):
            raise RuntimeError(f"expected scalar type Float but found {tensor.dtype} in {name}")
        values.append(tensor.values)
    return values


@contextmanager
def run_kernels(count: int = 1) -> Iterator[None]:
    """Count kernels, and compute on the values without counting each operation."""
    get_device().counts.launch(count)
    with torch._C.DisableTorchFunction(), torch._C._DisableTorchDispatch():
        yield


def project(
    means: Tensor,
    shapes: Sequence[Tensor],
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Project Gaussians by gsplat's functions for torch: centres, depths, conics, compensations.

    `shapes` are upper triangles of covariances, or quaternions and scales.
    """
    from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

    if len(shapes) == 1:
        covariances = shapes[0][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3)
    else:
        covariances, _ = _quat_scale_to_covar_preci(*shapes, True, False, triu=False)
    _, means2d, depths, conics, compensations = _fully_fused_projection(
        means, covariances, viewmats, Ks, width, height, eps2d, calc_compensations=True
    )
    return means2d, depths, conics, compensations


def projection_ewa_3dgs_fused_fwd(
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    calc_compensations: bool,
    camera_model: CameraModelType,
) -> tuple[Tensor | None, ...]:
    """Project Gaussians [n] into images [c]; rows of those outside are unset."""
    assert camera_model is CameraModelType.PINHOLE
    shapes = list_shapes(covars, quats, scales)
    centers, *cameras, own_opacities = check_inputs(
        means=means, viewmats=viewmats, Ks=Ks, opacities=opacities
    )
    with run_kernels(1 + calc_compensations), torch.no_grad():
        means2d, depths, conics, compensations = project(
            centers, shapes, *cameras, width, height, eps2d
        )
        determinants = conics[..., 0] * conics[..., 2] - conics[..., 1] ** 2
        deviations = (conics[..., [2, 0]] / determinants[..., None]).sqrt()
        reach = torch.full_like(depths, MAX_SIGMA)
        is_seen = (depths >= near_plane) & (depths <= far_plane)
        if own_opacities is not None:
            drawn = own_opacities.expand_as(depths)
            drawn = drawn * compensations if calc_compensations else drawn
            is_seen &= drawn >= MIN_ALPHA
            reach = torch.minimum(reach, (2 * (drawn / MIN_ALPHA).clamp_min(1).log()).sqrt())
        radii = (reach[..., None] * deviations).ceil()
        is_seen &= (radii > radius_clip).any(dim=-1)
        size = torch.tensor([width, height])
        is_seen &= ((means2d + radii > 0) & (means2d - radii < size)).all(dim=-1)
        for unset in (means2d, depths, conics):
            unset[~is_seen] = torch.nan
        results = [(radii * is_seen[..., None]).nan_to_num().int(), means2d, depths, conics]
        results.append(compensations.where(is_seen, 0.0) if calc_compensations else None)
    return tuple(wrap(result) for result in results)


def list_shapes(covars: Tensor | None, quats: Tensor | None, scales: Tensor | None) -> list[Tensor]:
    """List the values of covariances, or of quaternions and scales: only one of them is given."""
    given = check_inputs(covars=covars, quats=quats, scales=scales)
    shapes = [values for values in given if values is not None]
    assert len(shapes) == (1 if covars is not None else 2)
    return shapes


def wrap(values: Tensor | None) -> Tensor | None:
    """Put what a kernel computed on the device."""
    return None if values is None else FakeCudaTensor(values)


def projection_ewa_3dgs_fused_bwd(
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float,
    camera_model: CameraModelType,
    radii: Tensor,
    conics: Tensor,
    compensations: Tensor | None,
    v_means2d: Tensor,
    v_depths: Tensor,
    v_conics: Tensor,
    v_compensations: Tensor | None,
    needs_viewmats: bool,
) -> tuple[Tensor | None, ...]:
    """Compute gradients of means and shapes; 0 for Gaussians outside."""
    assert not needs_viewmats
    shapes = list_shapes(covars, quats, scales)
    centers, *cameras = check_inputs(means=means, viewmats=viewmats, Ks=Ks)
    radii_, _, _, *given = check_inputs(
        radii=radii,
        conics=conics,
        compensations=compensations,
        v_means2d=v_means2d,
        v_depths=v_depths,
        v_conics=v_conics,
        v_compensations=v_compensations,
    )
    parameters = [centers, *shapes]
    gradients = [torch.zeros_like(values) for values in parameters]
    with run_kernels(4):
        for number in range(len(cameras[0])):
            seen = (radii_[number] > 0).all(dim=-1).nonzero()[:, 0]
            with torch.enable_grad():
                leaves = [values[seen].requires_grad_() for values in parameters]
                camera = [part[number : number + 1] for part in cameras]
                results = project(leaves[0], leaves[1:], *camera, width, height, eps2d)
            used = [part for part, v in zip(results, given, strict=True) if v is not None]
            incoming = [v[number : number + 1, seen] for v in given if v is not None]
            found = torch.autograd.grad(used, leaves, incoming)
            for gradient, part in zip(gradients, found, strict=True):
                gradient.index_add_(0, seen, part)
    v_means, *v_shapes = (wrap(gradient) for gradient in gradients)
    if covars is not None:
        return v_means, *v_shapes, None, None, None
    return v_means, None, *v_shapes, None


def intersect_tile(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    image_ids: None,
    gaussian_ids: None,
    num_images: int,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    sort: bool,
    segmented: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """List the Gaussians of each tile, the nearest first; the host reads how many there are."""
    assert image_ids is None
    assert gaussian_ids is None
    assert sort
    assert not segmented
    centers, boxes, z = check_inputs(means2d=means2d, radii=radii, depths=depths)
    get_device().counts.wait("number of intersections")
    with run_kernels(5):  # counts of tiles, their sums, the pairs, and their sort
        rows = np.flatnonzero((boxes.numpy() > 0).all(axis=-1))
        center = centers.numpy().reshape(-1, 2)[rows]
        box = boxes.numpy().reshape(-1, 2)[rows]
        limit = (tile_width, tile_height)
        first = np.clip(np.floor((center - box) / tile_size), 0, limit).astype(np.int64)
        last = np.clip(np.ceil((center + box) / tile_size), 0, limit).astype(np.int64)
        across, down = (last - first).T
        counts = np.zeros(z.numel(), np.int32)
        counts[rows] = across * down

        # One entry for each pair of a Gaussian and a tile.
        num_tiles = across * down
        pair = np.repeat(np.arange(len(rows)), num_tiles)
        before = np.repeat(np.cumsum(num_tiles) - num_tiles, num_tiles)
        step = np.arange(len(pair)) - before
        tile_x = first[pair, 0] + step % across[pair]
        tile_y = first[pair, 1] + step // across[pair]
        flat = rows[pair]
        image = flat // z.shape[-1]
        tile_bits = math.floor(math.log2(tile_width * tile_height)) + 1
        depth_bits = z.numpy().reshape(-1)[flat].view(np.uint32).astype(np.int64)
        ids = image << (32 + tile_bits) | (tile_y * tile_width + tile_x) << 32 | depth_bits
        order = np.argsort(ids, kind="stable")
    return (
        FakeCudaTensor(torch.from_numpy(counts).view(z.shape)),
        FakeCudaTensor(torch.from_numpy(ids[order])),
        FakeCudaTensor(torch.from_numpy(flat[order].astype(np.int32))),
    )


def intersect_offset(
    isect_ids: Tensor, num_images: int, tile_width: int, tile_height: int
) -> Tensor:
    """Find the first entry of each tile."""
    (ids,) = check_inputs(isect_ids=isect_ids)
    with run_kernels():
        num_tiles = tile_width * tile_height
        tile_bits = math.floor(math.log2(num_tiles)) + 1
        image, tile = np.divmod(np.arange(num_images * num_tiles), num_tiles)
        starts = np.searchsorted(ids.numpy() >> 32, image << tile_bits | tile)
        offsets = torch.from_numpy(starts.astype(np.int32))
    return FakeCudaTensor(offsets.view(num_images, tile_height, tile_width))


def rasterize_to_pixels_3dgs_fwd(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    backgrounds: None,
    masks: None,
    width: int,
    height: int,
    tile_size: int,
    tile_offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Composite images over black; also return the entry that ends each pixel."""
    assert backgrounds is None
    assert masks is None
    inputs = check_inputs(
        means2d=means2d,
        conics=conics,
        colors=colors,
        opacities=opacities,
        tile_offsets=tile_offsets,
        flatten_ids=flatten_ids,
    )
    with run_kernels():
        splats = flatten_images(*inputs)
        num_images = tile_offsets.shape[0]
        sums = np.zeros((num_images, height, width, colors.shape[-1]), np.float32)
        alphas = np.zeros((num_images, height, width, 1), np.float32)
        last = np.zeros((num_images, height, width), np.int32)
        composite_forward(*splats, tile_size, sums, alphas, last)
    return tuple(FakeCudaTensor(torch.from_numpy(part)) for part in (sums, alphas, last))


def flatten_images(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    tile_offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[np.ndarray, ...]:
    """Return arrays in which entries of all images count their Gaussians one after the other."""
    return (
        means2d.numpy().reshape(-1, 2),
        conics.numpy().reshape(-1, 3),
        colors.numpy().reshape(-1, colors.shape[-1]),
        opacities.numpy().reshape(-1),
        tile_offsets.numpy(),
        flatten_ids.numpy(),
    )


def rasterize_to_pixels_3dgs_bwd(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    backgrounds: None,
    masks: None,
    width: int,
    height: int,
    tile_size: int,
    tile_offsets: Tensor,
    flatten_ids: Tensor,
    render_alphas: Tensor,
    last_ids: Tensor,
    v_render_colors: Tensor,
    v_render_alphas: Tensor,
    absgrad: bool,
) -> tuple[Tensor | None, ...]:
    """Compute the gradients of centres, conics, colours and opacities."""
    assert not absgrad
    inputs = check_inputs(
        means2d=means2d,
        conics=conics,
        colors=colors,
        opacities=opacities,
        tile_offsets=tile_offsets,
        flatten_ids=flatten_ids,
    )
    images = check_inputs(
        render_alphas=render_alphas,
        last_ids=last_ids,
        v_render_colors=v_render_colors,
        v_render_alphas=v_render_alphas,
    )
    with run_kernels(5):  # four of them fill the gradients with zeros
        splats = flatten_images(*inputs)
        gradients = [np.zeros_like(part) for part in splats[:4]]
        composite_backward(*splats, tile_size, *(part.numpy() for part in images), *gradients)
        shapes = [part.shape for part in (means2d, conics, colors, opacities)]
        wrapped = [
            FakeCudaTensor(torch.from_numpy(part).view(shape))
            for part, shape in zip(gradients, shapes, strict=True)
        ]
    return None, *wrapped


@numba.njit(cache=True)
def measure_alpha(means2d, conics, opacities, row, x, y):
    """Return offset and fall-off of a Gaussian in a pixel, and its alpha: 0 if it is too faint."""
    dx = means2d[row, 0] - (x + np.float32(0.5))
    dy = means2d[row, 1] - (y + np.float32(0.5))
    sigma = np.float32(0.5) * (conics[row, 0] * dx * dx + conics[row, 2] * dy * dy)
    sigma += conics[row, 1] * dx * dy
    # No opacity makes up for so far a distance; NaN goes on, as it would in gsplat.
    if sigma < 0 or sigma > np.float32(MAX_SIGMA**2):
        return dx, dy, np.float32(0), np.float32(0)
    falloff = np.exp(-sigma)
    alpha = min(np.float32(MAX_ALPHA), opacities[row] * falloff)
    return dx, dy, falloff, np.float32(0) if alpha < np.float32(MIN_ALPHA) else alpha


@numba.njit(cache=True)
def find_range(offsets, entries, image, y, x, tile_size):
    """Return the first entry of a pixel's tile and that of the next tile."""
    tiles = offsets.reshape(-1)
    tile = (image * offsets.shape[1] + y // tile_size) * offsets.shape[2] + x // tile_size
    end = tiles[tile + 1] if tile + 1 < len(tiles) else len(entries)
    return tiles[tile], end


@numba.njit(cache=True)
def composite_forward(
    means2d, conics, colors, opacities, offsets, entries, tile_size, sums, alphas, last
):
    """Composite every pixel from front to back, as RasterizeToPixels3DGSFwd.cu does."""
    images, height, width, channels = sums.shape
    for image in range(images):
        for y in range(height):
            for x in range(width):
                start, end = find_range(offsets, entries, image, y, x, tile_size)
                left = np.float32(1)
                for entry in range(start, end):
                    row = entries[entry]
                    _, _, _, alpha = measure_alpha(means2d, conics, opacities, row, x, y)
                    if alpha == 0:
                        continue
                    after = left * (1 - alpha)
                    if after <= np.float32(MIN_TRANSMITTANCE):
                        break
                    for channel in range(channels):
                        sums[image, y, x, channel] += colors[row, channel] * alpha * left
                    last[image, y, x] = entry
                    left = after
                alphas[image, y, x, 0] = 1 - left


@numba.njit(cache=True)
def composite_backward(
    means2d,
    conics,
    colors,
    opacities,
    offsets,
    entries,
    tile_size,
    alphas,
    last,
    v_sums,
    v_alphas,
    v_means2d,
    v_conics,
    v_colors,
    v_opacities,
):
    """Add up gradients from back to front, as RasterizeToPixels3DGSBwd.cu does."""
    images, height, width, channels = v_sums.shape
    behind = np.zeros(channels, np.float32)
    for image in range(images):
        for y in range(height):
            for x in range(width):
                start, _ = find_range(offsets, entries, image, y, x, tile_size)
                final = 1 - alphas[image, y, x, 0]
                left = final
                behind[:] = 0
                # Without any entry the last one is 0, which need not be of this tile.
                if left == 1:
                    continue
                for entry in range(last[image, y, x], start - 1, -1):
                    row = entries[entry]
                    dx, dy, falloff, alpha = measure_alpha(means2d, conics, opacities, row, x, y)
                    if alpha == 0:
                        continue
                    left /= 1 - alpha
                    v_alpha = final / (1 - alpha) * v_alphas[image, y, x, 0]
                    for channel in range(channels):
                        v = v_sums[image, y, x, channel]
                        v_colors[row, channel] += alpha * left * v
                        v_alpha += (colors[row, channel] * left - behind[channel] / (1 - alpha)) * v
                        behind[channel] += colors[row, channel] * alpha * left
                    if opacities[row] * falloff <= np.float32(MAX_ALPHA):
                        v_sigma = -opacities[row] * falloff * v_alpha
                        v_conics[row, 0] += np.float32(0.5) * v_sigma * dx * dx
                        v_conics[row, 1] += v_sigma * dx * dy
                        v_conics[row, 2] += np.float32(0.5) * v_sigma * dy * dy
                        across = conics[row, 0] * dx + conics[row, 1] * dy
                        down = conics[row, 1] * dx + conics[row, 2] * dy
                        v_means2d[row, 0] += v_sigma * across
                        v_means2d[row, 1] += v_sigma * down
                        v_opacities[row] += falloff * v_alpha


def spherical_harmonics_fwd(
    degree: int, directions: Tensor, coefficients: Tensor, masks: None
) -> Tensor:
    """Evaluate harmonics [n, k, 3] in directions of any length."""
    from gsplat.cuda._torch_impl import _spherical_harmonics

    assert masks is None
    inputs = check_inputs(directions=directions, coefficients=coefficients)
    with run_kernels(), torch.no_grad():
        return FakeCudaTensor(_spherical_harmonics(degree, *inputs))


def spherical_harmonics_bwd(
    num_harmonics: int,
    degree: int,
    directions: Tensor,
    coefficients: Tensor,
    masks: None,
    v_colors: Tensor,
    needs_directions: bool,
) -> tuple[Tensor, Tensor | None]:
    """Compute the gradients of harmonics, and of directions if they are needed."""
    from gsplat.cuda._torch_impl import _spherical_harmonics

    inputs = check_inputs(directions=directions, coefficients=coefficients, v_colors=v_colors)
    with run_kernels(2 + needs_directions), torch.enable_grad():
        leaves = [part.detach().requires_grad_() for part in inputs[:2]]
        colors = _spherical_harmonics(degree, *leaves)
        v_directions, v_coefficients = torch.autograd.grad(colors, leaves, inputs[2])
    return FakeCudaTensor(v_coefficients), wrap(v_directions) if needs_directions else None
