"""LOD proxies of large scenes, because time and memory of every stage grow with the Gaussians.

A run is a sequence of Gaussians, adjacent in the order of the scene, that lie within half a pixel
of the first of them in all cameras, at working resolution. Each run is merged to one Gaussian.
Large scenes are sorted along a Morton curve before (decision 025), so that neighbours in space are
mostly neighbours in this order. Completion uses the proxy; all output is made from the scene itself
(decision 024). The second half of this file thins scenes by sampling, without any camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, Int64, UInt8
from numpy import ndarray
from torch import Tensor

from gscompleter.numerics.kernels import lod as kernels
from gscompleter.numerics.kernels.parallel import share
from gscompleter.numerics.kernels.project import GaussianArrays
from gscompleter.render.cpu import to_arrays
from gscompleter.render.viewpoint import to_float32
from gscompleter.system.files.mapping import release_pages
from gscompleter.system.memory import count_fitting_gaussians
from gscompleter.types import Camera, ContextScene, Gaussians

MIN_PROXY_GAUSSIANS = 500_000
"""Gaussians from which on a proxy saves more time than it takes to build."""
MAX_PROXY_SHARE = 2 / 3
"""Largest share of its scene that a proxy may keep: one that keeps more saves little time, and its
harmonics, which are its own, take more memory than it saves."""
MAX_REACH = 0.5
"""Largest distance of a Gaussian from the first of its run, in pixels."""
MAX_RUN_DEVIATION = 2.0
"""Largest standard deviation of a Gaussian that shares a run, in pixels."""
MAX_GROWTH = 8.0
"""Largest factor on MAX_REACH and MAX_RUN_DEVIATION, if the proxy would be too large otherwise."""
FAR_AWAY = 1e4
"""Distance, in radii of the scene, of a camera to which all of it is equally far."""
MERGED_BLOCK = 200_000
"""Runs that are merged at a time."""
BISECTIONS = 20
"""Steps of the search for the distance within which Gaussians are merged, on its logarithm: to less
than a part in ten thousand."""
NEAREST, NEAREST_STEP, NEAREST_STEPS = 1e-6, 1e-3, 3
"""Least distance of that search, in radii of the scene, and how often it is lowered by which factor
if so many Gaussians lie within it: a floater may be a million times as far away as all others."""
MIN_BLOCK_RUNS = 16
"""Runs per block of the kernel below which a scene is merged in two passes."""


def build_proxy(scene: Gaussians, cameras: Sequence[Camera]) -> ContextScene:
    """Build the LOD proxy of a large `scene`; one that is small or on a GPU is its own.

    So is one of which the proxy would keep most, if the frozen views of `cameras` hold it. Runs are
    found and merged on the CPU, and a proxy is to save its time and memory.
    """
    if len(scene) < MIN_PROXY_GAUSSIANS or scene.means.is_cuda:
        return ContextScene.whole(scene)
    fits = len(scene) <= count_fitting_gaussians(len(cameras))
    return simplify_scene(scene, cameras, MAX_PROXY_SHARE if fits else 1.0)


def simplify_scene(
    scene: Gaussians, cameras: Sequence[Camera], max_share: float = 1.0
) -> ContextScene:
    """Merge runs of adjacent, close Gaussians of one provenance to one Gaussian each.

    Runs become longer until their number fits in the memory of the frozen views of `cameras`. In a
    scene in random order adjacent Gaussians are far apart, and almost nothing is merged. A scene of
    which more than `max_share` would be left stays as it is.
    """
    arrays = to_arrays(scene)
    start = find_run_starts(arrays.means, arrays.scales, scene.generated.numpy(), cameras)
    if len(start) - 1 > max_share * len(scene):
        return ContextScene.whole(scene)
    merged = merge_runs(scene, start)
    run_of_gaussian = torch.arange(len(merged)).repeat_interleave(torch.from_numpy(np.diff(start)))
    return ContextScene.build(scene, merged, run_of_gaussian)


def merge_runs(scene: Gaussians, start: Int64[ndarray, "bounds"]) -> Gaussians:
    """Merge runs of adjacent Gaussians to one Gaussian each; `start` is as `find_run_starts`."""
    # Kernels take harmonics as one row per Gaussian.
    arrays = to_arrays(scene)
    arrays = arrays._replace(sh=arrays.sh.reshape(len(scene), -1))
    num_runs = len(start) - 1
    merged_arrays = GaussianArrays(
        *[np.empty((num_runs, *array.shape[1:]), np.float32) for array in arrays]
    )
    shares = np.empty(len(scene), np.float32)
    # Harmonics may lie in a file, of which no more than a block is kept in memory.
    for begin in range(0, num_runs, MERGED_BLOCK):
        bounds = start[begin : begin + MERGED_BLOCK + 1]
        merged = GaussianArrays(*[array[begin : begin + MERGED_BLOCK] for array in merged_arrays])
        share(kernels.merge_run_range, len(bounds) - 1, bounds, arrays, shares, merged)
        release_pages(arrays.sh[bounds[0] : bounds[-1]])

    first = torch.from_numpy(start[:-1])
    return Gaussians(
        means=torch.from_numpy(merged_arrays.means),
        quats=torch.from_numpy(merged_arrays.quats),
        scales=torch.from_numpy(merged_arrays.scales),
        opacities=torch.from_numpy(merged_arrays.opacities),
        sh=torch.from_numpy(merged_arrays.sh).unflatten(1, scene.sh.shape[1:]),
        generated=scene.generated[first],
        is_antialiased=scene.is_antialiased,
        origin=scene.origin,
    )


def merge_nearby(scene: Gaussians, max_gaussians: int) -> Gaussians:
    """Merge adjacent Gaussians of one provenance until about so many are left; on the CPU.

    A run lies within a distance of its first Gaussian, the smallest that is enough. The scene has
    to be sorted along a Morton curve, and not to be empty. More are left where provenances
    alternate along it.
    """
    # No run reaches beyond a block. Of few runs the blocks would decide what is merged, and one of
    # each would be left, so that a first pass merges many blocks into one.
    num_blocks = -(-len(scene) // kernels.RUN_BLOCK)
    least = MIN_BLOCK_RUNS * num_blocks
    if num_blocks > 1 and max_gaussians < least < len(scene):
        fewer = merge_nearby(scene, least)
        if len(fewer) < len(scene):
            return merge_nearby(fewer, max_gaussians)
    arrays = to_arrays(scene)
    labels = scene.generated.numpy()
    centre = scene.means.mean(dim=0)
    radius = max((scene.means - centre).abs().max().item(), 1e-30)

    def find_starts(distance: float) -> Int64[ndarray, "bounds"]:
        # A camera so far away that a pixel is `distance` wide everywhere. Gaussians of any size may
        # join (largest = infinity).
        focal = np.array([FAR_AWAY * radius / distance], np.float32)
        place = to_float32(centre + FAR_AWAY * radius * torch.tensor([0.0, 0.0, 1.0]))[None]
        begins = np.empty(len(scene), np.bool_)
        share(
            kernels.mark_run_starts,
            num_blocks,
            *(arrays.means, arrays.scales, labels, place, focal),
            *(np.float32(1), np.float32(np.inf), begins),
        )
        return np.append(np.flatnonzero(begins), len(scene))

    # Bisection on the logarithm: between a millionth of the extent, or less, and all of it.
    low = NEAREST * radius
    for _ in range(NEAREST_STEPS):
        if len(find_starts(low)) - 1 >= max_gaussians:
            break
        low *= NEAREST_STEP
    high = 4 * radius
    for _ in range(BISECTIONS):
        middle = math.sqrt(low * high)
        if len(find_starts(middle)) - 1 > max_gaussians:
            low = middle
        else:
            high = middle
    return merge_runs(scene, find_starts(high))


def find_run_starts(
    means: Float32[ndarray, "n 3"],
    scales: Float32[ndarray, "n 3"],
    generated: UInt8[ndarray, "n"],
    cameras: Sequence[Camera],
) -> Int64[ndarray, "bounds"]:
    """Find the first row of each of m runs, and append the number of Gaussians: m + 1 bounds.

    `means` are in the world frame; `generated` is the provenance, which is the same within a run.
    A pixel is that of the camera in which a Gaussian appears largest, by its shorter side.
    """
    centers = to_float32(torch.stack([camera.center for camera in cameras]))
    focals = to_float32(torch.stack([camera.K.diagonal()[:2].max() for camera in cameras]))
    begins = np.empty(len(means), np.bool_)
    max_runs = count_fitting_gaussians(len(cameras))
    num_blocks = -(-len(means) // kernels.RUN_BLOCK)
    # A coarser proxy is better than one that does not fit in memory.
    growth = 1.0
    while True:
        share(
            kernels.mark_run_starts,
            num_blocks,
            means,
            scales,
            generated,
            centers,
            focals,
            np.float32(growth * MAX_REACH),
            np.float32(growth * MAX_RUN_DEVIATION),
            begins,
        )
        if np.count_nonzero(begins) <= max_runs or growth >= MAX_GROWTH:
            return np.append(np.flatnonzero(begins), len(means))
        growth *= 2


DEFAULT_THINNED = 400_000
"""Largest number of Gaussians that are kept by default."""
MAX_PREVIEW_GAUSSIANS = 25_000
"""Largest number that is kept for previews: several per pixel of a small image."""
SIZE_SAMPLE = 100_000
"""Gaussians from which the distribution of sizes is estimated."""


def thin_gaussians(scene: Gaussians, max_gaussians: int = DEFAULT_THINNED) -> Gaussians:
    """Reduce a scene to about `max_gaussians` Gaussians, enlarged to cover the same area.

    Gaussians are kept with a probability proportional to their size. No random number takes part,
    so that the same scene is always thinned alike, and every stretch of the file is thinned evenly.
    """
    if len(scene) <= max_gaussians:
        return scene
    rows, growth = choose_thinned_rows(scene, max_gaussians)
    chosen = replace(scene, encoded=None)[rows]
    return replace(chosen, scales=chosen.scales * growth[:, None])


def choose_thinned_rows(
    scene: Gaussians, max_gaussians: int = DEFAULT_THINNED
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
    """Select the rows to keep, and the factor by which their standard deviations grow."""
    if len(scene) <= max_gaussians:
        return torch.arange(len(scene), device=scene.means.device), torch.ones_like(scene.opacities)
    # Systematic sampling: a Gaussian is kept if the running sum of probabilities reaches the next
    # whole number at its row. It stands for 1 / probability Gaussians, and its area grows by that
    # factor, so that its standard deviations grow by the square root.
    probability = compute_keep_probabilities(scene, max_gaussians)
    passed = probability.double().cumsum(0).floor()
    rows = torch.nonzero(passed > torch.nn.functional.pad(passed[:-1], (1, 0)))[:, 0]
    return rows, probability[rows].rsqrt()


def compute_keep_probabilities(scene: Gaussians, max_gaussians: int) -> Float[Tensor, "n"]:
    """Compute keep probabilities proportional to size; their sum is at most the limit.

    Size is the square root of area times opacity, without any camera.

    The largest 1 % is clamped: floaters and sky are large, few, and useless for matching.
    """
    # The product of the two longer standard deviations: the area of the largest face, as
    # `_compute_cross_section` of the kernels has it. The shortest may be exactly 0.
    a, b, c = scene.scales.unbind(dim=1)
    cross_section = (a * b).maximum(b * c).maximum(c * a)
    size = (cross_section * scene.opacities).sqrt()
    sample = size[:: max(1, len(size) // SIZE_SAMPLE)]
    size = size.clamp(max=sample.quantile(0.99)).clamp_min(1e-30)
    return (max_gaussians * (size / size.sum(dtype=torch.float64))).clamp(max=1).to(size)
