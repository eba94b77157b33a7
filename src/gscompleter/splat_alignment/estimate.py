"""Estimates the similarity from the photographs' frame to the splat's frame."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gscompleter.errors import InputError
from gscompleter.render import Renderer
from gscompleter.render.lod import build_proxy, thin_gaussians
from gscompleter.splat_alignment.fit import SplatFit, score_splat
from gscompleter.splat_alignment.matching import extract_photo_features
from gscompleter.splat_alignment.refinement import refine_similarity
from gscompleter.splat_alignment.sample_views import LONG_SIDE, estimate_points
from gscompleter.splat_alignment.search import search_similarities
from gscompleter.splat_alignment.similarity import (
    Matrix,
    get_pose,
    has_baseline,
    transform_camera,
    transform_view,
)
from gscompleter.splat_alignment.trainer_frames import Points, Poses, compute_trainer_frames
from gscompleter.types import Gaussians, View

MIN_IMPROVEMENT = 2.0
"""Gain in dB by which a frame must fit better than a simpler one; blur alone can cause 1 dB."""

DRIFT_WARNING = 2.0
"""Displacement in pixels of the small photographs from which the user is warned."""

AlignmentMethod = Literal["given", "cameras", "dataparser", "normalised", "similarity"]
FrameProposal = tuple[AlignmentMethod, Matrix]
"""A transform from the photographs' frame to the splat's, and its source."""


@dataclass(frozen=True)
class SplatAlignment:
    """The frame of a splat relative to its photographs."""

    method: AlignmentMethod
    """Source of the transform: none, a file of the trainer, its normalisation, or the images."""
    transform: Matrix
    """From the frame of the photographs to that of the splat."""
    fit: SplatFit
    """Fit of the splat to the photographs under `transform`."""
    given_fit: SplatFit
    """Fit under the identity."""

    def describe(self) -> str:
        """Describe the alignment in a sentence."""
        given = f"{self.given_fit.psnr:.1f} dB as given"
        found = f"it fits the photographs at {self.fit.psnr:.1f} dB ({given})"
        where = {
            "given": f"The splat fits the photographs as it is, at {self.fit.psnr:.1f} dB",
            "cameras": f"The splat is in the frame of its trainer's camera list: {found}",
            "dataparser": f"The splat is in the frame of dataparser_transforms.json: {found}",
            "normalised": f"The splat is in the frame that its trainer normalised to: {found}",
            "similarity": f"The splat is in a frame found by matching image features: {found}",
        }[self.method]
        if not DRIFT_WARNING < self.fit.drift < math.inf:
            return f"{where}."
        return (
            f"{where}; but details are off by {self.fit.drift:.1f} px in images of {LONG_SIDE} px."
        )


@dataclass(frozen=True)
class AlignmentData:
    """The splat and the photographs that it is aligned with."""

    scene: Gaussians
    """The splat. Large ones are in spatial order, so that neighbours are adjacent."""
    views: Sequence[View]
    """A few small photographs, in their own frame."""
    renderer: Renderer

    def restrict_to(self, transform: Matrix) -> AlignmentData:
        """Simplify the splat to what the cameras see under `transform`, photographs to splat."""
        cameras = [transform_camera(view.camera, transform) for view in self.views]
        proxy = build_proxy(self.scene, cameras)
        return replace(self, scene=thin_gaussians(self.scene if proxy is None else proxy.scene))

    def score_transform(self, transform: Matrix) -> SplatFit:
        """Score a transform from the photographs' frame to the splat's."""
        views = [transform_view(view, transform) for view in self.views]
        return score_splat(self.restrict_to(transform).scene, views, self.renderer)


def estimate_alignment(
    data: AlignmentData,
    poses: Poses,
    points: Points | None = None,
    trainer_frames: Iterable[FrameProposal] = (),
) -> SplatAlignment:
    """Estimate the frame of the splat by how well it fits its photographs.

    Frames are tried from the simplest on, up to the first that is exact. One that fits is replaced
    only by one that fits better by `MIN_IMPROVEMENT`. `poses` are camera-to-world of all
    photographs,
    `points` sparse points in their frame.

    Raises:
        InputError: No frame fits.
    """
    given = data.score_transform(np.eye(4))
    best = SplatAlignment("given", np.eye(4), given, given)
    if given.is_exact:
        return best
    if not given.is_match:
        best = select_known_frame(data, best, propose_frames(poses, points, trainer_frames))
    if best.fit.is_match:
        return best if best.fit.is_exact else polish(data, best)
    found = search_alignment(data, points, best.given_fit)
    if found is None:
        raise InputError(
            f"The splat does not show what the photographs show: at their cameras it covers "
            f"{100 * best.given_fit.coverage:.0f} % of the pixels and matches them at "
            f"{best.given_fit.psnr:.1f} dB, and no other frame was found; give the photographs and "
            "poses that the splat was trained on."
        )
    return found


def propose_frames(
    poses: Poses, points: Points | None, trainer_frames: Iterable[FrameProposal]
) -> Iterator[FrameProposal]:
    """Yield frames that are known without the images, the simplest first."""
    yield from trainer_frames
    for _, transform in compute_trainer_frames(poses, points):
        yield "normalised", transform


def select_known_frame(
    data: AlignmentData, best: SplatAlignment, others: Iterable[FrameProposal]
) -> SplatAlignment:
    """Select the best of `best` and `others`, stopping at the first that is exact."""
    for method, transform in others:
        fit = data.score_transform(transform)
        if is_better(fit, best.fit):
            best = SplatAlignment(method, transform, fit, best.given_fit)
        if best.fit.is_exact:
            break
    return best


def is_better(fit: SplatFit, than: SplatFit) -> bool:
    """Return True if a fit is clearly better and has at least half of the coverage."""
    if not fit.is_match or fit.coverage < 0.5 * than.coverage:
        return False
    return not than.is_match or fit.margin > than.margin + MIN_IMPROVEMENT


def polish(data: AlignmentData, found: SplatAlignment) -> SplatAlignment:
    """Refine an alignment by image features; keep `found` unless the result is clearly better."""
    data = data.restrict_to(found.transform)
    photographs = extract_photo_features(data.views)
    transform = refine_similarity(data.scene, photographs, found.transform, data.renderer)
    if transform is None:
        return found
    fit = data.score_transform(transform)
    return (
        SplatAlignment("similarity", transform, fit, found.given_fit)
        if is_better(fit, found.fit)
        else found
    )


def search_alignment(
    data: AlignmentData, points: Points | None, given: SplatFit
) -> SplatAlignment | None:
    """Search all directions for the first similarity that fits, or return None."""
    renderer = data.renderer
    if not has_baseline([get_pose(view.camera) for view in data.views]):
        return None
    photographs = extract_photo_features(data.views)
    place = estimate_points(data.views) if points is None else points
    for start in search_similarities(thin_gaussians(data.scene), photographs, place, renderer):
        transform = refine_similarity(data.restrict_to(start).scene, photographs, start, renderer)
        if transform is None:
            continue
        fit = data.score_transform(transform)
        if fit.is_match:
            return SplatAlignment("similarity", transform, fit, given)
    return None
