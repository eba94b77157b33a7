"""Photometric trust: how well photographs confirm the Gaussians of an input splat.

The paper's hole mask thresholds alpha, but a trained splat is opaque everywhere. A Gaussian is
trusted, as seen from a camera, if photographs from similar directions match its render and show as
much of it. Alpha weighted by trust is low in unknown regions again, and the four stages apply
unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor
from torch.nn.functional import pad

from gscompleter.config import CompleterConfig, TrustConfig
from gscompleter.numerics.geometry import compute_z_depths
from gscompleter.numerics.image_ops import average_box
from gscompleter.numerics.kernels import support as kernels
from gscompleter.numerics.kernels.parallel import map_in_parallel, share
from gscompleter.numerics.kernels.support import CameraPose
from gscompleter.numerics.robust import fit_robust_affine
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.protocols import FrozenScene
from gscompleter.render.view_map import get_view_map
from gscompleter.render.viewpoint import to_float32
from gscompleter.system.threads import use_one_torch_thread
from gscompleter.trust import HeldViews, Trust
from gscompleter.types import Camera, Gaussians, Render, View

BLUR_RADIUS = 0.01
"""Radius of box filters, relative to the longer side; it tolerates edges off by a pixel."""
EXPOSURE_PIXELS = 10_000
"""Pixels that the exposure fit uses."""
EXACT_DIFFERENCE = 0.02
"""Median colour difference up to which a scene counts as exact."""
FULL_TRUST_FRACTION = 0.5
"""Fraction of a Gaussian's area in a camera that a photograph has to show for full trust."""


@dataclass(frozen=True)
class PhotoObservations:
    """Observations of m context Gaussians in k photographs, from which trust is computed."""

    means: Float[Tensor, "m 3"]
    centers: Float[Tensor, "k 3"]
    areas: Float[Tensor, "k m"]
    """Visible area of each Gaussian in each photograph, in squared scene units."""
    agreement: Float[Tensor, "k m"]
    """Photometric consistency at each Gaussian, in [0, 1]; 0 if it is not visible."""


@dataclass(frozen=True)
class PhotometricTrust(Trust):
    """Trust of a Gaussian as far as photographs from similar directions confirm its colour."""

    observations: PhotoObservations
    is_recolored: Bool[Tensor, "m"]
    """True for Gaussians that a completed target recoloured; these are trusted."""
    config: TrustConfig
    held_views: HeldViews
    """The photographs, then completed targets."""

    @property
    def held(self) -> HeldViews:
        """Views in which colours stay."""
        return self.held_views

    def compute_alpha(self, frozen: FrozenScene, camera: Camera) -> Float[Tensor, "h w"]:
        """Render accumulated opacity weighted by trust; added and invisible Gaussians have 1."""
        sums, count = sum_weights(frozen), len(self.observations.means)
        trust = compute_trust(self.observations, sums[:count], camera, self.config)
        trust = torch.where(self.is_recolored, 1.0, trust)
        weights = pad(trust, (0, len(sums) - count), value=1.0)
        return torch.minimum(blur(frozen.splat(weights)), frozen.render.alpha)

    def accept(
        self, frozen: FrozenScene, camera: Camera, rows: Int64[Tensor, "r"]
    ) -> PhotometricTrust:
        """Trust recoloured rows, and hold all colours in the direction of a completed target."""
        sums = sum_weights(frozen)[: len(self.is_recolored)]
        return replace(
            self,
            held_views=self.held.add(camera, sums),
            is_recolored=self.is_recolored.index_fill(0, rows, True),
        )

    def thin(self, rows: Int[Tensor, "r"], growth: Float[Tensor, "r"]) -> PhotometricTrust:
        """Restrict to rows that stand for their neighbours, each enlarged by a factor."""
        seen = self.observations
        areas, agreement = seen.areas[:, rows] * growth**2, seen.agreement[:, rows]
        thinned = PhotoObservations(seen.means[rows], seen.centers, areas, agreement)
        held = replace(self.held, sums=self.held.sums[:, rows])
        return PhotometricTrust(thinned, self.is_recolored[rows], self.config, held)


