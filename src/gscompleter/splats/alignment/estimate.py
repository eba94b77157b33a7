"""Estimates the similarity from the photographs' frame to the splat's frame."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from typing import Literal

import numpy as np
import torch

from gscompleter.data.cameras import Poses
from gscompleter.data.photographs import Photographs
from gscompleter.numerics.sampling import sample_evenly
from gscompleter.reconstructors.features.depth_range import estimate_depth_range
from gscompleter.reconstructors.features.stereo_image import has_distinct_centers
from gscompleter.render.lod import build_proxy, thin_gaussians
from gscompleter.render.protocols import Renderer
from gscompleter.splats.alignment.fit import SplatFit, render_from, score_image, score_splat
from gscompleter.splats.alignment.matching import (
    extract_view_features,
    refine_similarity,
    search_similarities,
)
from gscompleter.splats.alignment.similarity import Matrix, transform_camera, transform_view
from gscompleter.splats.alignment.trainer_frames import (
    InputSplat,
    Points,
    collect_poses,
    compute_trainer_frames,
    read_trainer_frames,
)
from gscompleter.system.errors import InputError
from gscompleter.types import Gaussians, View

NUM_SAMPLE_VIEWS = 8
"""Photographs at which a frame is judged."""
MAX_ASKED_VIEWS = 40
"""Most photographs that are asked before a splat is refused: it may cover few of them."""
MIN_SHOWN = 2
"""Fewest of them that have to match: a single one may do so by chance."""
SAMPLE_SIDE = 320
"""Longer side of the samples in pixels: enough for features, and for a frame that is off by a pixel
of them to show as a blur."""
GRID_STEP = 16
"""Pixels of the samples from one point of a grid to the next: some hundred points for each."""
MIN_IMPROVEMENT = 2.0
"""Gain in dB by which a frame must fit better than a simpler one. A blurred splat in the right
frame gains one from being a little smaller."""
MIN_KEPT_COVERAGE = 0.5
"""Least coverage of a frame, relative to that of the one that it replaces: one that moves most of
the splat out of the photographs may fit well what is left."""
DRIFT_WARNING = 2.0
"""Displacement in pixels of the small photographs from which the user is warned."""

AlignmentMethod = Literal["given", "cameras", "dataparser", "normalised", "similarity"]
FRAMES: dict[AlignmentMethod, str] = {
    "given": "as it is",
    "cameras": "in the frame of its trainer's camera list",
    "dataparser": "in the frame of dataparser_transforms.json",
    "normalised": "in the frame that its trainer normalised to",
    "similarity": "in a frame found by matching image features",
}
FrameProposal = tuple[AlignmentMethod, Matrix]
"""A transform from the photographs' frame to the splat's, and its source."""


@dataclass(frozen=True)
class SplatAlignment:
    """The frame of a splat relative to its photographs."""

    method: AlignmentMethod
    transform: Matrix
    """From the frame of the photographs to that of the splat."""
    fit: SplatFit
    given_fit: SplatFit
    """Fit under the identity."""
    side: int = SAMPLE_SIDE
    """Longer side of the largest image in which it was measured, in pixels."""

    def describe(self) -> str:
        """Describe the alignment in a sentence."""
        sentence = (
            f"The splat {FRAMES[self.method]} fits the photographs at {self.fit.psnr:.1f} dB in "
            f"images of {self.side} px"
        )
        if self.method != "given":
            sentence += f" ({self.given_fit.psnr:.1f} dB as given)"
        if DRIFT_WARNING < self.fit.drift < math.inf:
            sentence += f"; details are off by {self.fit.drift:.1f} px in them"
        return f"{sentence}."


@dataclass(frozen=True)
class AlignmentData:
    """The splat and the photographs that it is aligned with."""

    scene: Gaussians
    """The splat. Large ones are in spatial order, so that neighbours are adjacent."""
    views: Sequence[View]
    renderer: Renderer

    def restrict_to(self, transform: Matrix) -> AlignmentData:
        """Simplify the splat to what the cameras see under `transform`, photographs to splat."""
        cameras = [transform_camera(view.camera, transform) for view in self.views]
        return replace(self, scene=thin_gaussians(build_proxy(self.scene, cameras).rendered))

    def score_transform(self, transform: Matrix) -> SplatFit:
        """Score a transform from the photographs' frame to the splat's."""
        views = [transform_view(view, transform) for view in self.views]
        return score_splat(self.restrict_to(transform).scene, views, self.renderer)

    def find_shown(self) -> list[View]:
        """Find the photographs that the splat shows as it is, the best `NUM_SAMPLE_VIEWS`."""
        scene = self.restrict_to(np.eye(4)).scene
        fits = [
            score_image(render_from(scene, view.camera, self.renderer), view) for view in self.views
        ]
        matches = [(fit, view) for fit, view in zip(fits, self.views, strict=True) if fit.is_match]
        matches.sort(key=lambda match: -match[0].margin)
        return [view for _, view in matches[:NUM_SAMPLE_VIEWS]]


def align_splat(
    splat: InputSplat,
    photographs: Photographs,
    frames: Sequence[int],
    renderer: Renderer,
    sources: Sequence[int] = (),
) -> SplatAlignment:
    """Estimate the transform from photographs to splat, both at their origins.

    It is measured at `frames` and further ones, or at the `sources` of the splat if they are known:
    elsewhere it may show nothing right.

    Raises:
        InputError: The splat shows none of the photographs that were asked.
    """
    device = splat.scene.means.device
    poses = np.stack([pose for _, pose in collect_poses(photographs)])
    points = photographs.points()

    def align(views: Sequence[View]) -> SplatAlignment:
        """Estimate the alignment by some photographs."""
        return estimate_alignment(
            AlignmentData(splat.scene, views, renderer),
            poses,
            None if points is None else points.double().numpy(),
            read_trainer_frames(splat, photographs),
        )

    best = align([view.to(device) for view in sample_views(photographs, frames, sources)])
    if best.fit.is_match:
        return best
    # A part of a long drive covers few of its photographs, and the samples may miss them.
    spread = sample_evenly(range(len(photographs)), MAX_ASKED_VIEWS)
    others = [view.to(device) for view in read_views(photographs, spread)]
    shown = AlignmentData(splat.scene, others, renderer).find_shown()
    if len(shown) >= MIN_SHOWN:
        best = align(shown)
    if not best.fit.is_match:
        raise InputError(
            f"The splat does not show what the photographs show: at their cameras it covers "
            f"{100 * best.given_fit.coverage:.0f} % of the pixels and matches them at "
            f"{best.given_fit.psnr:.1f} dB; give the photographs and poses that it was trained on."
        )
    return best


def sample_views(
    photographs: Photographs, frames: Sequence[int], sources: Sequence[int] = ()
) -> list[View]:
    """Load some of the `sources` of a splat.

    If these are not known, or none can be read, load the first of `frames` and, spread over all,
    further photographs that can be read.
    """
    views = read_views(photographs, sample_evenly(sources, NUM_SAMPLE_VIEWS))
    if views:
        return views
    # Half of the samples are the frames of the context, half are from all over.
    named = list(frames)[: NUM_SAMPLE_VIEWS // 2]
    others = [frame for frame in range(len(photographs)) if frame not in named]
    spread = sample_evenly(others, NUM_SAMPLE_VIEWS - len(named))
    return photographs.views(named, SAMPLE_SIDE) + read_views(photographs, spread)


def read_views(photographs: Photographs, frames: Sequence[int]) -> list[View]:
    """Read those of the photographs that can be read, at the size of samples."""
    views: list[View] = []
    for frame in frames:
        with suppress(InputError):
            views += photographs.views([frame], SAMPLE_SIDE)
    return views


def estimate_alignment(
    data: AlignmentData,
    poses: Poses,
    points: Points | None = None,
    trainer_frames: Iterable[FrameProposal] = (),
) -> SplatAlignment:
    """Estimate the frame of the splat by how well it fits its photographs, if it does.

    Frames are tried from the simplest on, up to the first that is exact. One that fits is replaced
    only by one that fits better by `MIN_IMPROVEMENT`. A splat that matches as it is needs no other
    frame: features alone correct what is slightly off. `poses` are camera-to-world of all
    photographs, `points` sparse points in their frame.
    """
    given = data.score_transform(np.eye(4))
    side = max(max(view.camera.width, view.camera.height) for view in data.views)
    best = SplatAlignment("given", np.eye(4), given, given, side)

    # In another frame. Those that trainers' files state come before computed ones, which are made
    # when tried.
    if not given.is_match:
        computed = compute_trainer_frames(poses, points)
        normalised: Iterable[FrameProposal] = (("normalised", frame) for frame in computed)
        for method, transform in chain(trainer_frames, normalised):
            fit = data.score_transform(transform)
            if is_better(fit, best.fit):
                best = replace(best, method=method, transform=transform, fit=fit)
            if best.fit.is_exact:
                break

    # Features find any frame, and correct one that is slightly off.
    if not best.fit.is_exact:
        best = align_by_features(data, best, points)
    return best


def is_better(fit: SplatFit, than: SplatFit) -> bool:
    """Return True if a fit is a match and clearly better, and covers enough of the photographs."""
    if not fit.is_match or not than.is_match:
        return fit.is_match
    has_coverage = fit.coverage >= MIN_KEPT_COVERAGE * than.coverage
    return has_coverage and fit.margin > than.margin + MIN_IMPROVEMENT


def align_by_features(
    data: AlignmentData, best: SplatAlignment, points: Points | None
) -> SplatAlignment:
    """Improve an alignment by image features; without a match, search from all directions."""
    # A match is refined where it is; else the splat is searched all around for a start.
    photographs = [(view.camera, extract_view_features(view)) for view in data.views]
    if best.fit.is_match:
        starts: Iterable[Matrix] = [best.transform]
    else:
        # From one place nothing tells the size of a frame.
        if not has_distinct_centers(data.views):
            return best
        if points is None:
            points = estimate_points(data.views)
        scene = thin_gaussians(data.scene)
        starts = search_similarities(scene, photographs, points, data.renderer)
    for start in starts:
        scene = data.restrict_to(start).scene
        transform = refine_similarity(scene, photographs, start, data.renderer)
        if transform is None:
            continue
        fit = data.score_transform(transform)
        if is_better(fit, best.fit):
            return replace(best, method="similarity", transform=transform, fit=fit)
    return best


def estimate_points(views: Sequence[View]) -> Points:
    """Estimate scene points without a sparse cloud: a grid of pixels of each view, at one depth.

    The points tell where the scene lies and how large it is, so that a rough depth will do: the
    geometric mean of the nearest and the farthest that features show.
    """
    near, far = estimate_depth_range(views)
    depth = float(np.sqrt(near * far))
    points = []
    for view in views:
        rays = view.camera.z_rays()[::GRID_STEP, ::GRID_STEP].reshape(-1, 3)
        points.append(view.camera.center + depth * rays)
    return torch.cat(points).double().cpu().numpy()
