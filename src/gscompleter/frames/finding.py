"""Estimates the similarity from the photographs' frame to the splat's frame."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gscompleter.errors import InputError
from gscompleter.frames.fit import FrameFit, frame_fit
from gscompleter.frames.matching import photographs_of
from gscompleter.frames.refinement import refined
from gscompleter.frames.search import searched
from gscompleter.frames.similarity import (
    Matrix,
    moved_camera,
    moved_view,
    pose_of,
    stand_apart,
)
from gscompleter.frames.thinning import thinned
from gscompleter.frames.trainers import Points, Poses, trainers_frames
from gscompleter.frames.witnesses import LONG_SIDE, rough_points
from gscompleter.render import Renderer
from gscompleter.render.proxy import proxy_of
from gscompleter.types import Gaussians, View

CLEARLY = 2.0
"""Gain in dB by which a frame must fit better than a simpler one; blur alone can cause 1 dB."""

FAR_OFF = 2.0
"""Displacement in pixels of the small photographs from which the user is warned."""

Method = Literal["given", "cameras", "dataparser", "normalised", "similarity"]
Candidate = tuple[Method, Matrix]
"""A transform from the photographs' frame to the splat's, and its source."""


@dataclass(frozen=True)
class SplatFrame:
    """The frame of a splat relative to its photographs."""

    method: Method
    """Source of the transform: none, a file of the trainer, its normalisation, or the images."""
    transform: Matrix
    """From the frame of the photographs to that of the splat."""
    fit: FrameFit
    """Fit of the splat to the photographs under `transform`."""
    given: FrameFit
    """Fit under the identity."""

    def sentence(self) -> str:
        """Describe the alignment in a sentence."""
        found = (
            f"it fits the photographs at {self.fit.psnr:.1f} dB ({self.given.psnr:.1f} dB as given)"
        )
        where = {
            "given": f"The splat fits the photographs as it is, at {self.fit.psnr:.1f} dB",
            "cameras": f"The splat is in the frame of its trainer's camera list: {found}",
            "dataparser": f"The splat is in the frame of dataparser_transforms.json: {found}",
            "normalised": f"The splat is in the frame that its trainer normalised to: {found}",
            "similarity": f"The splat is in a frame found by matching image features: {found}",
        }[self.method]
        if not FAR_OFF < self.fit.drift < math.inf:
            return f"{where}."
        return (
            f"{where}; but details are off by {self.fit.drift:.1f} px in images of {LONG_SIDE} px."
        )


@dataclass(frozen=True)
class Evidence:
    """The splat and the photographs that it is aligned with."""

    scene: Gaussians
    """The splat. Large ones are in spatial order, so that neighbours are adjacent."""
    views: Sequence[View]
    """A few small photographs, in their own frame."""
    renderer: Renderer

    def near(self, transform: Matrix) -> Evidence:
        """Simplify the splat to what the cameras see under `transform`, photographs to splat."""
        cameras = [moved_camera(view.camera, transform) for view in self.views]
        proxy = proxy_of(self.scene, cameras)
        return replace(self, scene=thinned(self.scene if proxy is None else proxy.scene))

    def at(self, transform: Matrix) -> FrameFit:
        """Score a transform from the photographs' frame to the splat's."""
        views = [moved_view(view, transform) for view in self.views]
        return frame_fit(self.near(transform).scene, views, self.renderer)


def find_frame(
    evidence: Evidence,
    poses: Poses,
    points: Points | None = None,
    left: Iterable[Candidate] = (),
) -> SplatFrame:
    """Estimate the frame of the splat by how well it fits its photographs.

    Frames are tried from the simplest on, up to the first that is exact. One that fits is replaced
    only by one that fits better by `MIN_IMPROVEMENT`. `poses` are camera-to-world of all
    photographs,
    `points` sparse points in their frame.

    Raises:
        InputError: No frame fits.
    """
    given = evidence.at(np.eye(4))
    best = SplatFrame("given", np.eye(4), given, given)
    if given.in_place:
        return best
    if not given.fits:
        best = known_frame(evidence, best, candidates(poses, points, left))
    if best.fit.fits:
        return best if best.fit.in_place else polished(evidence, best)
    found = similarity_frame(evidence, points, best.given)
    if found is None:
        raise InputError(
            f"The splat does not show what the photographs show: at their cameras it covers "
            f"{100 * best.given.covered:.0f} % of the pixels and matches them at "
            f"{best.given.psnr:.1f} dB, and no other frame was found; give the photographs and "
            "poses that the splat was trained on."
        )
    return found


def candidates(
    poses: Poses, points: Points | None, left: Iterable[Candidate]
) -> Iterator[Candidate]:
    """Yield frames that are known without the images, the simplest first."""
    yield from left
    for _, transform in trainers_frames(poses, points):
        yield "normalised", transform


def known_frame(evidence: Evidence, best: SplatFrame, others: Iterable[Candidate]) -> SplatFrame:
    """Select the best of `best` and `others`, stopping at the first that is exact."""
    for method, transform in others:
        fit = evidence.at(transform)
        if better(fit, best.fit):
            best = SplatFrame(method, transform, fit, best.given)
        if best.fit.in_place:
            break
    return best


def better(fit: FrameFit, than: FrameFit) -> bool:
    """Return True if a fit is clearly better and has at least half of the coverage."""
    if not fit.fits or fit.covered < 0.5 * than.covered:
        return False
    return not than.fits or fit.margin > than.margin + CLEARLY


def polished(evidence: Evidence, found: SplatFrame) -> SplatFrame:
    """Refine an alignment by image features; keep `found` unless the result is clearly better."""
    evidence = evidence.near(found.transform)
    photographs = photographs_of(evidence.views)
    transform = refined(evidence.scene, photographs, found.transform, evidence.renderer)
    if transform is None:
        return found
    fit = evidence.at(transform)
    return (
        SplatFrame("similarity", transform, fit, found.given) if better(fit, found.fit) else found
    )


def similarity_frame(
    evidence: Evidence, points: Points | None, given: FrameFit
) -> SplatFrame | None:
    """Search all directions for the first similarity that fits, or return None."""
    renderer = evidence.renderer
    if not stand_apart([pose_of(view.camera) for view in evidence.views]):
        return None
    photographs = photographs_of(evidence.views)
    place = rough_points(evidence.views) if points is None else points
    for start in searched(thinned(evidence.scene), photographs, place, renderer):
        transform = refined(evidence.near(start).scene, photographs, start, renderer)
        if transform is None:
            continue
        fit = evidence.at(transform)
        if fit.fits:
            return SplatFrame("similarity", transform, fit, given)
    return None
