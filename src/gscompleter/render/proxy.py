"""A proxy of a large scene: what cameras can see of it, in images of the size that is worked at.

Where millions of Gaussians were brought, several share a pixel of each image. Those that lie within
half a pixel of each other, however close a camera is, are drawn as one. A scene is completed by
what is seen of its proxy; all that is written, and the pictures of it, are of the scene itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float32, Int64, UInt8
from numpy import ndarray

from gscompleter.kernels import runs as kernels
from gscompleter.kernels.rasterizer import GaussianArrays
from gscompleter.kernels.sharing import share
from gscompleter.memory import most_that_fit
from gscompleter.render.cpu import arrays_of
from gscompleter.render.folded import float32
from gscompleter.types import Camera, Gaussians, Proxy

WORTH = 500_000
"""Gaussians from which on a scene in order is drawn sooner by more than it takes to sort it."""
REACH = 0.5
"""Pixels from the first Gaussian of a run to any other."""
LARGEST = 2.0
"""Standard deviations of a Gaussian that shares a run, in pixels, at most. Photographs and scene
are compared over more than that."""
MAX_GROWTH = 8.0
"""By how much both grow at most where the proxy would be too large otherwise."""


def proxy_of(scene: Gaussians, cameras: Sequence[Camera]) -> Proxy | None:
    """What `cameras` see of `scene`, drawn with fewer Gaussians where it has so many that it lies
    in order; None where it is drawn itself, as on a GPU, which has no need of a proxy."""
    if len(scene) < WORTH or scene.means.is_cuda:
        return None
    return run_by_run(scene, cameras)


def run_by_run(scene: Gaussians, cameras: Sequence[Camera]) -> Proxy:
    """`scene` with one Gaussian for each run of neighbours in its order that lie close together and
    are of one provenance.

    There are as few runs as views of `cameras` have room for. In a random order there are none.
    """
    given = arrays_of(scene)
    given = given._replace(sh=given.sh.reshape(len(scene), -1))
    start = starts_of_runs(given.means, given.scales, scene.generated.numpy(), cameras)
    found = [np.empty((len(start) - 1, *array.shape[1:]), np.float32) for array in given]
    shares = np.empty(len(scene), np.float32)
    share(kernels.stand_for, len(start) - 1, start, given, shares, GaussianArrays(*found))
    means, quats, scales, opacities, sh = map(torch.from_numpy, found)
    first, sizes = torch.from_numpy(start[:-1]), torch.from_numpy(np.diff(start))
    run = torch.arange(len(sizes)).repeat_interleave(sizes)
    looks = opacities, sh.unflatten(1, scene.sh.shape[1:]), scene.generated[first]
    drawn = Gaussians(means, quats, scales, *looks, is_antialiased=scene.is_antialiased)
    return Proxy(drawn, run)


def starts_of_runs(
    means: Float32[ndarray, "n 3"],
    scales: Float32[ndarray, "n 3"],
    generated: UInt8[ndarray, "n"],
    cameras: Sequence[Camera],
) -> Int64[ndarray, "bounds"]:
    """Where each run starts, and the end [m + 1]."""
    centers = float32(torch.stack([camera.center for camera in cameras]))
    focals = float32(torch.stack([camera.K[0, 0] for camera in cameras]))
    begins = np.empty(len(means), np.bool_)
    most, growth = most_that_fit(len(cameras)), 1.0
    while True:
        limits = np.float32(growth * REACH), np.float32(growth * LARGEST)
        seen = (means, scales, generated, centers, focals, *limits, begins)
        share(kernels.begin_runs, -(-len(means) // kernels.BLOCK), *seen)
        if np.count_nonzero(begins) <= most or growth >= MAX_GROWTH:
            return np.append(np.flatnonzero(begins), len(means))
        growth *= 2
