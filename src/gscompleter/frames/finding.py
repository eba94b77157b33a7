"""The frame of a user's splat: as given, as a known trainer leaves it, or found by the images."""

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
"""dB by which a frame must fit better than a simpler one to take its place. A blurred splat in the
right frame gains one from being a little smaller."""

FAR_OFF = 2.0
"""Pixels of drift in small photographs from which a user should know of it."""

Method = Literal["given", "cameras", "dataparser", "normalised", "similarity"]
Candidate = tuple[Method, Matrix]
"""A transform from the photographs' frame to the splat's, and where it comes from."""


@dataclass(frozen=True)
class SplatFrame:
    """Where a splat lies relative to its photographs."""

    method: Method
    """As given, by cameras or the transform that a trainer left, as a known trainer normalises,
    or by the images."""
    transform: Matrix
    """From the frame of the photographs to that of the splat."""
    fit: FrameFit
    """How well the splat fits the photographs there."""
    given: FrameFit
    """How well it fits them as they were given."""

    def sentence(self) -> str:
        """What was found, for the user."""
        found = f"the photographs at {self.fit.psnr:.1f} dB ({self.given.psnr:.1f} dB as given)"
        where = {
            "given": f"The splat fits the photographs as it is, at {self.fit.psnr:.1f} dB",
            "cameras": f"The splat lies in the frame of its trainer's list of cameras: {found}",
            "dataparser": f"The splat lies in the frame of dataparser_transforms.json: {found}",
            "normalised": f"The splat lies in the frame that its trainer normalised to: {found}",
            "similarity": f"The splat lies in another frame, which the images told: {found}",
        }[self.method]
        if not FAR_OFF < self.fit.drift < math.inf:
            return f"{where}."
        return f"{where}; but details are {self.fit.drift:.1f} px (of {LONG_SIDE}) off."


@dataclass(frozen=True)
class Evidence:
    """All that tells where a splat lies."""

    scene: Gaussians
    """The splat. One of very many lies in an order in which neighbours follow each other."""
    views: Sequence[View]
    """A few small photographs, in their own frame."""
    renderer: Renderer

    def near(self, transform: Matrix) -> Evidence:
        """The same with what the photographs can see of the splat if that is about where it lies,
        by a transform from their frame to its."""
        cameras = [moved_camera(view.camera, transform) for view in self.views]
        proxy = proxy_of(self.scene, cameras)
        return replace(self, scene=thinned(self.scene if proxy is None else proxy.scene))

    def at(self, transform: Matrix) -> FrameFit:
        """The fit under a transform from the photographs' frame to the splat's."""
        views = [moved_view(view, transform) for view in self.views]
        return frame_fit(self.near(transform).scene, views, self.renderer)


def find_frame(
    evidence: Evidence,
    poses: Poses,
    points: Points | None = None,
    left: Iterable[Candidate] = (),
) -> SplatFrame:
    """Where the splat lies, by how well it fits its photographs.

    Frames are tried from the simplest on until one fits, and the first in which all is in place
    ends the search. One that fits gives way only to one that fits better by `CLEARLY`.

    Args:
        poses: Of all photographs [n, 4, 4], camera-to-world.
        points: Sparse points in their frame, where there are some.
        left: What the splat's trainer left word of.

    Raises:
        InputError: where no frame was found that fits.
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
    """Frames other than the given one that can be known without the images, simplest first."""
    yield from left
    for _, transform in trainers_frames(poses, points):
        yield "normalised", transform


def known_frame(evidence: Evidence, best: SplatFrame, others: Iterable[Candidate]) -> SplatFrame:
    """`best`, or a clearly better one of `others`; the first in which all is in place."""
    for method, transform in others:
        fit = evidence.at(transform)
        if better(fit, best.fit):
            best = SplatFrame(method, transform, fit, best.given)
        if best.fit.in_place:
            break
    return best


def better(fit: FrameFit, than: FrameFit) -> bool:
    """Whether a fit is clearly the better one, and of not much less of the photographs."""
    if not fit.fits or fit.covered < 0.5 * than.covered:
        return False
    return not than.fits or fit.margin > than.margin + CLEARLY


def polished(evidence: Evidence, found: SplatFrame) -> SplatFrame:
    """`found`, or the similarity near it that features agree with where it is clearly better."""
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
    """The first similarity by which the splat shows what the photographs show; None without one."""
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
