"""Explorer: a scene is completed where it lacks most, and looked at again after each completion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from jaxtyping import Bool
from torch import Tensor

from gscompleter.completer import Clock, GSCompleter
from gscompleter.config import NextBestViewConfig
from gscompleter.geometry import same_camera
from gscompleter.progress import stage, track
from gscompleter.render import each_view
from gscompleter.render.antialiasing import in_mode_of
from gscompleter.stages.anchor import select_anchor
from gscompleter.stages.candidates import (
    Candidate,
    candidates,
    is_close,
    shrunk,
    spacing,
    spread_cameras,
)
from gscompleter.stages.exploration import (
    Choice,
    best,
    gain,
    miniature,
    overlap_of,
    stand_ins,
)
from gscompleter.stages.integration import hole_mask
from gscompleter.types import Camera, Completion, Render, merge

MAX_BYSTANDERS = 40
"""Photographs, besides the context, before which nothing is added."""

Complete = Callable[[Completion, Camera], Completion]
"""What is done at a camera once it is chosen."""


@dataclass(frozen=True)
class Look:
    """What a camera sees of a scene in a small image."""

    camera: Camera
    """The camera of the small image."""
    render: Render
    holes: Bool[Tensor, "h w"]


@dataclass(frozen=True)
class Explorer:
    """Finds the cameras that a scene is worth completing for, and completes it for them."""

    completer: GSCompleter

    @property
    def config(self) -> NextBestViewConfig:
        """Where targets are looked for."""
        return self.completer.config.next_best_view

    def explore(
        self, completion: Completion, cameras: Sequence[Camera], count: int
    ) -> tuple[Completion, tuple[Choice, ...]]:
        """Complete a scene for up to `count` cameras that are found, one after the other.

        Args:
            completion: Where it goes on from, such as `GSCompleter.begin` gives it.
            cameras: Those of all photographs of the scene, whether or not it was made of them.
            count: How many cameras it is completed for at most. It is fewer where little is left.
        """
        clock, begun = Clock(()), completion.seconds["total"]
        completion = with_bystanders(completion, cameras)
        completion, choices = self.take(completion, cameras, count, self.completer.advance)
        completed = completion.seconds["total"]
        spent = begun + clock.seconds["total"]
        seconds = {**completion.seconds, "explore": spent - completed, "total": spent}
        return replace(completion, seconds=seconds), choices

    def plan(
        self, completion: Completion, cameras: Sequence[Camera], count: int
    ) -> tuple[Choice, ...]:
        """About the cameras that `explore` would take, found without completing anything.

        Each hole is closed by grey stand-ins before the next camera is chosen.
        """
        return self.take(miniature(completion), cameras, count, self.with_stand_ins)[1]

    def holes(self, completion: Completion, cameras: Sequence[Camera]) -> list[float]:
        """Share of the image of each camera that is a hole, once those before are completed."""
        small, shares = miniature(completion), []
        for camera in cameras:
            shares.append(self.look(small, camera).holes.float().mean().item())
            small = self.with_stand_ins(small, camera)
        return shares

    def take(
        self, completion: Completion, cameras: Sequence[Camera], count: int, complete: Complete
    ) -> tuple[Completion, tuple[Choice, ...]]:
        """Choose a camera, complete the scene there, and choose again."""
        with stage("finding targets"):
            offers, step = self.offers(completion, cameras)
        chosen: list[Choice] = []
        for _ in track(range(count), "target"):
            choices = self.judged(completion, offers)
            choice = best(choices, [v.camera for v in completion.views], step, self.config)
            if choice is None:
                break
            completion = complete(completion, choice.camera)
            chosen.append(choice)
            left = [c.candidate for c in choices if c.gain >= self.config.min_gain]
            offers = [candidate for candidate in left if candidate is not choice.candidate]
        return completion, tuple(chosen)

    def offers(
        self, completion: Completion, cameras: Sequence[Camera]
    ) -> tuple[list[Candidate], float]:
        """Cameras a move away from those given that see anything new, and the length of a step."""
        bases = spread_cameras(cameras, self.config.bases)
        near = [completion.ranged(cameras[index]) for index in bases]
        step = spacing(near)
        small = miniature(completion)
        renders = [self.look(small, camera).render for camera in near]
        found = candidates(near, renders, step, self.config)
        return [replace(candidate, base=bases[candidate.base]) for candidate in found], step

    def judged(self, completion: Completion, offers: Sequence[Candidate]) -> list[Choice]:
        """What there is to gain at each of `offers`, in the scene as it stands."""
        small = miniature(completion)
        anchors = [self.look(small, view.camera) for view in small.views]
        choose = partial(self.choice, small, anchors)
        choices = each_view(small.drawn)(choose, offers)
        counted = zip(track(offers, "finding targets"), choices, strict=True)
        return [choice for _, choice in counted]

    def choice(
        self, completion: Completion, anchors: Sequence[Look], candidate: Candidate
    ) -> Choice:
        """What there is to gain at one camera; nothing where it stands close to a surface."""
        look = self.look(completion, candidate.camera)
        hole = look.holes.float().mean().item()
        if is_close(look.render, candidate.nearest, self.config):
            return Choice(candidate, hole, 0.0)
        overlaps = [
            overlap_of(look.camera, look.render, anchor.camera, anchor.render) for anchor in anchors
        ]
        config, views = self.completer.config.anchor, completion.views
        anchor = select_anchor(candidate.camera, views, config, overlaps).index
        return Choice(candidate, hole, gain(look.holes, overlaps[anchor], self.config))

    def look(self, completion: Completion, camera: Camera) -> Look:
        """What a camera sees of a scene, in a small image."""
        camera = shrunk(completion.ranged(camera), self.config.image_size)
        frozen = self.completer.renderer.freeze(completion.drawn, camera)
        render, believed = frozen.context, self.completer.believed(completion, frozen, camera)
        alpha = render.alpha if believed is None else believed
        return Look(camera, render, hole_mask(alpha, self.completer.config.holes))

    def with_stand_ins(self, completion: Completion, camera: Camera) -> Completion:
        """`completion` with stand-ins in the holes that it has at a camera."""
        look = self.look(completion, self.completer.window(completion, camera).wide)
        drawn, made = completion.drawn, stand_ins(look.render, look.holes, look.camera)
        added = in_mode_of(drawn, made, look.camera)
        return replace(completion, drawn=merge([drawn, added]))


def with_bystanders(completion: Completion, cameras: Sequence[Camera]) -> Completion:
    """`completion` with those of `cameras` that it has no photographs of, or many of them, spread.

    Not where the scene is doubted: what it shows them may be wrong, and its witnesses know better.
    """
    taken = [view.camera for view in completion.views]
    others = [completion.ranged(c) for c in cameras if not any(same_camera(c, t) for t in taken)]
    if completion.evidence is not None or not others:
        return completion
    chosen = spread_cameras(others, MAX_BYSTANDERS)
    return replace(completion, bystanders=tuple(others[index] for index in chosen))
