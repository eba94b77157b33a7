"""The frame of a user's splat: as given, as a known trainer leaves it, or found by the images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gscompleter.errors import InputError
from gscompleter.frames.fit import NO_FIT, FrameFit, frame_fit
from gscompleter.frames.matching import photographs_of
from gscompleter.frames.refinement import refined
from gscompleter.frames.search import searched
from gscompleter.frames.similarity import Matrix, moved_view
from gscompleter.frames.trainers import Points, Poses, trainers_frames
from gscompleter.frames.witnesses import have_baseline, rough_points
from gscompleter.render import Renderer
from gscompleter.types import Gaussians, View

CLEARLY = 2.0
"""dB by which a frame must fit better than a simpler one to take its place. A blurred splat in the
right frame gains one from being a little smaller."""

Method = Literal["given", "dataparser", "normalised", "similarity"]


@dataclass(frozen=True)
class SplatFrame:
    """Where a splat lies relative to its photographs."""

    method: Method
    """As given, by the trainer's own file, as a known trainer normalises, or by the images."""
    transform: Matrix
    """From the frame of the photographs to that of the splat."""
    fit: FrameFit
    """How well the splat fits the photographs there."""
    given: FrameFit
    """How well it fits them as they were given."""

    def sentence(self) -> str:
        """What was found, for the user."""
        found = f"the photographs at {self.fit.psnr:.1f} dB ({self.given.psnr:.1f} dB as given)"
        return {
            "given": f"The splat fits the photographs as it is, at {self.fit.psnr:.1f} dB.",
            "dataparser": f"The splat lies in the frame of dataparser_transforms.json: {found}.",
            "normalised": f"The splat lies in the frame that its trainer normalised to: {found}.",
            "similarity": f"The splat lies in another frame, which the images told: {found}.",
        }[self.method]


@dataclass(frozen=True)
class Evidence:
    """All that tells where a splat lies."""

    scene: Gaussians
    views: Sequence[View]
    """A few small photographs, in their own frame."""
    renderer: Renderer

    def at(self, transform: Matrix) -> FrameFit:
        """The fit under a transform from the photographs' frame to the splat's."""
        views = [moved_view(view, transform) for view in self.views]
        return frame_fit(self.scene, views, self.renderer)


def find_frame(
    evidence: Evidence,
    poses: Poses,
    points: Points | None = None,
    dataparser: Matrix | None = None,
) -> SplatFrame:
    """Where the splat lies, by how well it fits its photographs.

    A frame gives way to one that is less simple only where that fits better by `CLEARLY`.

    Args:
        poses: Of all photographs [n, 4, 4], camera-to-world.
        points: Sparse points in their frame, where there are some.
        dataparser: What nerfstudio wrote beside the splat, where it did.

    Raises:
        InputError: where no frame was found that fits.
    """
    best = known_frame(evidence, poses, points, dataparser)
    if best.fit.fits:
        return polished(evidence, best)
    found = similarity_frame(evidence, points, best.given)
    if found is None:
        raise InputError(
            f"The splat does not show what the photographs show: at their cameras it covers "
            f"{100 * best.given.covered:.0f} % of the pixels and matches them at "
            f"{best.given.psnr:.1f} dB, and no other frame was found; give the photographs and "
            "poses that the splat was trained on."
        )
    return found


def known_frame(
    evidence: Evidence, poses: Poses, points: Points | None, dataparser: Matrix | None
) -> SplatFrame:
    """The best of the given frame and those of the trainers."""
    given = evidence.at(np.eye(4))
    best = SplatFrame("given", np.eye(4), given, given)
    candidates: list[tuple[Method, Matrix]] = []
    if dataparser is not None:
        candidates.append(("dataparser", dataparser))
    candidates += [("normalised", matrix) for _, matrix in trainers_frames(poses, points)]
    for method, transform in candidates:
        fit = evidence.at(transform)
        if better(fit, best.fit):
            best = SplatFrame(method, transform, fit, given)
    return best


def better(fit: FrameFit, than: FrameFit) -> bool:
    """Whether a fit is clearly the better one; one that shows nothing is none."""
    if fit is NO_FIT or fit.covered < 0.5 * than.covered:
        return False
    return fit.margin > than.margin + CLEARLY


def polished(evidence: Evidence, found: SplatFrame) -> SplatFrame:
    """`found`, or the similarity near it that features agree with where it is clearly better."""
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
    scene, renderer = evidence.scene, evidence.renderer
    if len(evidence.views) < 2 or not have_baseline(evidence.views):
        return None
    photographs = photographs_of(evidence.views)
    place = rough_points(evidence.views) if points is None else points
    for start in searched(scene, photographs, place, renderer):
        transform = refined(scene, photographs, start, renderer)
        fit = NO_FIT if transform is None else evidence.at(transform)
        if transform is not None and fit.fits:
            return SplatFrame("similarity", transform, fit, given)
    return None
