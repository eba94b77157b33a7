"""Stage 1: initialize the context in metric scale from observed views (paper, Sec. III-C)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from gscompleter.config import CompleterConfig, get_named_config
from gscompleter.numerics.geometry import add_near_plane, compute_z_depths, project_mask
from gscompleter.numerics.given_geometry import GivenGeometry
from gscompleter.numerics.image_ops import MIN_CONTRAST
from gscompleter.reconstructors import (
    DepthAware,
    Reconstructor,
    run_fitting_reconstructor,
)
from gscompleter.reconstructors.depth_predictors import give_prediction
from gscompleter.reconstructors.features.depth_range import (
    get_depth_range,
    set_depth_range,
)
from gscompleter.reconstructors.features.given_range import DepthRange
from gscompleter.reconstructors.scene_range import find_scene_range
from gscompleter.render.lod import build_proxy
from gscompleter.render.protocols import Renderer
from gscompleter.system.errors import InputError
from gscompleter.trust.lifted import is_lifted
from gscompleter.types import Camera, ContextScene, Gaussians, Reconstruction, View

MIN_TEXTURED = 0.01
"""Smallest textured fraction of an image."""


@dataclass(frozen=True)
class InitialContext:
    """The context (stage 1) and its photographs, with the depth range of the scene."""

    source: ContextScene
    views: tuple[View, ...]
    """Context photographs, then those that check a given scene. Those that Ψ made the scene of have
    its exposure; those of a given scene keep their own."""
    exposure_gains: Float[Tensor, "v 3"] | None = None
    """Exposure gain per channel of each original photograph relative to the context, or None."""
    notes: tuple[str, ...] = ()
    """Sentences of Ψ for the user."""
    geometry: GivenGeometry | None = None
    """Geometry from elsewhere, in the frame of the context; None for none."""


def choose_config(
    config: CompleterConfig | None, scene: Gaussians | None, check_views: Sequence[View] | None
) -> CompleterConfig:
    """Choose the preset that fits the input, unless settings are given.

    A scene that was completed before is not recoloured again, so that its labels alone still tell
    what was given.
    """
    # Without check views nothing tells how far a given scene can be trusted.
    is_splat = scene is not None and check_views is not None
    config = config or get_named_config("default", is_splat)
    if config.margin is None:
        config = config.choose_margin(scene is None or is_lifted(scene))
    if scene and bool((scene.generated > 0).any()):
        config = replace(config, recolor=replace(config.recolor, iterations=0))
    return config


def init_context(
    reconstructor: Reconstructor,
    views: Sequence[View],
    scene: Gaussians | None,
    check_views: Sequence[View],
    targets: Sequence[Camera],
    favored: Sequence[Camera],
    renderer: Renderer,
    has_scene_range: bool = False,
) -> InitialContext:
    """Reconstruct the context from photographs, or take the scene that was given (Eq. 5).

    A reconstruction is fitted most closely to the photographs near the `favored` targets.
    `has_scene_range` is that of `reconstruct_context`. A given scene that is large is rendered
    through an LOD proxy, which is made fine enough for all photographs and targets.
    """
    if not views:
        raise InputError("No context view was given; name at least one frame.")
    views = sort_by_frame(views)
    if scene is None:
        views = prepare_single(reconstructor, views)
        return reconstruct_context(reconstructor, views, check_views, favored, has_scene_range)

    photos = [*views, *check_views]
    source = build_proxy(scene.detach(), [*targets, *(view.camera for view in photos)])
    near, far = find_splat_range(views, source.rendered, renderer)
    return InitialContext(source, tuple(set_depth_range(photos, near, far)))


def prepare_single(reconstructor: Reconstructor, views: Sequence[View]) -> list[View]:
    """Give a single photograph its predicted depth; raise InputError if it has no depth at all."""
    if isinstance(reconstructor, DepthAware):
        views = give_prediction(views, reconstructor.predict_depth)
    if len(views) < 2 and not any(len(view.known_depths) for view in views):
        raise InputError(
            f"{len(views)} context view was given, and stereo needs at least 2; name more frames, "
            "give a scene, or give one photograph with its depth or with a model that predicts it "
            "(moge-2)."
        )
    return list(views)


def reconstruct_context(
    reconstructor: Reconstructor,
    views: Sequence[View],
    check_views: Sequence[View] = (),
    favored: Sequence[Camera] = (),
    has_scene_range: bool = False,
) -> InitialContext:
    """Reconstruct `G_ctx = Ψ(V_in)` from posed photographs (paper, Eq. 5).

    Ψ fits the scene to `check_views`, too, which are no photographs of the context; photographs
    near `favored` targets count most. `has_scene_range` is True if near and far of the photographs
    are those that `find_scene_range` found, which takes a tenth of a reconstruction.
    """
    check_texture(views)
    if has_scene_range:
        found = DepthRange(*get_depth_range(views))
    else:
        found = find_scene_range(reconstructor, views)
    for note in found.notes:
        logging.getLogger("gscompleter").warning("gscompleter: %s", note)
    views = set_depth_range(views, found.near, found.far)
    checks = set_depth_range(check_views, found.near, found.far)
    reconstruction = run_fitting_reconstructor(reconstructor, views, checks, favored)
    source = ContextScene.whole(drop_ignored(reconstruction, views))
    # The scene has one exposure, which the photographs have to share from here on.
    gains = reconstruction.exposure_gains
    normalized = normalize_exposures(drop_contradicted(views, reconstruction), gains)
    return InitialContext(source, normalized, gains, reconstruction.notes)


def drop_contradicted(views: Sequence[View], reconstruction: Reconstruction) -> list[View]:
    """Leave out given depth that the photographs contradict, so that no stage reads it."""
    wrong = reconstruction.contradicted_depths
    return [
        replace(view, given_depth=None) if number in wrong else view
        for number, view in enumerate(views)
    ]


def check_texture(views: Sequence[View]) -> None:
    """Raise InputError if fewer than two of several photographs have any texture to match.

    Pixels that are ignored are not matched.
    """
    num_flat = 0
    for view in views:
        # A mean of 3 x 3 pixels removes most noise, before the range in 5 x 5 of them is taken.
        smooth = avg_pool2d(view.image.mean(dim=-1)[None, None], 3, stride=1)
        highest = max_pool2d(smooth, 5, stride=1)
        lowest = -max_pool2d(-smooth, 5, stride=1)
        # Both lose 3 pixels at each border.
        counted = view.valid_mask[3:-3, 3:-3]
        is_textured = (highest - lowest)[0, 0] > MIN_CONTRAST
        textured_share = (is_textured & counted).sum() / counted.sum()
        # It is NaN if nothing counts.
        if not textured_share.item() >= MIN_TEXTURED:
            num_flat += 1

    # A single photograph needs none, since its depth is given.
    if len(views) - num_flat < 2 <= len(views):
        raise InputError(
            f"{num_flat} of the {len(views)} context photographs show no texture, and stereo needs "
            "at least 2 that do; choose other photographs."
        )


def sort_by_frame(views: Sequence[View]) -> list[View]:
    """Sort views by frame number, so that their order does not matter; keep it if one has none."""
    if None in [view.frame for view in views]:
        return list(views)
    return sorted(views, key=lambda view: view.frame or 0)


def drop_ignored(reconstruction: Reconstruction, views: Sequence[View]) -> Gaussians:
    """Drop Gaussians of ignored pixels; if Ψ is not pixel-aligned, those that project onto them."""
    gaussians = reconstruction.gaussians
    view_index = reconstruction.view_index
    pixel_index = reconstruction.pixel_index
    gone = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    for number, view in enumerate(views):
        ignored = ~view.valid_mask
        if view_index is None or pixel_index is None:
            gone |= project_mask(ignored, gaussians, view.camera)
        else:
            own = view_index == number
            gone[own] = ignored.flatten()[pixel_index[own]]
    return gaussians[~gone] if gone.any() else gaussians


def normalize_exposures(
    views: Sequence[View], gains: Float[Tensor, "v 3"] | None
) -> tuple[View, ...]:
    """Normalize photographs to the exposure of the context."""
    if gains is None:
        return tuple(views)
    return tuple(view.normalize_exposure(gain) for view, gain in zip(views, gains, strict=True))


def find_splat_range(
    views: Sequence[View], scene: Gaussians, renderer: Renderer
) -> tuple[float, float]:
    """Find near and far plane in scene units: those of the cameras, or of the input splat."""
    cameras = [view.camera for view in views]
    return get_depth_range(views, lambda _: measure_depth_range(scene, cameras, renderer))


def measure_depth_range(
    scene: Gaussians, cameras: Sequence[Camera], renderer: Renderer
) -> tuple[float, float]:
    """Measure near and far plane of an input splat from its rendered depths, in scene units.

    Half the nearest and twice the farthest percentile leave space for what the scene lacks.
    """
    # Depths do not depend on colours, whose harmonics are most of what a renderer reads.
    scene = replace(scene, sh=torch.zeros_like(scene.means)[:, None])
    depths = []
    for camera in cameras:
        if not (compute_z_depths(scene.means, camera) > 0).any():
            continue
        # No near plane is known yet.
        ranged = add_near_plane(replace(camera, near=None), scene.means)
        seen = renderer.render(scene, ranged).depth_map()
        depths.append(seen.depth[seen.valid])
    if not depths or sum(d.numel() for d in depths) == 0:
        raise InputError(
            "No context camera sees the scene that was given; check that the .ply and the "
            "photographs share one world frame and one unit."
        )
    ordered = torch.cat(depths).sort().values  # torch.quantile stops at 16 million
    last = len(ordered) - 1
    low = ordered[round(0.01 * last)].item()
    high = ordered[round(0.99 * last)].item()
    return 0.5 * low, 2.0 * high
