"""Values that the stages exchange, and their conventions.

OpenCV axes (x right, y down, z forward). `c2w` is camera-to-world. Intrinsics are in pixels; the
centre of the top-left pixel is (0.5, 0.5). Images are [h, w, 3] in [0, 1]. `depth` is z-depth in
scene units, `distance` is Euclidean along a unit ray. Quaternions are wxyz, scales linear,
opacities in [0, 1], spherical harmonics [n, k, 3] in the 3DGS basis. All values are immutable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.deprecation import RenamedMembers
from gscompleter.types import (
    Camera,
    DepthAffine,
    DepthPairs,
    ErrorBudget,
    Gaussians,
    PhotoObservations,
    Proxy,
    Render,
    View,
    merge,
)


@dataclass(frozen=True)
class InitialContext:
    """The reconstructed context (stage 1) and its photographs."""

    gaussians: Gaussians
    views: tuple[View, ...]
    """Photographs with the depth range of the scene, in the exposure of `gaussians`."""
    exposure_gains: Float[Tensor, "v 3"] | None = None
    """Exposure gain per channel of each original photograph relative to `gaussians`, or None."""
    seconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class TargetResult(RenamedMembers):
    """Result of one target camera. No stage reads it."""

    old_names: ClassVar[Mapping[str, str]] = {
        "support": "trusted_alpha",
        "refused": "refusal",
    }

    target: Camera
    before: Render
    """The scene without what this target added, rendered at the target."""
    after: Render
    hole_mask: Bool[Tensor, "h w"]
    """True where the scene had a hole, before dilation."""
    reference: View | None
    """The synthesized view, or None if nothing was synthesized."""
    anchor: int
    """Index of the anchor among the context views."""
    anchor_fallback: bool
    """True if every view exceeded the rotation limit, so that the smallest rotation won."""
    affine: DepthAffine
    added: Gaussians
    losses: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Loss per iteration of the optimizations `register` and `refine`."""
    registered: Gaussians | None = None
    """All registered Gaussians, hole or not; None without `GSCompleter.keep_registered`."""
    notes: tuple[str, ...] = ()
    trusted_alpha: Float[Tensor, "h w"] | None = None
    """Alpha weighted by trust before this target, or None under full trust."""
    pairs: DepthPairs | None = None
    """Sample of the depths that the affine was fitted to, or None if none were compared."""
    refusal: str | None = None
    """Sentence why the target cannot be completed, or None if it can."""

    @property
    def hole_fraction(self) -> float:
        """Fraction of the image in holes."""
        return self.hole_mask.float().mean().item()


@dataclass(frozen=True)
class Completion(RenamedMembers):
    """A scene during completion; steps return a new value, and the old one serves as undo."""

    old_names: ClassVar[Mapping[str, str]] = {
        "drawn": "rendered_scene",
        "drawn_context": "rendered_context",
        "observed": "kept_context",
        "begun": "context_renders",
        "witnesses": "check_views",
        "bystanders": "free_space_cameras",
        "photographs": "photos",
        "gains": "exposure_gains",
        "evidence": "observations",
        "set_aside": "pruned",
        "removed": "pruned_mask",
        "next_number": "next_target_id",
        "ranged": "with_depth_range",
    }

    rendered_scene: Gaussians
    """The context or its LOD proxy, without pruned Gaussians, then all generated ones."""
    context: Gaussians
    """The scene before its first target."""
    views: tuple[View, ...]
    """Context photographs with the depth range of the scene, in the exposure of the context."""
    budgets: tuple[tuple[ErrorBudget, ...], ...]
    """Error budgets of each photograph in `photos`; the first excludes the holes of the context."""
    targets: tuple[TargetResult, ...]
    seconds: Mapping[str, float]
    """Wall time of context, generate, lift, register, integrate and total."""
    check_views: tuple[View, ...] = ()
    """Further photographs of the scene that must not get worse."""
    free_space_cameras: tuple[Camera, ...] = ()
    """Further cameras whose free space stays empty; their images are not read."""
    exposure_gains: Float[Tensor, "v 3"] | None = None
    """Exposure gain of each original photograph relative to `views`, or None if not estimated."""
    context_renders: tuple[Render, ...] = ()
    """Renders of the context at `views` before any target."""
    proxy: Proxy | None = None
    """LOD proxy of a large context, or None if the context itself is rendered."""
    observations: PhotoObservations | None = None
    """Observations of the context in all photographs, or None under full trust."""
    pruned: Bool[Tensor, "m"] | None = None
    """Rendered context Gaussians that were pruned, or None if none were."""

    @property
    def photos(self) -> tuple[View, ...]:
        """All photographs that the scene is compared with: `views`, then `check_views`."""
        return (*self.views, *self.check_views)

    @property
    def rendered_context(self) -> Gaussians:
        """The context or its LOD proxy as it is rendered, pruned Gaussians included."""
        return self.context if self.proxy is None else self.proxy.scene

    @property
    def num_kept(self) -> int:
        """Number of context Gaussians, without pruned ones, at the start of `rendered_scene`."""
        num_pruned = 0 if self.pruned is None else int(self.pruned.sum())
        return len(self.rendered_context) - num_pruned

    @property
    def added(self) -> Gaussians:
        """Generated Gaussians of all targets."""
        return self.rendered_scene[self.num_kept :]

    @property
    def pruned_mask(self) -> Bool[Tensor, "n"] | None:
        """Pruned Gaussians as a mask over `context`, or None if there are none."""
        pruned = self.pruned
        return pruned if pruned is None or self.proxy is None else pruned[self.proxy.proxy_index]

    @property
    def kept_context(self) -> Gaussians:
        """The context bit for bit, without pruned Gaussians."""
        removed = self.pruned_mask
        return self.context if removed is None else self.context[~removed]

    @cached_property
    def scene(self) -> Gaussians:
        """The context bit for bit, without pruned Gaussians, followed by all generated ones."""
        if self.proxy is None:
            return self.rendered_scene
        return merge([self.kept_context, self.added]) if len(self.added) else self.kept_context

    @property
    def next_target_id(self) -> int:
        """Value of `generated` for the next target; ids of a given scene are continued."""
        given = int(self.context.generated.max()) if len(self.context) else 0
        return given + len(self.targets) + 1

    def with_depth_range(self, camera: Camera) -> Camera:
        """Return the camera with the depth range of this completion."""
        known = self.views[0].camera
        return replace(camera, near=known.near, far=known.far)
