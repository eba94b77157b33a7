"""Next-best-view planner: choose target cameras greedily and complete the scene for them.

The gain of a camera is the image fraction of holes near observed pixels (farther away anything
could be there) and of distrust elsewhere, times the overlap with the anchor. Among similar gains,
the camera nearest to the photographs wins.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.completer import GSCompleter
from gscompleter.config import NextBestViewConfig
from gscompleter.numerics.enclosed_holes import keep_enclosed
from gscompleter.numerics.geometry import (
    adapt_to_mode,
    compute_field_of_view,
    compute_spacing,
    is_same_camera,
    measure_baseline,
    measure_rotation,
    select_spread_cameras,
    shrink_camera,
    unproject,
)
from gscompleter.numerics.image_ops import dilate, fill_smoothly
from gscompleter.parts import Part, PartOrigin
from gscompleter.planning.candidates import Candidate, is_close, propose_candidates
from gscompleter.render.lod import MAX_PREVIEW_GAUSSIANS, choose_thinned_rows, thin_gaussians
from gscompleter.render.view_map import get_view_map
from gscompleter.stages.hole_masks import compute_hole_mask
from gscompleter.stages.select_anchor import compute_overlap, select_anchor
from gscompleter.stages.target_view import compute_distrust
from gscompleter.state import Completion
from gscompleter.system.progress import stage, track
from gscompleter.system.timing import record_seconds
from gscompleter.types import Camera, Gaussians, Render, make_observed

MIN_AHEAD = 0.25
"""Gain of cameras that look ahead, relative to that of turns up and down, from which they come
first."""
MIN_TOLD = 0.005
"""Share of an image in holes that is worth a word."""
MAX_FREE_SPACE_CAMERAS = 40
"""Most cameras of photographs, besides the context views, whose free space is kept empty."""


@dataclass(frozen=True)
class Choice:
    """A candidate with its score."""

    candidate: Candidate
    hole_fraction: float
    gain: float
    """Expected gain, as a fraction of its image."""
    opaque_fraction: float = 0.0
    """Part of the holes, as a fraction of its image, where a scene is opaque and not trusted."""

    @property
    def camera(self) -> Camera:
        """Camera of the candidate."""
        return self.candidate.camera

    def describe(self) -> str:
        """Say in a sentence why it was chosen."""
        if self.hole_fraction < MIN_TOLD:
            return "Chosen because what it sees contradicts the photographs."
        where = "up or down" if self.candidate.looks_up_or_down else "beside what is known"
        # Of a trained splat, what is opaque and confirmed by no photograph is a hole, too.
        kind = "empty" if self.opaque_fraction < MIN_TOLD else "empty or confirmed by no photograph"
        return f"Chosen because {self.hole_fraction:.0%} of its image is {kind}, {where}."


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

        `cameras` are those of all photographs of the scene, used for the context or not.
        """
        before = completion.seconds["total"]
        with record_seconds() as seconds:
            completion = add_free_space_cameras(completion, cameras)
            advance = self.completer.advance
            completion, choices = self.complete_greedily(completion, cameras, count, advance)
        # The stages of each target have recorded their times; what is left is the search.
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
        small = simplify_completion(completion)
        return self.complete_greedily(small, cameras, count, self.add_placeholders)[1]

    def compute_hole_fractions(
        self, completion: Completion, cameras: Sequence[Camera]
    ) -> list[float]:
        """Compute the hole fraction at each camera after those before it are completed."""
        small = simplify_completion(completion)
        fractions = []
        for camera in cameras:
            fractions.append(self.render_small_view(small, camera).holes.float().mean().item())
            small = self.add_placeholders(small, camera)
        return fractions

    def complete_greedily(
        self,
        completion: Completion,
        cameras: Sequence[Camera],
        count: int,
        complete: Callable[[Completion, Camera], Completion],
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

            # What gains too little now is not scored again: a completion only closes holes.
            remaining = [
                other.candidate
                for other in choices
                if other.gain >= config.min_gain and other.candidate is not choice.candidate
            ]
            # A recoloured place may still be distrusted. It gets one attempt.
            if completion.config.trust != "full":
                remaining = [
                    candidate
                    for candidate in remaining
                    if compute_remoteness(candidate.camera, [choice.camera], step) > 1
                ]
        return completion, tuple(chosen)

    def find_candidates(
        self, completion: Completion, cameras: Sequence[Camera]
    ) -> tuple[list[Candidate], float]:
        """Propose candidate cameras; also return the step length in scene units."""
        config = completion.config.next_best_view
        bases = select_spread_cameras(cameras, config.bases)
        base_cameras = [completion.with_depth_range(cameras[index]) for index in bases]
        step = compute_spacing(base_cameras)
        small = simplify_completion(completion)
        renders = [self.render_small_view(small, camera).render for camera in base_cameras]
        stays_beside = completion.config.trust != "full"
        candidates = propose_candidates(base_cameras, renders, step, config, stays_beside)
        # From an index among the bases to one among all cameras.
        return [replace(candidate, base=bases[candidate.base]) for candidate in candidates], step

    def score_candidates(
        self, completion: Completion, candidates_left: Sequence[Candidate]
    ) -> list[Choice]:
        """Score all candidates in the current scene."""
        small = simplify_completion(completion)
        anchors = [self.render_small_view(small, view.camera) for view in small.views]
        choose = partial(self.score_candidate, small, anchors)
        choices = get_view_map(small.rendered_context.means)(choose, candidates_left)
        counted = zip(track(candidates_left, "finding targets"), choices, strict=True)
        return [choice for _, choice in counted]

    def score_candidate(
        self, completion: Completion, anchors: Sequence[SmallView], candidate: Candidate
    ) -> Choice:
        """Score one candidate; its gain is 0 if it is too close to a surface."""
        config = completion.config
        small_view = self.render_small_view(completion, candidate.camera)
        region = candidate.region.to(small_view.holes.device)
        holes = small_view.holes & region
        distrust = small_view.distrust.where(region, 0.0)
        hole_fraction = holes.float().mean().item()
        is_empty = compute_hole_mask(small_view.render.alpha, config.holes)
        opaque_fraction = (holes & ~is_empty).float().mean().item()
        if is_close(small_view.render, candidate.nearest, config.next_best_view):
            return Choice(candidate, hole_fraction, 0.0)

        # The lift triangulates with the anchor, so the gain counts as far as that sees the scene.
        overlaps = [
            compute_overlap(small_view.camera, small_view.render, anchor.camera, anchor.render)
            for anchor in anchors
        ]
        anchor = select_anchor(candidate.camera, completion.views, config.anchor, overlaps).index
        gain = compute_gain(holes, distrust, overlaps[anchor], config.next_best_view)
        return Choice(candidate, hole_fraction, gain, opaque_fraction)

    def render_small_view(self, completion: Completion, camera: Camera) -> SmallView:
        """Render the scene at a camera in a small image."""
        config = completion.config
        camera = completion.with_depth_range(camera)
        camera = shrink_camera(camera, config.next_best_view.image_size)
        frozen = self.completer.scenes.freeze(completion.parts, camera)
        alpha = completion.trust.compute_alpha(frozen, camera)
        distrust = compute_distrust(alpha, frozen.render.alpha)
        holes = compute_hole_mask(alpha, config.holes)
        # Around an object nothing is to be gained, and its background is no distrust either.
        if config.holes.kind == "enclosed":
            distrust = distrust.where(~compute_hole_mask(frozen.render.alpha, config.holes), 0.0)
            holes = keep_enclosed(holes, frozen.render, camera, partial(self.render, completion))
        return SmallView(camera, frozen.render, holes, distrust)

    def render(self, completion: Completion, camera: Camera) -> Render:
        """Render the scene at a camera."""
        return self.completer.scenes.freeze(completion.parts, camera).render

    def add_placeholders(self, completion: Completion, camera: Camera) -> Completion:
        """Close the holes at a camera by grey placeholders."""
        padded = self.completer.pad_target(completion, camera).padded
        view = self.render_small_view(completion, padded)
        placeholders = make_placeholders(view.render, view.holes, view.camera)
        added = adapt_to_mode(completion.rendered_context, placeholders, view.camera)
        part = Part(PartOrigin("target", completion.next_target_id), added)
        return replace(completion, added_parts=(*completion.added_parts, part))


def add_free_space_cameras(completion: Completion, cameras: Sequence[Camera]) -> Completion:
    """Keep the free space of a spread subset of cameras empty.

    An input splat gets none: its renders may be wrong there, and check views protect it better.
    One without photographs has its witnesses already.
    """
    if completion.free_space_cameras:
        return completion
    context = [view.camera for view in completion.views]
    others = [
        completion.with_depth_range(camera)
        for camera in cameras
        if not any(is_same_camera(camera, known) for known in context)
    ]
    if completion.config.trust == "photometric" or not others:
        return completion
    chosen = select_spread_cameras(others, MAX_FREE_SPACE_CAMERAS)
    return replace(completion, free_space_cameras=tuple(others[index] for index in chosen))


def compute_gain(
    holes: Bool[Tensor, "h w"],
    distrust: Float[Tensor, "h w"],
    overlap: float,
    config: NextBestViewConfig = NextBestViewConfig(),
) -> float:
    """Compute the gain of completing an image, as a fraction of the image.

    Pixels outside of `holes` count by the square of their `distrust` in [0, 1], since a little of
    it is everywhere. `overlap` is the fraction of the observed part that the anchor sees, too.
    """
    # Far from what is observed, anything could be there.
    radius = max(round(config.border_radius * max(holes.shape)), 1)
    bordering = holes & dilate(~holes, radius)
    return torch.where(holes, bordering.float(), distrust**2).mean().item() * overlap


def choose_best(
    choices: Sequence[Choice],
    photographs: Sequence[Camera],
    step: float,
    config: NextBestViewConfig = NextBestViewConfig(),
) -> Choice | None:
    """Choose the camera to complete next, or None if little is left; `step` is in scene units.

    Turns up and down in place come last, unless they gain several times as much.
    """
    largest = max((choice.gain for choice in choices), default=0.0)
    if largest < config.min_gain:
        return None
    # A person walks to the side and forward, and seldom looks at the ceiling or the floor alone.
    ahead = [choice for choice in choices if not choice.candidate.looks_up_or_down]
    most_ahead = max((choice.gain for choice in ahead), default=0.0)
    if most_ahead >= max(config.min_gain, MIN_AHEAD * largest):
        choices = ahead
        largest = most_ahead
    good = [choice for choice in choices if choice.gain >= config.enough * largest]

    def order(choice: Choice) -> tuple[int, float]:
        # In whole steps, so that among cameras about as near the gain decides.
        return round(compute_remoteness(choice.camera, photographs, step)), -choice.gain

    return min(good, key=order)


def compute_remoteness(camera: Camera, photographs: Sequence[Camera], step: float) -> float:
    """Compute the distance to the nearest photograph in steps; a quarter field of view is one."""
    quarter = torch.rad2deg(torch.tensor(min(compute_field_of_view(camera)) / 4)).item()
    return min(
        measure_baseline(camera, other) / max(step, 1e-30)
        + measure_rotation(camera, other) / quarter
        for other in photographs
    )


def make_placeholders(render: Render, holes: Bool[Tensor, "h w"], camera: Camera) -> Gaussians:
    """Make grey Gaussians that close holes at the smoothly extrapolated depth around them."""
    seen = render.depth_map()
    depth = fill_smoothly(seen.depth, seen.valid & ~holes)
    means = unproject(depth, camera)[holes]
    # One sphere per pixel, with a standard deviation of 0.7 pixels, which leaves no gaps.
    size = (0.7 * depth / camera.K[0, 0])[holes]
    quats = torch.eye(4).to(means)[:1].repeat(len(means), 1)
    return make_observed(
        means,
        quats,
        size[:, None].repeat(1, 3),
        torch.full_like(size, 0.99),
        torch.zeros((len(means), 1, 3)).to(means),
    )


def simplify_completion(completion: Completion, most: int = MAX_PREVIEW_GAUSSIANS) -> Completion:
    """Simplify what is rendered of a completion for small images, with its trust."""
    rows, growth = choose_thinned_rows(completion.rendered_context, most)
    context = thin_gaussians(completion.rendered_context, most)
    # Thinned together, whatever their origins: of a preview nobody asks.
    added = thin_gaussians(completion.added, most)
    parts = (Part(PartOrigin("target", completion.next_target_id), added),)
    trust = completion.trust.thin(rows, growth)
    return replace(completion, rendered_context=context, added_parts=parts, trust=trust)
