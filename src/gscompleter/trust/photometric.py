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
from gscompleter.system.files.mapping import file_beside, release_pages
from gscompleter.system.threads import use_one_torch_thread
from gscompleter.trust import HeldViews, Trust
from gscompleter.types import Camera, Gaussians, Render, View

BOX_RADIUS = 0.01
"""Radius of box filters, relative to the longer side; it tolerates edges off by a pixel."""
EXPOSURE_PIXELS = 10_000
"""Pixels that the exposure fit uses."""
EXACT_DIFFERENCE = 0.02
"""Median colour difference up to which a scene counts as exact."""
FULL_TRUST_FRACTION = 0.5
"""Fraction of a Gaussian's area in a camera that a photograph has to show for full trust."""


@dataclass(frozen=True)
class PhotoObservations:
    """Observations of m context Gaussians in k photographs, from which trust is computed.

    Kernels of the CPU read them, so that what was measured lies there.
    """

    means: Float[Tensor, "m 3"]
    centers: Float[Tensor, "k 3"]
    areas: Float[Tensor, "k m"]
    """Visible area of each Gaussian in each photograph, in squared scene units; on the CPU."""
    agreement: Float[Tensor, "k m"]
    """Photometric consistency at each Gaussian, in [0, 1], on the CPU; 0 if it is not visible."""


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
        """Render accumulated opacity weighted by trust; added and invisible Gaussians have 1.

        This is A_trust of the method page.
        """
        sums = sum_weights(frozen)
        num_context = len(self.observations.means)
        trust = compute_trust(self.observations, sums[:num_context], camera, self.config)
        # Recoloured Gaussians are trusted: without this, targets in a row compound (decision 038).
        trust = torch.where(self.is_recolored, 1.0, trust)
        # Added Gaussians follow those of the context.
        weights = pad(trust, (0, len(sums) - num_context), value=1.0)
        # The blur also spreads trust into holes, where no more can be trusted than is opaque.
        return torch.minimum(apply_box_filter(frozen.splat(weights)), frozen.render.alpha)

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
        """Restrict to ascending rows that stand for their neighbours, each enlarged by a factor."""
        seen = self.observations
        # Rows that returned after a removal follow those observed, and are taken for added ones.
        is_observed = rows < len(seen.means)
        rows = rows[is_observed]
        growth = growth[is_observed]
        measured = rows.cpu()
        # Growth is of the lengths.
        areas = seen.areas[:, measured] * growth.cpu() ** 2
        thinned = PhotoObservations(
            means=seen.means[rows],
            centers=seen.centers,
            areas=file_beside(areas, seen.areas),
            agreement=file_beside(seen.agreement[:, measured], seen.agreement),
        )
        held_sums = self.held.sums
        held = replace(self.held, sums=file_beside(held_sums[:, rows], held_sums))
        for values in (seen.areas, seen.agreement, held_sums):
            release_pages(values)
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
    settings = config.trust_settings
    cameras = tuple(view.camera for view in views)
    frozen = scenes.freeze_at(parts, cameras)
    observations = gather_observations(parts[0], views, frozen, settings)

    # Photographs hold colours by their summed weights in pixels. Those are the visible areas,
    # divided by the area of a pixel, and so leave out ignored pixels.
    means = observations.means
    sums = torch.stack(
        [
            area.to(means) / compute_pixel_areas(means, camera).clamp_min(1e-30)
            for area, camera in zip(observations.areas, cameras, strict=True)
        ]
    )
    weights = sums.new_full((len(cameras),), config.recolor.hold_weight)
    # For each photograph a number for each Gaussian: with a large scene that is much memory.
    sums = file_beside(sums, parts[0].sh)
    release_pages(observations.areas)
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
    # A difference that is usual in this scene is no evidence against a Gaussian, so the scale of
    # differences grows with the median one.
    differences, usual = compute_color_differences(views, [scene.render for scene in frozen])
    scale = config.color_sigma * max(1.0, usual / EXACT_DIFFERENCE)

    dtype = rendered.means.dtype
    areas, agreement = torch.empty((2, len(views), len(rendered)), dtype=dtype)

    def gather(k: int) -> None:
        agrees = torch.exp(-((differences[k] / scale) ** 2))
        areas[k], agreement[k] = measure_agreement(frozen[k], rendered.means, views[k], agrees)

    # The map is lazy on a GPU: each photograph is measured when its result is asked for.
    for _ in get_view_map(rendered.means)(gather, range(len(views))):
        pass
    centers = torch.stack([view.camera.center for view in views])
    # They are as large as the scene, and are read only when trust is computed.
    areas = file_beside(areas, rendered.sh)
    agreement = file_beside(agreement, rendered.sh)
    return PhotoObservations(rendered.means, centers, areas, agreement)


