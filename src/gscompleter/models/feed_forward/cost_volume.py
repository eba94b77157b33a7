"""Plane-sweep cost volumes from feature maps."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from gscompleter.models.feed_forward.cameras import Cameras, disable_autocast

MIN_DEPTH = 1e-3
"""Smallest z-depth in a source view, in scene units; nearer points are clamped to it."""


def space_evenly(
    first: Float[Tensor, "n 1 h w"], last: Float[Tensor, "n 1 h w"], number: int
) -> Float[Tensor, "n {number} h w"]:
    """Space `number` candidates evenly from `first` to `last` at each pixel."""
    steps = torch.linspace(0, 1, number, device=first.device)[:, None, None]
    return first + steps * (last - first)


def compute_cost_volume(
    features: Float[Tensor, "n c h w"],
    cameras: Cameras,
    sources: Int[Tensor, "b v s"],
    inverse_depths: Float[Tensor, "n d _ _"],
    depth_chunk: int,
) -> Float[Tensor, "n d h w"]:
    """Correlate each view with its source views at candidate depths, averaged over the sources.

    The n = b v views are ordered by scene; `sources` has indices within a scene. Candidates are
    inverse z-depths in 1 / scene units, given per view or per pixel, and processed `depth_chunk` at
    a time to bound the memory.
    """
    n, _, h, w = features.shape
    # In pixels of the feature maps.
    K = cameras.scale_intrinsics(h, w).flatten(0, 1)
    # From the axes of each view to those of each of its sources.
    transforms = cameras.compute_sources_from_views(sources).flatten(0, 1)
    depths = (1 / inverse_depths).expand(n, -1, h, w)
    # From indices within a scene to indices in the list of all n views.
    first = torch.arange(len(sources), device=sources.device)[:, None, None] * sources.shape[1]
    numbers = (first + sources).flatten(0, 1).tolist()

    volumes = []
    for view in range(n):
        chunks = []
        for chunk in depths[view].split(depth_chunk):
            matches = [
                correlate_features(features[view], features[source], K[view], transform, chunk)
                for source, transform in zip(numbers[view], transforms[view], strict=True)
            ]
            # Matches of several sources are averaged, so that any number of them gives the same
            # scale.
            chunks.append(torch.stack(matches).mean(0))
        volumes.append(torch.cat(chunks))
    return torch.stack(volumes)


def correlate_features(
    reference: Float[Tensor, "c h w"],
    source: Float[Tensor, "c h w"],
    K: Float[Tensor, "3 3"],
    source_from_reference: Float[Tensor, "4 4"],
    depths: Float[Tensor, "d h w"],
) -> Float[Tensor, "d h w"]:
    """Correlate the reference with the source sampled at z-depths; 0 outside the source.

    `K` is that of `compute_sampling_grid`.
    """
    grid = compute_sampling_grid(K, source_from_reference, depths)
    sampled = F.grid_sample(
        source[None], grid.flatten(0, 1)[None], mode="bilinear", align_corners=True
    )
    candidates = sampled[0].unflatten(1, depths.shape[:2])
    # A scalar product over the channels, scaled as in attention.
    return (reference[:, None] * candidates).sum(0) / (len(reference) ** 0.5)


def compute_sampling_grid(
    K: Float[Tensor, "3 3"],
    source_from_reference: Float[Tensor, "4 4"],
    depths: Float[Tensor, "d h w"],
) -> Float[Tensor, "d h w 2"]:
    """Project the pixels of the reference at z-depths into the source: x and y in [-1, 1].

    `K` is that of the reference, in pixels of the maps. As in the authors' code it serves for the
    source, too, and pixel centres have integer coordinates: the photographs of a scene in training
    are of one camera. Of unlike focal lengths the source is sampled beside the point.
    """
    _, h, w = depths.shape
    with disable_autocast(K):
        x = torch.arange(w, device=K.device)
        y = torch.arange(h, device=K.device)
        columns, rows = torch.meshgrid(x, y, indexing="xy")
        pixels = torch.stack([columns, rows, torch.ones_like(rows)]).flatten(1).to(K)
        # Rays of unit z in the axes of the source; a depth then takes them to points.
        rays = source_from_reference[:3, :3] @ torch.linalg.inv(K) @ pixels
        shift = source_from_reference[:3, 3, None, None]
        points = rays[:, None] * depths.flatten(1) + shift
        image = (K @ points.flatten(1)).unflatten(1, depths.shape)
        at = image[:2] / image[2:].clamp(min=MIN_DEPTH)
        # -1 and 1 are the centres of the first and the last pixel (`align_corners`).
        last = at.new_tensor([w - 1, h - 1]).view(2, 1, 1, 1)
        return (2 * at / last - 1).permute(1, 2, 3, 0)
