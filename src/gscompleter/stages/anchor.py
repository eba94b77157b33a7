"""Stage 2: synthesize the target image, select the stereo anchor, lift the pair to Gaussians
(paper, Sec. III-D)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.config import AnchorConfig
from gscompleter.generators import Generator, ImageFunction, Request, Synthesis, as_generator
from gscompleter.geometry import baseline_between, inside, project, rotation_between
from gscompleter.reconstructors import Reconstructor, reconstructed
from gscompleter.types import Camera, Lift, SceneContext, View


@dataclass(frozen=True)
class AnchorChoice:
    """Which context view forms the stereo pair with the target."""

    index: int
    """Index among the context views."""
    fallback: bool
    """True where every view was turned too far and the least-turned one was taken."""


def nearest_view(target: Camera, views: Sequence[View]) -> int:
    """Index of the view taken closest to `target`; of equals, the one turned least."""

    def remoteness(index: int) -> tuple[float, float]:
        camera = views[index].camera
        return baseline_between(target, camera), rotation_between(target, camera)

    return min(range(len(views)), key=remoteness)


def select_anchor(
    target: Camera,
    views: Sequence[View],
    config: AnchorConfig = AnchorConfig(),
    overlaps: Sequence[float] | None = None,
) -> AnchorChoice:
    """Choose the observed view that makes the best stereo pair with `target`.

    Among views turned by less than `max_rotation`, the one farthest away wins, because a wide
    baseline makes triangulation precise. When every view is turned further than that, overlap
    matters more than precision, and the least-turned view wins (paper, Fig. 3).

    A view that stands too close to the target (`min_baseline`) is left out, unless all do. Where it
    is known which share of what the target observes each view sees, those that see too little are
    left out, too: of a long path the widest baseline shows something else. If all do, the one that
    sees most wins.
    """
    if not views:
        raise ValueError("select_anchor needs at least one observed view, got none")
    if config.selection == "nearest":
        return AnchorChoice(nearest_view(target, views), fallback=False)

    rotations = [rotation_between(target, view.camera) for view in views]
    baselines = [baseline_between(target, view.camera) for view in views]
    least = config.min_baseline * max(baselines)
    possible = [i for i in range(len(views)) if baselines[i] >= least]
    overlapping = [i for i in possible if rotations[i] < config.max_rotation]
    if not overlapping:
        return AnchorChoice(min(possible, key=rotations.__getitem__), fallback=True)
    if overlaps is None:
        return AnchorChoice(max(overlapping, key=baselines.__getitem__), fallback=False)
    enough = [i for i in overlapping if overlaps[i] >= config.min_overlap]
    if not enough:
        return AnchorChoice(max(overlapping, key=overlaps.__getitem__), fallback=False)
    return AnchorChoice(max(enough, key=baselines.__getitem__), fallback=False)


@dataclass(frozen=True)
class Synthesized(View):
    """The image at the target, as a view, and what its generator tells of it."""

    notes: tuple[str, ...] = ()
    """A sentence each; empty for a generator that tells nothing."""
    disagrees: bool = False
    """Whether the photographs say that it shows something else."""


def synthesize(
    generator: Generator | ImageFunction, target: Camera, context: SceneContext
) -> Synthesized:
    """`Ĩ_t = Φ(I_n, P_t)`, conditioned on the nearest view (paper, Eq. 6)."""
    return synthesize_all(generator, [(target, context)])[0]


def synthesize_all(
    generator: Generator | ImageFunction, asked: Sequence[tuple[Camera, SceneContext]]
) -> list[Synthesized]:
    """The same for several targets at once, each with what is known of the scene for it."""
    requests = [
        Request(context.views[nearest_view(target, context.views)], target, context)
        for target, context in asked
    ]
    answers = as_generator(generator).synthesize(requests)
    return [as_view(answer, r.target) for answer, r in zip(answers, requests, strict=True)]


def as_view(answer: Synthesis, target: Camera) -> Synthesized:
    """What a generator answered, once it is seen to be an image of the target's size."""
    expected = (target.height, target.width, 3)
    if tuple(answer.image.shape) != expected or not torch.isfinite(answer.image).all():
        raise ValueError(
            f"the generator must return a finite image of shape {expected}, "
            f"got {tuple(answer.image.shape)}"
        )
    return Synthesized(answer.image, target, notes=answer.notes, disagrees=answer.disagrees)


def lift(
    reconstructor: Reconstructor,
    reference: View,
    anchor: View,
    wanted: Bool[Tensor, "h w"] | None = None,
) -> Lift:
    """`Ψ((Ĩ_t, P_t), (I_s, P_s))`, of which the target's Gaussians are kept (paper, Eq. 7).

    A pixel-aligned Ψ says which Gaussians are the reference's. Of another Ψ all those are taken
    that the target camera sees. Where pixels of the reference are `wanted`, those of others are
    left out if their pixels are known.
    """
    pair = reconstructed(reconstructor, [reference, anchor], wanted)
    reference_depth, anchor_depth = pair.depths
    if pair.view_index is None or pair.pixel_index is None:
        seen = inside(*project(pair.gaussians.means, reference.camera), reference.camera)
        return Lift(pair.gaussians[seen], reference_depth, anchor_depth, None)
    own = pair.view_index == 0
    if wanted is not None:
        own &= wanted.flatten()[pair.pixel_index.where(own, 0)]
    return Lift(pair.gaussians[own], reference_depth, anchor_depth, pair.pixel_index[own])
