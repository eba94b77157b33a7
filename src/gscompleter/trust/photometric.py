"""Photometric trust: how well photographs confirm the Gaussians of an input splat.

The paper's hole mask thresholds alpha, but a trained splat is opaque everywhere. A Gaussian is
trusted, as seen from a camera, if photographs from similar directions match its render and show as
much of it. Alpha weighted by trust is low in unknown regions again, and the four stages apply
unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gscompleter.config import TrustConfig
from gscompleter.cpu_threads import use_one_torch_thread
from gscompleter.generators.exposure import fit_robust_affine
from gscompleter.geometry import compute_z_depths
from gscompleter.kernels import support as kernels
from gscompleter.kernels.parallel import map_in_parallel, share
from gscompleter.kernels.support import CameraPose
from gscompleter.render import FrozenScene, get_view_map
from gscompleter.render.viewpoint import to_float32
from gscompleter.types import Camera, Gaussians, PhotoObservations, Render, View

BLUR_RADIUS = 0.01
"""Radius of box filters, relative to the longer side; it tolerates edges off by a pixel."""
EXPOSURE_PIXELS = 10_000
"""Pixels that the exposure fit uses."""
EXACT_DIFFERENCE = 0.02
"""Median colour difference up to which a scene counts as exact."""
FULL_TRUST_FRACTION = 0.5
"""Fraction of a Gaussian's area in a camera that a photograph has to show for full trust."""
FRONT_DEVIATIONS = 0.5
"""Standard deviations of depth by which new Gaussians are put in front of untrusted ones."""


def gather_observations(
    rendered: Gaussians, views: Sequence[View], frozen: Sequence[FrozenScene], config: TrustConfig
) -> PhotoObservations:
    """Measure visible area and photometric consistency of each Gaussian in each photograph."""
    with use_one_torch_thread():
        differences = map_in_parallel(compute_color_difference, [f.render for f in frozen], views)
    usual = torch.stack([d.median() for d in differences]).median().item()
    scale = config.color_sigma * max(1.0, usual / EXACT_DIFFERENCE)
    means = to_float32(rendered.means)
    areas, agreement = np.empty((2, len(views), len(means)), np.float32)

    def gather(k: int) -> None:
        agrees = torch.exp(-((differences[k] / scale) ** 2))
        layers = torch.stack([torch.ones_like(agrees), agrees, torch.zeros_like(agrees)], dim=-1)
        seen = (to_float32(frozen[k].backproject(layers)), means, convert_camera(views[k].camera))
        share(kernels.measure_photo_agreement, len(means), *seen, areas[k], agreement[k])

    for _ in get_view_map(rendered)(gather, range(len(views))):
        pass
    arrays = (torch.from_numpy(array).to(rendered.means) for array in (areas, agreement))
    return PhotoObservations(
        rendered.means, torch.stack([view.camera.center for view in views]), *arrays
    )


def compute_color_difference(render: Render, view: View) -> Float[Tensor, "h w"]:
    """Compute the absolute colour difference after an exposure fit, averaged over a few pixels."""
    shown = render.image.clamp(0, 1)
    pixels = slice(None, None, max(1, view.image[..., 0].numel() // EXPOSURE_PIXELS))
    pairs = (image.reshape(-1, 3)[pixels] for image in (shown, view.image))
    gain, offset = fit_robust_affine(*pairs)
    return blur((gain * shown + offset - view.image).abs().mean(dim=-1))


def compute_trust(
    observations: PhotoObservations,
    sums: Float[Tensor, "m"],
    camera: Camera,
    config: TrustConfig = TrustConfig(),
) -> Float[Tensor, "m"]:
    """Compute the trust of each Gaussian from a camera: in [0, 1], 1 for invisible ones.

    `sums` are the summed compositing weights of each Gaussian in its image.
    """
    seen = (observations.areas, observations.agreement, observations.means, sums)
    arrays = map(to_float32, (observations.centers, *seen))
    limits = np.float32(math.radians(config.angle_sigma)), np.float32(FULL_TRUST_FRACTION)
    values = np.empty(len(sums), np.float32)
    share(kernels.accumulate_trust, len(values), *arrays, convert_camera(camera), *limits, values)
    return torch.from_numpy(values).to(sums)


def convert_camera(camera: Camera) -> CameraPose:
    """Convert a camera to the form that the kernels read."""
    focal = (camera.K[0, 0] * camera.K[1, 1]).item()
    return CameraPose(to_float32(camera.center), to_float32(camera.forward), np.float32(focal))


def compute_observed_fraction(
    observations: PhotoObservations, sums: Float[Tensor, "m"], camera: Camera
) -> Float[Tensor, "m"]:
    """Compute the largest fraction of each Gaussian's area at `camera` that a photograph shows."""
    needed = sums * compute_pixel_areas(observations.means, camera)
    return observations.areas.amax(dim=0) / needed.clamp_min(1e-20)


def sum_weights(frozen: FrozenScene) -> Float[Tensor, "n"]:
    """Sum the compositing weights of each Gaussian over the image."""
    return frozen.backproject(torch.ones_like(frozen.render.image))[:, 0]


def compute_trusted_alpha(frozen: FrozenScene, trust: Float[Tensor, "n"]) -> Float[Tensor, "h w"]:
    """Render accumulated opacity with every Gaussian weighted by its trust."""
    return torch.minimum(blur(frozen.splat(trust)), frozen.render.alpha)


def compute_front_depth(
    scene: Gaussians, frozen: FrozenScene, camera: Camera
) -> Float[Tensor, "h w"]:
    """Compute the z-depth at which new Gaussians occlude most of `scene`, in scene units.

    Untrusted Gaussians vary in depth; `FRONT_DEVIATIONS` before the mean hide most of them.
    Nearer Gaussians would occlude the scene in photographs from the side.
    """
    render, z = frozen.render, compute_z_depths(scene.means, camera).clamp_min(0.0)
    unit = render.depth.max().clamp_min(1e-12)
    squares = frozen.splat((z / unit).clamp_max(2.0) ** 2)
    mean = render.depth / unit
    spread = (squares / render.alpha.clamp_min(1e-6) - mean**2).clamp_min(0.0).sqrt()
    return unit * (mean - FRONT_DEVIATIONS * spread).clamp_min(0.1 * mean)


def compute_pixel_areas(means: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n"]:
    """Compute the area of a pixel at each Gaussian, in squared scene units."""
    z = compute_z_depths(means, camera)
    return z.clamp_min(0.0) ** 2 / (camera.K[0, 0] * camera.K[1, 1])


def blur(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Apply the box filter of radius `BLUR_RADIUS`."""
    radius = max(round(BLUR_RADIUS * max(values.shape)), 1)
    pooled = avg_pool2d(values[None, None], 2 * radius + 1, 1, radius, count_include_pad=False)
    return pooled[0, 0]
