"""Fit of a splat to photographs: it is rendered at their cameras and compared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import compute_z_depths
from gscompleter.render.protocols import Renderer
from gscompleter.render.view_map import get_view_map
from gscompleter.types import Camera, Gaussians, Render, View

GAIN_RANGE = (0.5, 2.0)
"""Range of the exposure gain between a render and a photograph."""
MIN_COVERED_SHARE = 0.05
"""Smallest share of covered pixels for a valid score."""
MIN_MARGIN = 3.0
"""Smallest margin in dB of a match: half of the photograph's variance is explained."""
MIN_PSNR = 30.0
"""PSNR in dB of a match whatever its margin, if half of the photograph is covered: a flat one has
no margin."""
MAX_DRIFT = 0.25
"""Largest displacement of an exact alignment, in pixels of the small images that are compared
(`SAMPLE_SIDE`); a scale error of 0.5 % causes 0.5."""
MIN_TRACKED_CORNERS = 15
"""Fewest tracked corners for a valid median."""
MAX_CORNERS = 200
"""Most corners that are tracked."""
MAX_ROUND_TRIP_ERROR = 1.0
"""Largest error of a corner tracked forward and back, in pixels."""

GreyBytes = UInt8[np.ndarray, "h w"]
FlowCorners = Float[np.ndarray, "n 1 2"]


class ImageFit(NamedTuple):
    """Fit of the splat to one photograph."""

    psnr: float = 0.0
    """PSNR in dB over the covered pixels, after matching the exposure."""
    margin: float = 0.0
    """PSNR above that of the best image of one grey, in dB."""
    coverage: float = 0.0
    """Share of the valid pixels of the photograph that the splat covers."""
    drift: float = math.inf
    """Displacement of corners from render to photograph, in pixels; infinity if unknown."""

    @property
    def is_match(self) -> bool:
        """True if the splat shows the content of the photograph."""
        is_alike = self.psnr >= MIN_PSNR and self.coverage >= 0.5
        return self.coverage >= MIN_COVERED_SHARE and (self.margin >= MIN_MARGIN or is_alike)


class SplatFit(NamedTuple):
    """Fit to several photographs: medians over the better half of those that see the splat."""

    psnr: float
    margin: float
    coverage: float
    """Mean over all photographs."""
    drift: float
    is_match: bool
    """True if the splat matches two photographs, or the only one."""

    @property
    def is_exact(self) -> bool:
        """True if the splat fits and is displaced by at most `MAX_DRIFT`."""
        return self.is_match and self.drift <= MAX_DRIFT


def summarize_fits(images: Sequence[ImageFit]) -> SplatFit:
    """Summarize the fits to several photographs."""
    # The better half by margin: some photographs may show what the splat does not.
    seen = [image for image in images if image.coverage >= MIN_COVERED_SHARE]
    seen.sort(key=lambda image: image.margin, reverse=True)
    better = seen[: math.ceil(len(seen) / 2)] or [ImageFit()]
    # The upper median of each, which may come from different photographs.
    psnr, margin, _, drift = [
        sorted(values)[len(better) // 2] for values in zip(*better, strict=True)
    ]
    coverage = sum(image.coverage for image in images) / max(len(images), 1)
    is_match = sum(image.is_match for image in images) >= max(1, min(2, len(images)))
    return SplatFit(psnr, margin, coverage, drift, is_match)


def score_splat(scene: Gaussians, views: Sequence[View], renderer: Renderer) -> SplatFit:
    """Score `scene` against photographs whose cameras are in its frame."""

    def fit(view: View) -> ImageFit:
        return score_image(render_from(scene, view.camera, renderer), view)

    return summarize_fits(list(get_view_map(scene.means)(fit, views)))


def render_from(scene: Gaussians, camera: Camera, renderer: Renderer) -> Render:
    """Render `scene`, with a near plane derived from its own depths, and without a far plane."""
    z = compute_z_depths(scene.means, camera)
    # The planes of the photographs are in their unit, and the splat may have another.
    unit = z[z > 0].median().item() if (z > 0).any() else 1.0
    with torch.no_grad():
        return renderer.render(scene, replace(camera, near=0.1 * unit, far=None))


def score_image(render: Render, view: View) -> ImageFit:
    """Score a render against one photograph, except where that is ignored."""
    photograph = view.image
    where = (render.alpha >= COVERED) & view.valid_mask
    covered = where.sum().item() / max(int(view.valid_mask.sum()), 1)
    if covered < MIN_COVERED_SHARE:
        return ImageFit(coverage=covered)
    truth = photograph[where].double()
    rendered = match_render(render.image[where].double(), truth)
    psnr = convert_to_psnr((rendered - truth).square().mean())

    # A blurred or uniform photograph has a high PSNR with any image, so the margin counts.
    margin = psnr - convert_to_psnr((truth - truth.mean()).square().mean())

    # Outside the covered pixels both images are the photograph, so that the border moves no corner.
    composed = photograph.double().index_put((where,), rendered)
    drift = measure_drift(
        composed.mean(dim=-1).cpu().numpy(),
        photograph.double().mean(dim=-1).cpu().numpy(),
        where.cpu().numpy(),
    )
    return ImageFit(psnr, margin, covered, drift)


def match_render(
    rendered: Float[Tensor, "n 3"], truth: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Match the exposure of `truth` by one gain and one offset (least squares)."""
    centred = rendered - rendered.mean()
    gain = (centred * (truth - truth.mean())).sum() / centred.square().sum().clamp_min(1e-12)
    return gain.clamp(*GAIN_RANGE) * centred + truth.mean()


def convert_to_psnr(error: Float[Tensor, ""]) -> float:
    """Convert a mean squared error to PSNR in dB, at most 100."""
    return -10 * math.log10(max(error.item(), 1e-10))


def measure_drift(
    rendered: Float[np.ndarray, "h w"],
    truth: Float[np.ndarray, "h w"],
    valid_mask: Bool[np.ndarray, "h w"],
) -> float:
    """Compute the median displacement of corners from a render to a photograph, in pixels.

    Corners are tracked forward and back (Lucas-Kanade); infinity if too few survive.
    """
    before = (255 * rendered.clip(0, 1)).round().astype(np.uint8)
    after = (255 * truth.clip(0, 1)).round().astype(np.uint8)
    mask = valid_mask.astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(before, MAX_CORNERS, 0.01, 5, mask=mask)
    if corners is None:
        return math.inf
    there, is_found = track_corners(before, after, corners)
    back, is_found_again = track_corners(after, before, there)
    # A corner that was tracked to a wrong place rarely returns to where it began.
    is_back = np.linalg.norm(back - corners, axis=2)[:, 0] < MAX_ROUND_TRIP_ERROR
    trusted = is_found & is_found_again & is_back
    if trusted.sum() < MIN_TRACKED_CORNERS:
        return math.inf
    return float(np.median(np.linalg.norm(there - corners, axis=2)[trusted]))


def track_corners(
    before: GreyBytes, after: GreyBytes, corners: FlowCorners
) -> tuple[FlowCorners, Bool[np.ndarray, "n"]]:
    """Track corners, up to about 50 px far, to another image, and mark those that were found."""
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after, corners, np.zeros_like(corners), winSize=(15, 15), maxLevel=3
    )
    return np.asarray(moved), np.asarray(status)[:, 0] > 0
