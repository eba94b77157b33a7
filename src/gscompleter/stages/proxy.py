"""A proxy of a large scene: what its photographs, which are looked at small, can see of it.

Where millions of Gaussians were brought, several share a pixel of each photograph. Those that lie
within half a pixel of each other, however close a photograph was taken, are drawn as one. Only
photographs that bear witness are compared with the proxy; the context, targets and all that is
written are of the scene itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float32, Int64
from numpy import ndarray

from gscompleter.kernels import runs as kernels
from gscompleter.kernels.sharing import share
from gscompleter.types import Camera, Gaussians, Proxy

WORTH = 500_000
"""Gaussians from which on a proxy saves more than it takes to make."""
REACH = 0.5
"""Pixels from the first Gaussian of a run to any other."""
LARGEST = 2.0
"""Standard deviations of a Gaussian that shares a run, in pixels, at most. Photographs and scene
are compared over more than that."""
FIELDS = ("means", "quats", "scales", "opacities", "sh")
"""Of Gaussians, as the kernels want them."""


def proxy_of(scene: Gaussians, cameras: Sequence[Camera], worth: int = WORTH) -> Proxy:
    """What `cameras` see of `scene`, with fewer Gaussians where it has very many.

    Neighbours in the scene's order are asked whether they lie close to each other, so that one in
    random order stays as it is. So does one on a GPU, which has no need of it.
    """
    if len(scene) < worth or scene.means.is_cuda or not cameras:
        return Proxy(scene)
    given = tuple(getattr(scene, name).float().contiguous().numpy() for name in FIELDS)
    start = starts_of_runs(given[0], given[2], cameras)
    found = tuple(np.empty((len(start) - 1, *array.shape[1:]), np.float32) for array in given)
    shares = np.empty(len(scene), np.float32)
    share(kernels.stand_for, len(start) - 1, start, given, shares, found)
    sizes = torch.from_numpy(np.diff(start))
    parts = dict(zip(FIELDS, map(torch.from_numpy, found), strict=True))
    generated = scene.generated[torch.from_numpy(start[:-1])]
    run = torch.arange(len(sizes)).repeat_interleave(sizes)
    return Proxy(Gaussians(**parts, generated=generated), run, torch.from_numpy(shares))


def starts_of_runs(
    means: Float32[ndarray, "n 3"], scales: Float32[ndarray, "n 3"], cameras: Sequence[Camera]
) -> Int64[ndarray, "m+1"]:
    """Where each run starts, and the end."""
    centers = torch.stack([camera.center for camera in cameras]).float().numpy()
    focals = torch.stack([camera.K[0, 0] for camera in cameras]).float().numpy()
    begins = np.empty(len(means), np.bool_)
    limits = np.float32(REACH), np.float32(LARGEST)
    seen = (means, scales, centers, focals, *limits, begins)
    share(kernels.begin_runs, -(-len(means) // kernels.BLOCK), *seen)
    return np.append(np.flatnonzero(begins), len(means))
