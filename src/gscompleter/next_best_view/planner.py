"""Next-best-view planner: choose target cameras greedily and complete the scene for them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.completer import GSCompleter
from gscompleter.geometry import (
    compute_spacing,
    is_same_camera,
    select_spread_cameras,
    shrink_camera,
)
from gscompleter.next_best_view.candidates import Candidate, is_close, propose_candidates
from gscompleter.next_best_view.gain import (
    Choice,
    choose_best,
    compute_gain,
    make_placeholders,
    simplify_completion,
)
from gscompleter.progress import stage, track
from gscompleter.render import get_view_map
from gscompleter.render.antialiasing import adapt_to_mode
from gscompleter.stages.select_anchor import compute_overlap, select_anchor
from gscompleter.stages.target_view import compute_distrust, compute_hole_mask
from gscompleter.state import Completion
from gscompleter.timing import record_seconds
from gscompleter.types import Camera, Render

MAX_FREE_SPACE_CAMERAS = 40
"""Most cameras of photographs, besides the context views, whose free space is kept empty."""

CompletionStep = Callable[[Completion, Camera], Completion]
"""Step that is taken at a chosen camera."""


@dataclass(frozen=True)
class SmallView:
    """A small render of a scene and its hole mask."""

    camera: Camera
    render: Render
    holes: Bool[Tensor, "h w"]
    distrust: Float[Tensor, "h w"]
    """Weight in [0, 1] with which covered pixels would be recoloured; 0 under full trust."""


@dataclass(frozen=True)
class ViewPlanner:
    """Plans next-best target views greedily, re-scoring candidates after each completion."""

    completer: GSCompleter

    def explore(
        self, completion: Completion, cameras: Sequence[Camera], count: int
    ) -> tuple[Completion, tuple[Choice, ...]]:
        """Choose up to `count` target cameras and complete the scene for each.

        Args:
            completion: The scene so far, such as `GSCompleter.begin` returns.
            cameras: Cameras of all photographs of the scene, used for the context or not.
            count: Largest number of targets; there are fewer if little is left to gain.
        """
        before = completion.seconds["total"]
        with record_seconds() as seconds:
            completion = add_free_space_cameras(completion, cameras)
            completion, choices = self.complete_greedily(
                completion, cameras, count, self.completer.advance
            )
        total = before + seconds["total"]
        explore = total - completion.seconds["total"]
        recorded = {**completion.seconds, "explore": explore, "total": total}
        return replace(completion, seconds=recorded), choices

    def plan(
        self, completion: Completion, cameras: Sequence[Camera], count: int
    ) -> tuple[Choice, ...]:
        """Estimate the choices of `explore` without completing anything.

        Grey placeholders close the holes of each chosen camera.
        """
        return self.complete_greedily(
            simplify_completion(completion), cameras, count, self.add_placeholders
        )[1]

    def compute_hole_fractions(
        self, completion: Completion, cameras: Sequence[Camera]
    ) -> list[float]:
        """Compute the hole fraction at each camera after those before it are completed."""
        small, shares = simplify_completion(completion), []
        for camera in cameras:
            shares.append(self.render_small_view(small, camera).holes.float().mean().item())
            small = self.add_placeholders(small, camera)
        return shares

    def complete_greedily(
        self,
        completion: Completion,
        cameras: Sequence[Camera],
        count: int,
        complete: CompletionStep,
    ) -> tuple[Completion, tuple[Choice, ...]]:
        """Repeatedly choose the best camera and complete the scene there."""
        with stage("finding targets"):
            remaining, step = self.find_candidates(completion, cameras)
        chosen: list[Choice] = []
        for _ in track(range(count), "target"):
            choices = self.score_candidates(completion, remaining)
            config = completion.config.next_best_view
            choice = choose_best(choices, [v.camera for v in completion.views], step, config)
            if not choice:
                break
            completion = complete(completion, choice.camera)
            chosen.append(choice)
            left = [c.candidate for c in choices if c.gain >= config.min_gain]
            remaining = [candidate for candidate in left if candidate is not choice.candidate]
            if completion.config.trust != "full":  # one attempt for each place
                remaining = [c for c in remaining if not choice.is_near(c, step)]
        return completion, tuple(chosen)

    def find_candidates(
        self, completion: Completion, cameras: Sequence[Camera]
    ) -> tuple[list[Candidate], float]:
        """Propose candidate cameras; also return the step length in scene units."""
        config = completion.config.next_best_view
        bases = select_spread_cameras(cameras, config.bases)
        near = [completion.with_depth_range(cameras[index]) for index in bases]
        step = compute_spacing(near)
        small = simplify_completion(completion)
        renders = [self.render_small_view(small, camera).render for camera in near]
        found = propose_candidates(near, renders, step, config, completion.config.trust != "full")
        return [replace(candidate, base=bases[candidate.base]) for candidate in found], step

    def score_candidates(
        self, completion: Completion, candidates_left: Sequence[Candidate]
    ) -> list[Choice]:
        """Score all candidates in the current scene."""
        small = simplify_completion(completion)
        anchors = [self.render_small_view(small, view.camera) for view in small.views]
        choose = partial(self.score_candidate, small, anchors)
        choices = get_view_map(small.parts[0])(choose, candidates_left)
        counted = zip(track(candidates_left, "finding targets"), choices, strict=True)
        return [choice for _, choice in counted]

    def score_candidate(
        self, completion: Completion, anchors: Sequence[SmallView], candidate: Candidate
    ) -> Choice:
        """Score one candidate; its gain is 0 if it is too close to a surface."""
        config, views = completion.config, completion.views
        small_view = self.render_small_view(completion, candidate.camera)
        hole = small_view.holes.float().mean().item()
        if is_close(small_view.render, candidate.nearest, config.next_best_view):
            return Choice(candidate, hole, 0.0)
        overlaps = [
            compute_overlap(small_view.camera, small_view.render, anchor.camera, anchor.render)
            for anchor in anchors
        ]
        anchor = select_anchor(candidate.camera, views, config.anchor, overlaps).index
        unsure = small_view.holes, small_view.distrust
        gain = compute_gain(*unsure, overlaps[anchor], config.next_best_view)
        return Choice(candidate, hole, gain)

    def render_small_view(self, completion: Completion, camera: Camera) -> SmallView:
        """Render the scene at a camera in a small image."""
        config = completion.config
        camera = completion.with_depth_range(camera)
        camera = shrink_camera(camera, config.next_best_view.image_size)
        frozen = self.completer.scenes.freeze(completion.parts, camera)
        alpha = completion.trust.compute_alpha(frozen, camera)
        distrust = compute_distrust(alpha, frozen.render.alpha)
        return SmallView(camera, frozen.render, compute_hole_mask(alpha, config.holes), distrust)

    def add_placeholders(self, completion: Completion, camera: Camera) -> Completion:
        """Close the holes at a camera by grey placeholders."""
        padded = self.completer.pad_target(completion, camera).padded
        view = self.render_small_view(completion, padded)
        placeholders = make_placeholders(view.render, view.holes, view.camera)
        added = adapt_to_mode(completion.parts[0], placeholders, view.camera)
        return replace(completion, parts=(*completion.parts, added))


def add_free_space_cameras(completion: Completion, cameras: Sequence[Camera]) -> Completion:
    """Keep the free space of a spread subset of cameras empty.

    An input splat gets none: its renders may be wrong there, and check views protect it better.
    """
    taken = [view.camera for view in completion.views]
    others = [
        completion.with_depth_range(c)
        for c in cameras
        if not any(is_same_camera(c, t) for t in taken)
    ]
    if completion.config.trust == "photometric" or not others:
        return completion
    chosen = select_spread_cameras(others, MAX_FREE_SPACE_CAMERAS)
    return replace(completion, free_space_cameras=tuple(others[index] for index in chosen))