def load_trust(
    config: CompleterConfig,
    parts: tuple[Gaussians, ...],
    views: Sequence[View],
    scenes: SceneRenderer,
) -> Trust:
    """Load the trust that a config names, from all photographs of the scene."""
    if config.trust == "full":
        return Trust()
    cameras = tuple(view.camera for view in views)
    frozen, settings = scenes.freeze_at(parts, cameras), config.trust_settings
    observations = gather_observations(parts[0], views, frozen, settings)
    pixels = torch.stack([compute_pixel_areas(observations.means, camera) for camera in cameras])
    sums = observations.areas / pixels.clamp_min(1e-30)
    weights = sums.new_full((len(cameras),), config.recolor.hold_weight)
    held = HeldViews(observations.centers, sums, weights)
    is_recolored = torch.zeros(len(parts[0]), dtype=torch.bool, device=sums.device)
    return PhotometricTrust(observations, is_recolored, settings, held)


def compute_pixel_areas(means: Float[Tensor, "m 3"], camera: Camera) -> Float[Tensor, "m"]:
    """Compute the area of a pixel at each Gaussian, in squared scene units."""
    z = compute_z_depths(means, camera).clamp_min(0.0)
    return z**2 / (camera.K[0, 0] * camera.K[1, 1])


def gather_observations(
    rendered: Gaussians, views: Sequence[View], frozen: Sequence[FrozenScene], config: TrustConfig
) -> PhotoObservations:
    """Measure visible area and photometric consistency of each Gaussian in each photograph."""
    with use_one_torch_thread():
        differences = map_in_parallel(compute_color_difference, [f.render for f in frozen], views)
    known = [d[view.valid_mask].median() for d, view in zip(differences, views, strict=True)]
    usual = torch.stack(known).median().item()
    scale = config.color_sigma * max(1.0, usual / EXACT_DIFFERENCE)
    areas, agreement = torch.empty((2, len(views), len(rendered))).to(rendered.means)

    def gather(k: int) -> None:
        agrees = torch.exp(-((differences[k] / scale) ** 2))
        measured = measure_agreement(frozen[k], rendered.means, views[k], agrees)
        areas[k], agreement[k] = measured

    for _ in get_view_map(rendered.means)(gather, range(len(views))):
        pass
    centers = torch.stack([view.camera.center for view in views])
    return PhotoObservations(rendered.means, centers, areas, agreement)


def measure_agreement(
    frozen: FrozenScene, means: Float[Tensor, "m 3"], view: View, agrees: Float[Tensor, "h w"]
) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
    """Measure visible area [m] and mean agreement [m] of the first m Gaussians at a photograph.

    Its ignored pixels show none of them.
    """
    valid = view.valid_mask.to(agrees)
    layers = torch.stack([valid, valid * agrees, torch.zeros_like(agrees)], dim=-1)
    sums = to_float32(frozen.backproject(layers)[: len(means)])
    area, agreement = np.empty((2, len(means)), np.float32)
    seen = (sums, to_float32(means), convert_camera(view.camera))
    share(kernels.measure_photo_agreement, len(means), *seen, area, agreement)
    return torch.from_numpy(area).to(means), torch.from_numpy(agreement).to(means)


def compute_color_difference(render: Render, view: View) -> Float[Tensor, "h w"]:
    """Compute the absolute colour difference after an exposure fit, averaged over a few pixels."""
    shown = render.image.clamp(0, 1)
    valid = view.valid_mask.flatten()
    pixels = slice(None, None, max(1, int(valid.sum()) // EXPOSURE_PIXELS))
    pairs = (image.reshape(-1, 3)[valid][pixels] for image in (shown, view.image))
    gain, offset = fit_robust_affine(*pairs)
    return blur((view.fill_ignored(gain * shown + offset) - view.image).abs().mean(dim=-1))


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


def sum_weights(frozen: FrozenScene) -> Float[Tensor, "n"]:
    """Sum the compositing weights of each Gaussian over the image."""
    return frozen.backproject(torch.ones_like(frozen.render.image))[:, 0]


def blur(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Apply the box filter of radius `BLUR_RADIUS`."""
    return average_box(values, max(round(BLUR_RADIUS * max(values.shape)), 1))