def measure_agreement(
    frozen: FrozenScene, means: Float[Tensor, "m 3"], view: View, agrees: Float[Tensor, "h w"]
) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
    """Measure visible area [m] and mean agreement [m] of the first m Gaussians at a photograph.

    `agrees` is the agreement of each pixel, in [0, 1]. Ignored pixels show none of the Gaussians.
    Both come out on the CPU.
    """
    # Two sums are needed, and a backprojection takes three channels.
    valid = view.valid_mask.to(agrees)
    layers = torch.stack([valid, valid * agrees, torch.zeros_like(agrees)], dim=-1)
    sums = to_float32(frozen.backproject(layers)[: len(means)])
    pose = convert_camera(view.camera)
    area = np.empty(len(means), np.float32)
    agreement = np.empty(len(means), np.float32)
    share(
        kernels.measure_photo_agreement,
        len(means),
        sums,
        to_float32(means),
        pose,
        area,
        agreement,
    )
    dtype = means.dtype
    return torch.from_numpy(area).to(dtype), torch.from_numpy(agreement).to(dtype)


def compute_color_differences(
    views: Sequence[View], renders: Sequence[Render]
) -> tuple[list[Float[Tensor, "_ _"]], float]:
    """Compute the colour difference at each photograph, and the one that is usual in the scene.

    That is the median of the medians of all photographs; masks may hide one, but not all of them.
    """
    with use_one_torch_thread():
        differences = map_in_parallel(compute_color_difference, renders, views)
    medians = [
        difference[view.valid_mask].median()
        for difference, view in zip(differences, views, strict=True)
        if view.valid_mask.any()
    ]
    return differences, torch.stack(medians).median().item()


def compute_color_difference(render: Render, view: View) -> Float[Tensor, "h w"]:
    """Compute the absolute colour difference after an exposure fit, averaged over a few pixels."""
    shown = render.image.clamp(0, 1)
    # The fit takes every n-th valid pixel, to save time.
    valid = view.valid_mask.flatten()
    step = max(1, int(valid.sum()) // EXPOSURE_PIXELS)
    shown_pixels = shown.reshape(-1, 3)[valid][::step]
    photo_pixels = view.image.reshape(-1, 3)[valid][::step]
    gain, offset = fit_robust_affine(shown_pixels, photo_pixels)
    return apply_box_filter(
        (view.fill_ignored(gain * shown + offset) - view.image).abs().mean(dim=-1)
    )


def compute_trust(
    observations: PhotoObservations,
    sums: Float[Tensor, "m"],
    camera: Camera,
    config: TrustConfig = TrustConfig(),
) -> Float[Tensor, "m"]:
    """Compute the trust of each Gaussian from a camera: in [0, 1], 1 for invisible ones.

    This is trust_i of the method page. `sums` are the summed compositing weights of each Gaussian
    in the image of `camera`.
    """
    pose = convert_camera(camera)
    values = np.empty(len(sums), np.float32)
    share(
        kernels.accumulate_trust,
        len(values),
        to_float32(observations.centers),
        to_float32(observations.areas),
        to_float32(observations.agreement),
        to_float32(observations.means),
        to_float32(sums),
        pose,
        np.float32(math.radians(config.angle_sigma)),
        np.float32(FULL_TRUST_FRACTION),
        values,
    )
    release_pages(observations.areas)
    release_pages(observations.agreement)
    return torch.from_numpy(values).to(sums)


def convert_camera(camera: Camera) -> CameraPose:
    """Convert a camera to the form that the kernels read."""
    focal_product = np.float32((camera.K[0, 0] * camera.K[1, 1]).item())
    return CameraPose(to_float32(camera.center), to_float32(camera.forward), focal_product)


def sum_weights(frozen: FrozenScene) -> Float[Tensor, "n"]:
    """Sum the compositing weights of each Gaussian over the image."""
    return frozen.backproject(torch.ones_like(frozen.render.image))[:, 0]


def apply_box_filter(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Apply the box filter of radius `BOX_RADIUS`."""
    return average_box(values, max(round(BOX_RADIUS * max(values.shape)), 1))
