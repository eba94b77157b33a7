"""Which camera to complete next, of many.

A camera gains by the part of its image that is a hole, as far as this borders on what was observed:
far from there anything may be invented. It gains in proportion to what its anchor sees of what it
observes itself, for without overlap nothing registers. Of those that gain about as much the nearest
to the photographs comes first: what is added there is what the next ones go on from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gscompleter.config import NextBestViewConfig
from gscompleter.frames.thinning import thinned, thinning
from gscompleter.geometry import (
    baseline_between,
    inside,
    project,
    rotation_between,
    sample,
    unproject,
)
from gscompleter.interpolation import fill_smoothly
from gscompleter.masks import dilate
from gscompleter.stages.candidates import Candidate, opening
from gscompleter.types import (
    Camera,
    Completion,
    Evidence,
    Gaussians,
    Render,
    merge,
    observed,
)

MAX_GAUSSIANS = 25_000
"""Several for each pixel of the images that candidates are judged by."""
SAME_DEPTH = 0.1
"""Share of its depth by which a point may lie behind what the anchor sees, and still be that."""


@dataclass(frozen=True)
class Choice:
    """A camera that may be completed next, and why."""

    candidate: Candidate
    hole: float
    """Share of its image that is a hole."""
    gain: float
    """Share of its image that there is to gain."""

    @property
    def camera(self) -> Camera:
        """The camera itself."""
        return self.candidate.camera


def gain(
    holes: Bool[Tensor, "h w"], overlap: float, config: NextBestViewConfig = NextBestViewConfig()
) -> float:
    """What there is to gain where an image has `holes`, as a share of the image.

    Args:
        holes: True where the scene has a hole.
        overlap: Share of what the camera observes that its anchor sees too.
        config: How far from what was observed a hole counts.
    """
    radius = max(round(config.border_radius * max(holes.shape)), 1)
    bordering = holes & dilate(~holes, radius)
    return bordering.float().mean().item() * overlap


def overlap_of(camera: Camera, render: Render, anchor: Camera, at_anchor: Render) -> float:
    """Share of what `camera` sees of the scene that the anchor sees too, within its image and not
    hidden; 0 where it sees nothing."""
    seen = render.depth_map()
    points = unproject(seen.depth, camera)[seen.valid]
    if len(points) == 0:
        return 0.0
    pixels, z = project(points, anchor)
    surface = sample(at_anchor.depth[..., None], pixels)[:, 0]
    return (inside(pixels, z, anchor) & (z < (1 + SAME_DEPTH) * surface)).float().mean().item()


def best(
    choices: Sequence[Choice],
    photographs: Sequence[Camera],
    step: float,
    config: NextBestViewConfig = NextBestViewConfig(),
) -> Choice | None:
    """The camera to complete next; None where little is left to gain.

    Args:
        choices: Cameras and what each of them gains.
        photographs: Cameras of the photographs that the scene comes from.
        step: How far a camera moves, in scene units.
        config: What is little.
    """
    most = max((choice.gain for choice in choices), default=0.0)
    if most < config.min_gain:
        return None
    good = [choice for choice in choices if choice.gain >= config.enough * most]

    def order(choice: Choice) -> tuple[int, float]:
        return round(remoteness(choice.camera, photographs, step)), -choice.gain

    return min(good, key=order)


def remoteness(camera: Camera, photographs: Sequence[Camera], step: float) -> float:
    """How far a camera is from the nearest of `photographs`: in steps, where a turn by a quarter of
    the opening angle is a step, too."""
    quarter = torch.rad2deg(torch.tensor(min(opening(camera)) / 4)).item()
    return min(
        baseline_between(camera, other) / max(step, 1e-30)
        + rotation_between(camera, other) / quarter
        for other in photographs
    )


def stand_ins(render: Render, holes: Bool[Tensor, "h w"], camera: Camera) -> Gaussians:
    """Grey Gaussians that close the holes of an image, about where a completion may put them: at
    the depth that surrounds them, continued smoothly."""
    seen = render.depth_map()
    depth = fill_smoothly(seen.depth, seen.valid & ~holes)
    means = unproject(depth, camera)[holes]
    size = (0.7 * depth / camera.K[0, 0])[holes]
    quats = torch.eye(4).to(means)[:1].repeat(len(means), 1)
    return observed(
        means,
        quats,
        size[:, None].repeat(1, 3),
        torch.full_like(size, 0.99),
        torch.zeros((len(means), 1, 3)).to(means),
    )


def miniature(completion: Completion, most: int = MAX_GAUSSIANS) -> Completion:
    """`completion` with fewer Gaussians, which look the same in small images, and the evidence on
    them."""
    context, evidence, aside = completion.drawn_context, completion.evidence, completion.set_aside
    rows, growth = thinning(context, most)
    context = thinned(context, most)
    evidence = None if evidence is None else thinned_evidence(evidence, rows, growth)
    aside = None if aside is None else aside[rows]
    kept = context if aside is None else context[~aside]
    drawn = merge([kept, thinned(completion.added, most)])
    completion = replace(completion, proxy=None, evidence=evidence, set_aside=aside)
    return replace(completion, drawn=drawn, context=context)


def thinned_evidence(
    evidence: Evidence, rows: Int64[Tensor, "r"], growth: Float[Tensor, "r"]
) -> Evidence:
    """Evidence on those rows of Gaussians that stay, each grown so many times."""
    areas, agreement = evidence.areas[:, rows] * growth**2, evidence.agreement[:, rows]
    return Evidence(evidence.means[rows], evidence.centers, areas, agreement)
