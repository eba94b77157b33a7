"""Next-best-view planner: choose target cameras greedily and complete the scene for them."""

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
"""Most cameras of photographs, besides the context views, whose free space is kept empty."""

Complete = Callable[[Completion, Camera], Completion]
"""Step that is taken at a chosen camera."""


@dataclass(frozen=True)
class Look:
    """A small render of a scene and its hole mask."""

    camera: Camera
    render: Render
    holes: Bool[Tensor, "h w"]


@dataclass(frozen=True)
class Explorer:
    """Plans next-best target views greedily, re-scoring candidates after each completion."""

    completer: GSCompleter

    @property
    def config(self) -> NextBestViewConfig:
        """Settings of the planner."""
        return self.completer.config.next_best_view

    def explore(
        self, completion: Completion, cameras: Sequence[Camera], count: int
    ) -> tuple[Completion, tuple[Choice, ...]]:
        """Choose up to `count` target cameras and complete the scene for each.

        Args:
            completion: The scene so far, such as `GSCompleter.begin` returns.
            cameras: Cameras of all photographs of the scene, used for the context or not.
            count: Largest number of targets; there are fewer if little is left to gain.
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
        """Estimate the choices of `explore` without completing anything.

        Grey placeholders close the holes of each chosen camera.
        """
        return self.take(miniature(completion), cameras, count, self.with_stand_ins)[1]

    def holes(self, completion: Completion, cameras: Sequence[Camera]) -> list[float]:
        """Compute the hole fraction at each camera after those before it are completed."""
        small, shares = miniature(completion), []
        for camera in cameras:
            shares.append(self.look(small, camera).holes.float().mean().item())
            small = self.with_stand_ins(small, camera)
        return shares

    def take(
        self, completion: Completion, cameras: Sequence[Camera], count: int, complete: Complete
    ) -> tuple[Completion, tuple[Choice, ...]]:
        """Repeatedly choose the best camera and complete the scene there."""
        with stage("finding targets"):
            remaining, step = self.offers(completion, cameras)
        chosen: list[Choice] = []
        for _ in track(range(count), "target"):
            choices = self.judged(completion, remaining)
            choice = best(choices, [v.camera for v in completion.views], step, self.config)
            if choice is None:
                break
            completion = complete(completion, choice.camera)
            chosen.append(choice)
            left = [c.candidate for c in choices if c.gain >= self.config.min_gain]
            remaining = [candidate for candidate in left if candidate is not choice.candidate]
        return completion, tuple(chosen)

    def offers(
        self, completion: Completion, cameras: Sequence[Camera]
    ) -> tuple[list[Candidate], float]:
        """Propose candidate cameras; also return the step length in scene units."""
        bases = spread_cameras(cameras, self.config.bases)
        near = [completion.ranged(cameras[index]) for index in bases]
        step = spacing(near)
        small = miniature(completion)
        renders = [self.look(small, camera).render for camera in near]
        found = candidates(near, renders, step, self.config)
        return [replace(candidate, base=bases[candidate.base]) for candidate in found], step

    def judged(self, completion: Completion, offers: Sequence[Candidate]) -> list[Choice]:
        """Score all candidates in the current scene."""
        small = miniature(completion)
        anchors = [self.look(small, view.camera) for view in small.views]
        choose = partial(self.choice, small, anchors)
        choices = each_view(small.drawn)(choose, offers)
        counted = zip(track(offers, "finding targets"), choices, strict=True)
        return [choice for _, choice in counted]

    def choice(
        self, completion: Completion, anchors: Sequence[Look], candidate: Candidate
    ) -> Choice:
        """Score one candidate; its gain is 0 if it is too close to a surface."""
        small_view = self.look(completion, candidate.camera)
        hole = small_view.holes.float().mean().item()
        if is_close(small_view.render, candidate.nearest, self.config):
            return Choice(candidate, hole, 0.0)
        overlaps = [
            overlap_of(small_view.camera, small_view.render, anchor.camera, anchor.render)
            for anchor in anchors
        ]
        config, views = self.completer.config.anchor, completion.views
        anchor = select_anchor(candidate.camera, views, config, overlaps).index
        return Choice(candidate, hole, gain(small_view.holes, overlaps[anchor], self.config))

    def look(self, completion: Completion, camera: Camera) -> Look:
        """Render the scene at a camera in a small image."""
        camera = shrunk(completion.ranged(camera), self.config.image_size)
        frozen = self.completer.renderer.freeze(completion.drawn, camera)
        render, trusted = frozen.context, self.completer.believed(completion, frozen, camera)
        alpha = render.alpha if trusted is None else trusted
        return Look(camera, render, hole_mask(alpha, self.completer.config.holes))

    def with_stand_ins(self, completion: Completion, camera: Camera) -> Completion:
        """Close the holes at a camera by grey placeholders."""
        view = self.look(completion, self.completer.window(completion, camera).wide)
        scene, placeholders = completion.drawn, stand_ins(view.render, view.holes, view.camera)
        added = in_mode_of(scene, placeholders, view.camera)
        return replace(completion, drawn=merge([scene, added]))


def with_bystanders(completion: Completion, cameras: Sequence[Camera]) -> Completion:
    """Keep the free space of a spread subset of cameras empty.

    An input splat gets none: its renders may be wrong there, and check views protect it better.
    """
    taken = [view.camera for view in completion.views]
    others = [completion.ranged(c) for c in cameras if not any(same_camera(c, t) for t in taken)]
    if completion.evidence is not None or not others:
        return completion
    chosen = spread_cameras(others, MAX_BYSTANDERS)
    return replace(completion, bystanders=tuple(others[index] for index in chosen))
