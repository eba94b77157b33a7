"""Stage 2: select the stereo anchor of a target (paper, Sec. III-D, Fig. 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from gscompleter.config import AnchorConfig
from gscompleter.numerics.geometry import (
    is_inside,
    measure_baseline,
    measure_rotation,
    project,
    sample,
    shrink_camera,
    unproject,
)
from gscompleter.stages.target_view import TargetView
from gscompleter.system.timing import timed_stage
from gscompleter.types import Camera, DepthMap, Render, View

SURFACE_TOLERANCE = 0.1
"""Tolerated distance behind the anchor's depth map, relative to depth, for the same surface."""


@dataclass(frozen=True)
class AnchorChoice:
    """The number of the context view that forms the stereo pair with the target."""

    index: int
    is_fallback: bool
    """True if every view exceeded the rotation limit, so that the smallest rotation won."""


@dataclass(frozen=True)
class Anchor:
    """The context view that forms the stereo pair with a target, and the scene there."""

    index: int
    """Number of the view among those of the state."""
    is_fallback: bool
    """As in `AnchorChoice`."""
    target: TargetView

    @property
    def view(self) -> View:
        """The photograph."""
        return self.target.state.views[self.index]

    @property
    def render(self) -> Render:
        """Render of the scene at its camera, made when it is first asked for."""
        return self.target.view_renders[self.index]

    @cached_property
    def depth(self) -> DepthMap:
        """z-depth of that render, D_ctx^anc of the paper."""
        return self.render.depth_map()


def find_nearest_view(target: Camera, views: Sequence[View]) -> int:
    """Return the index of the view closest to `target`; a tie goes to the smaller rotation."""

    def remoteness(index: int) -> tuple[float, float]:
        camera = views[index].camera
        return measure_baseline(target, camera), measure_rotation(target, camera)

    return min(range(len(views)), key=remoteness)


def select_anchor(
    target: Camera,
    views: Sequence[View],
    config: AnchorConfig = AnchorConfig(),
    overlaps: Sequence[float] | None = None,
) -> AnchorChoice:
    """Choose the context view that makes the best stereo pair with `target` (paper, Fig. 3).

    Among views rotated by less than `max_rotation`, the widest baseline wins, since it triangulates
    best; if none qualifies, the smallest rotation wins. Beyond the paper, a view needs
    `min_baseline`, relative to the widest one, and `min_overlap`; if none has that overlap, the
    largest one wins, and of equal ones the widest baseline. `overlaps` has the share of the
    target's visible surfaces that each view sees, too; without it all views are taken to see all of
    them. Raises ValueError without views.
    """
    if not views:
        raise ValueError("select_anchor needs at least one observed view, got none")
    if config.selection == "nearest":
        return AnchorChoice(find_nearest_view(target, views), is_fallback=False)

    rotations = [measure_rotation(target, view.camera) for view in views]
    baselines = [measure_baseline(target, view.camera) for view in views]
    # A view at the place of the target has no parallax at all.
    min_baseline = config.min_baseline * max(baselines)
    possible = [i for i in range(len(views)) if baselines[i] >= min_baseline]
    facing = [i for i in possible if rotations[i] < config.max_rotation]
    if not facing:
        least_turned = min(possible, key=lambda i: rotations[i])
        return AnchorChoice(least_turned, is_fallback=True)

    # On a path of 40 m the widest baseline shows something else (decision 015).
    overlap_of = overlaps or [1.0] * len(views)
    overlapping = [i for i in facing if overlap_of[i] >= config.min_overlap]
    if not overlapping:
        # A target that shows only what was generated for others shares nothing with any view.
        most_overlapping = max(facing, key=lambda i: (overlap_of[i], baselines[i]))
        return AnchorChoice(most_overlapping, is_fallback=False)
    widest = max(overlapping, key=lambda i: baselines[i])
    return AnchorChoice(widest, is_fallback=False)


def compute_overlap(camera: Camera, render: Render, anchor: Camera, at_anchor: Render) -> float:
    """Compute the fraction of visible surfaces that the anchor sees, too; 0 if there are none.

    `render` shows the scene at `camera`, `at_anchor` at `anchor`; depths are in scene units.
    """
    surfaces = render.depth_map()
    points = unproject(surfaces.depth, camera)[surfaces.valid]
    if len(points) == 0:
        return 0.0

    # What lies behind the surface that the anchor sees there is hidden from it. Where it sees
    # nothing, its depth is 0, and no point counts.
    pixels, z = project(points, anchor)
    surface = sample(at_anchor.depth[..., None], pixels)[:, 0]
    shared = is_inside(pixels, z, anchor) & (z < (1 + SURFACE_TOLERANCE) * surface)
    return shared.float().mean().item()


@timed_stage("context")
def choose_anchor(view: TargetView) -> Anchor:
    """Choose the anchor of a target by rotation, baseline and, beyond the paper, overlap."""
    state = view.state
    target = view.camera.target
    config = state.config.anchor
    needs_overlaps = config.selection == "widest" and config.min_overlap > 0
    overlaps = measure_overlaps(view) if needs_overlaps else None
    choice = select_anchor(target, state.views, config, overlaps)
    return Anchor(choice.index, choice.is_fallback, view)


def measure_overlaps(view: TargetView) -> list[float]:
    """Measure in small images how much of what a target sees each context view sees, too."""
    state = view.state
    # The size at which candidates for the next target get their anchors by the same measure.
    side = state.config.next_best_view.image_size
    small_target = shrink_camera(view.camera.target, side)
    small_views = [shrink_camera(known.camera, side) for known in state.views]
    at_target, *at_views = view.scenes.freeze_small(state.parts, [small_target, *small_views])
    return [
        compute_overlap(small_target, at_target.render, camera, frozen.render)
        for camera, frozen in zip(small_views, at_views, strict=True)
    ]
