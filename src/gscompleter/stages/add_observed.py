"""Add what photographs show and a given scene lacks, before Φ invents (not in the paper).

Φ warps photographs through the depth of the scene, and a hole has none: the image at a target is a
blur where eight photographs show a box. So Ψ reconstructs the photographs that show what is
missing, as it reconstructs a context without a scene. Its Gaussians of these pixels are registered
to the scene by one scale of their depths (decision 133) and Eq. 9, selected by Eq. 12 at the
photographs, and refined against all of them, since each is a true image (decision 051).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import HoleConfig
from gscompleter.numerics.geometry import (
    adapt_to_mode,
    find_at_depth,
    look_up,
    measure_baseline,
    select_spread_cameras,
)
from gscompleter.numerics.image_ops import dilate, label_regions
from gscompleter.parts import PartOrigin
from gscompleter.reconstructors import (
    PartReconstructor,
    Reconstructor,
    run_part_reconstructor,
)
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.fit_colors import RELAXATION, fit_colors
from gscompleter.render.protocols import FrozenScene
from gscompleter.stages.additions import Additions, Refined, accept
from gscompleter.stages.align_photographs import align_photographs
from gscompleter.stages.error_budgets import meet_error_budgets, share_budgets
from gscompleter.stages.hole_masks import compute_hole_mask
from gscompleter.stages.new_photos import match_exposure
from gscompleter.stages.refine import refine_opacities
from gscompleter.stages.register import apply_affine
from gscompleter.stages.select_anchor import find_nearest_view
from gscompleter.stages.thin_additions import drop_doubled
from gscompleter.state import Completion
from gscompleter.system.progress import track
from gscompleter.trust.photometric import compute_color_differences
from gscompleter.types import (
    DepthAffine,
    DepthMap,
    Gaussians,
    Reconstruction,
    Render,
    View,
    merge,
)

MAX_RECONSTRUCTED = 24
"""Most photographs that are reconstructed, in one reconstruction or in several."""
MAX_STEREO_PHOTOS = 8
"""Most photographs of one reconstruction, of any size and by any Ψ."""
MAX_STEREO_PIXELS = MAX_RECONSTRUCTED * 640 * 360
"""Most pixels of more photographs, for a Ψ that builds only what is missing."""
MIN_ADDED_SHARE = 0.002
"""Smallest share of a photograph that is worth adding."""
MIN_REGION = 0.005
"""Smallest contradicted region, as a share of the photograph. In a splat that lacks nothing, such
as the fox, edges and highlights make up to 0.4 %."""
MIN_WITNESSES = 2
"""Fewest photographs that have to contradict a scene: one alone may show something that moved."""
MIN_DIFFERENCE = 0.06
"""Smallest colour difference, in [0, 1], by which a scene contradicts a photograph."""
MAX_DIFFERENCE_RATIO = 4.0
"""Multiple of the median difference of this scene that such a difference has to exceed, too."""
NEARER = 0.97
"""Ratio to the depth of the scene below which a photograph shows something in front of it."""
MIN_NEARER = 0.5
"""Smallest share of the measured pixels of a contradicted region that have to be nearer."""
OBSERVED_COLOR_ROUNDS = 5
"""Rounds in which colours are fitted to all photographs."""


@dataclass(frozen=True)
class Lack:
    """Pixels of a photograph in which the scene does not show what the photograph shows."""

    empty: Bool[Tensor, "h w"]
    """The scene is empty: A < τ."""
    contradicted: Bool[Tensor, "h w"]
    """The scene is covered and has another colour, in regions that are large enough."""

    @property
    def mask(self) -> Bool[Tensor, "h w"]:
        """All of these pixels."""
        return self.empty | self.contradicted

    @property
    def share(self) -> float:
        """Share of the image."""
        return self.mask.float().mean().item()


@dataclass(frozen=True)
class Evidence:
    """A photograph that shows something missing, and the scene at its camera."""

    view: View
    frozen: FrozenScene
    lack: Lack


def add_observed(
    reconstructor: Reconstructor, state: Completion, scenes: SceneRenderer
) -> Completion:
    """Add what photographs show and the scene lacks, as parts of that origin.

    Nothing changes for a context that Ψ reconstructed: it has what its photographs show.
    """
    if not state.is_given or not state.config.add_observed:
        return state
    max_photos = limit_stereo_photos(reconstructor, [photo.view for photo in state.photos])
    rounds = math.ceil(MAX_RECONSTRUCTED / max_photos)
    reconstructed: set[int] = set()
    for _ in track(range(rounds), "Adding what photographs show"):
        num_parts = len(state.added_parts)
        state = add_lacking(reconstructor, state, scenes, reconstructed, max_photos)
        # What was found and could not be added would be found again.
        if len(state.added_parts) == num_parts:
            break
    return state


def limit_stereo_photos(reconstructor: Reconstructor, views: Sequence[View]) -> int:
    """Compute the most photographs of one reconstruction.

    What many photographs show is built and fitted once where they are reconstructed together: 24
    photographs of a fox take three quarters of the time of three times eight, and are as good.
    """
    # Networks keep whole images, and were trained with few of them.
    if not isinstance(reconstructor, PartReconstructor):
        return MAX_STEREO_PHOTOS
    return limit_part_photos(max(view.valid_mask.numel() for view in views))


def limit_part_photos(pixels: int) -> int:
    """Compute how many photographs of so many pixels a Ψ takes that builds what is missing."""
    return min(max(MAX_STEREO_PIXELS // pixels, MAX_STEREO_PHOTOS), MAX_RECONSTRUCTED)


def add_lacking(
    reconstructor: Reconstructor,
    state: Completion,
    scenes: SceneRenderer,
    reconstructed: set[int],
    max_photos: int,
) -> Completion:
    """Add what some photographs show and the scene lacks, at most `max_photos`.

    They are noted in `reconstructed`, so that none is taken twice.

    Frozen views of the scene before are forgotten at the end, so that those of the scene after take
    their place: both together would be the most memory of the context.
    """
    views = [photo.view for photo in state.photos]
    frozen = scenes.freeze_at(state.parts, [view.camera for view in views])
    renders = [scene.render for scene in frozen]
    lacks = find_lacks(views, renders, state.config.holes)
    chosen = choose_photographs(views, lacks, max_photos, reconstructed)
    if not chosen:
        return state
    reconstructed.update(chosen)
    photos = [Evidence(views[i], frozen[i], lacks[i]) for i in chosen]
    lacking, notes = reconstruct_lacking(reconstructor, photos, state)
    state = replace(state, context_notes=(*state.context_notes, *notes))
    candidates = Additions.begin(PartOrigin("photographs"), "select", lacking)
    part = accept_photographed(candidates, frozen, state).to_part()
    if len(part) == 0:
        return state
    return replace(state, added_parts=(*state.added_parts, part))


def find_lacks(
    views: Sequence[View], renders: Sequence[Render], settings: HoleConfig
) -> list[Lack]:
    """Find what the scene lacks in each photograph, apart from pixels that are ignored."""
    differences, limit = compare_colors(views, renders)
    lacks: list[Lack] = []
    for render, view, difference in zip(renders, views, differences, strict=True):
        is_usable = find_usable(view)
        empty = compute_hole_mask(render.alpha, settings) & is_usable
        contradicted = (difference > limit) & is_usable & ~empty
        lacks.append(Lack(empty, keep_large_regions(contradicted)))
    if sum(bool(lack.contradicted.any()) for lack in lacks) < MIN_WITNESSES:
        lacks = [Lack(lack.empty, torch.zeros_like(lack.empty)) for lack in lacks]
    return lacks


def compare_colors(
    views: Sequence[View], renders: Sequence[Render]
) -> tuple[list[Float[Tensor, "_ _"]], float]:
    """Compute colour differences at photographs, and the one from which on they contradict."""
    # A difference that is usual in this scene is no contradiction.
    differences, usual = compute_color_differences(views, renders)
    return differences, max(MIN_DIFFERENCE, MAX_DIFFERENCE_RATIO * usual)


def find_usable(view: View) -> Bool[Tensor, "h w"]:
    """Find the pixels that are not ignored, and show nothing that moves."""
    if view.dynamic_mask is None:
        return view.valid_mask
    return view.valid_mask & ~view.dynamic_mask


def keep_large_regions(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Keep connected regions of at least `MIN_REGION` of the image."""
    labels, count = label_regions(mask)
    is_large = torch.bincount(labels.flatten(), minlength=count) >= MIN_REGION * mask.numel()
    is_large[0] = False  # the background
    return is_large[labels]


def choose_photographs(
    views: Sequence[View],
    lacks: Sequence[Lack],
    max_photos: int,
    reconstructed: Collection[int] = (),
) -> list[int]:
    """Choose photographs that show together what the scene lacks; none if there is no stereo.

    There are at most `max_photos`, and one more if it is their stereo partner. What those that were
    `reconstructed` before still show could not be added.
    """
    showing = [
        index
        for index, lack in enumerate(lacks)
        if lack.share >= MIN_ADDED_SHARE and index not in reconstructed
    ]
    if not showing:
        return []
    # The networks need images of one size; check views may be smaller than the context.
    most = max(showing, key=lambda index: lacks[index].share)
    size = views[most].image.shape
    alike = [index for index, view in enumerate(views) if view.image.shape == size]
    showing = [index for index in showing if index in alike]
    # Spread over all of them: eight neighbours left the far photographs 1.4 dB lower.
    spread = select_spread_cameras([views[index].camera for index in showing], max_photos)
    chosen = [showing[index] for index in spread]

    # Stereo needs a second place: photographs from one place get the nearest one from elsewhere.
    here = views[most].camera
    if all(measure_baseline(here, views[index].camera) == 0 for index in chosen):
        elsewhere = [i for i in alike if measure_baseline(here, views[i].camera) > 0]
        if not elsewhere:
            return []
        nearest = find_nearest_view(here, [views[index] for index in elsewhere])
        chosen.append(elsewhere[nearest])
    return sorted(chosen)


def reconstruct_lacking(
    reconstructor: Reconstructor,
    photos: Sequence[Evidence],
    state: Completion,
) -> tuple[Gaussians, tuple[str, ...]]:
    """Reconstruct photographs and keep the Gaussians of what the scene lacks, registered to it.

    Returns the sentences of Ψ, too.
    """
    views = []
    for photo in photos:
        known = photo.view.valid_mask & ~photo.lack.mask
        image = match_exposure(photo.view.image, photo.frozen.render.image, known)
        views.append(replace(photo.view, image=image))

    # Depths tell what is added. Where that is nothing, as in a splat that only draws its surfaces
    # a little wrong, Ψ builds nothing.
    def place(depths: Sequence[DepthMap]) -> PlacedDepths:
        return place_depths(depths, photos, state.config.holes, state.seed)

    reconstruction = run_part_reconstructor(
        reconstructor, views, lambda depths: place(depths).masks
    )
    placed = place(reconstruction.depths)
    affine = placed.affine
    aligned = placed.depths
    masks = placed.masks

    if reconstruction.view_index is None:
        # A Ψ that is not pixel-aligned does not say from which camera a Gaussian could slide.
        shown = find_photographed(reconstruction, views, masks)
        parts = [
            adapt_to_mode(state.rendered_context, reconstruction.gaussians[shown], views[0].camera)
        ]
    else:
        # Moved before they are selected: what a photograph shows of the Gaussians of another one
        # depends on where they stand.
        moved = replace(move_all(reconstruction, affine, views), depths=tuple(aligned))
        shown = find_photographed(moved, views, masks)
        parts = []
        for number, view in enumerate(views):
            own = shown & (moved.view_index == number)
            parts.append(adapt_to_mode(state.rendered_context, moved.gaussians[own], view.camera))
    part = merge(parts)
    # No more harmonics than the scene has, whose file has no place for them. The fit of colours
    # that follows makes up for them.
    sh = part.sh[:, : state.context.sh.shape[1]]
    return replace(part, sh=sh), reconstruction.notes


@dataclass(frozen=True)
class PlacedDepths:
    """Depths of photographs that are moved to the scene, and the pixels that they add to it."""

    affine: DepthAffine
    depths: Sequence[DepthMap]
    masks: Sequence[Bool[Tensor, "_ _"]]


def place_depths(
    depths: Sequence[DepthMap],
    photos: Sequence[Evidence],
    settings: HoleConfig,
    seed: int,
) -> PlacedDepths:
    """Move Ψ's depths of photographs to the scene, and select the pixels whose Gaussians it lacks.

    `seed` is that of the RANSAC samples.
    """
    # D_pred is Ψ's depth of a photograph, D_ctx that of the scene there, where it is not wrong.
    scenes = [photo.frozen.render.depth_map() for photo in photos]
    right = [
        replace(scene, valid=scene.valid & ~photo.lack.mask)
        for scene, photo in zip(scenes, photos, strict=True)
    ]
    affine = align_photographs(depths, right, torch.Generator().manual_seed(seed))
    aligned = [
        replace(predicted, depth=affine.scale * predicted.depth + affine.shift)
        for predicted in depths
    ]
    masks = [
        select_pixels(photo.lack, depth, scene, settings.dilation)
        for photo, depth, scene in zip(photos, aligned, scenes, strict=True)
    ]
    return PlacedDepths(affine, aligned, masks)


def move_all(
    reconstruction: Reconstruction, affine: DepthAffine, views: Sequence[View]
) -> Reconstruction:
    """Move the Gaussians of a pixel-aligned Ψ along the rays of their photographs (Eq. 9).

    They come out in the order of their photographs; depth maps stay.
    """
    assert reconstruction.view_index is not None
    owned = [
        torch.nonzero(reconstruction.view_index == number)[:, 0] for number in range(len(views))
    ]
    moved = [
        apply_affine(reconstruction.gaussians[rows], affine, view.camera)
        for rows, view in zip(owned, views, strict=True)
    ]
    order = torch.cat(owned)
    pixels = reconstruction.pixel_index
    return replace(
        reconstruction,
        gaussians=merge(moved),
        view_index=reconstruction.view_index[order],
        pixel_index=None if pixels is None else pixels[order],
    )


def select_pixels(
    lack: Lack, photographed: DepthMap, scene: DepthMap, dilation: int
) -> Bool[Tensor, "h w"]:
    """Select the pixels of a photograph whose Gaussians are added (Eq. 12 at the photograph).

    Of contradicted regions these are pixels at which the photographs measure something in front of
    the scene. What they see through to cannot be mended by adding, since the scene hides it.
    """
    nearer = photographed.depth < NEARER * scene.depth
    labels, count = label_regions(lack.contradicted)
    # A region counts as a whole, by the pixels with a measured depth: a few of them in any region
    # are wrong.
    measured = lack.contradicted & photographed.valid & scene.valid
    num_measured = torch.bincount(labels[measured], minlength=count)
    num_nearer = torch.bincount(labels[measured & nearer], minlength=count)
    is_in_front = (num_measured > 0) & (num_nearer >= MIN_NEARER * num_measured)
    # Only empty pixels have a seam that has to be covered: around others the scene is right, and
    # better than what Ψ makes of a few photographs.
    return dilate(lack.empty, dilation) | (lack.contradicted & is_in_front[labels] & nearer)


def find_photographed(
    reconstruction: Reconstruction, views: Sequence[View], masks: Sequence[Bool[Tensor, "h w"]]
) -> Bool[Tensor, "n"]:
    """Find the Gaussians that any photograph shows in its mask.

    The source pixel alone does not tell: of the Gaussians of one surface in several photographs Ψ
    keeps one, whose own pixel may lie outside of the mask there. With it alone the box needed four
    rounds, and the photographs ended 1.5 dB lower.
    """
    gaussians = reconstruction.gaussians
    shown = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    for number, (view, mask) in enumerate(zip(views, masks, strict=True)):
        is_visible = find_at_depth(gaussians, reconstruction.depths[number].depth, view.camera)
        shown |= is_visible & look_up(mask, gaussians, view.camera)
        if reconstruction.view_index is not None and reconstruction.pixel_index is not None:
            own = reconstruction.view_index == number
            shown |= own & mask.flatten()[reconstruction.pixel_index.where(own, 0)]
    return shown


def accept_photographed(
    candidates: Additions, frozen: Sequence[FrozenScene], state: Completion
) -> Additions:
    """Accept Gaussians that photographs show, `frozen` being the scene at all of these.

    They are placed already, by the scale of their depths, and selected by Eq. 12. Guards judge what
    an image at a target adds, and have no say: here every image is a photograph.
    """
    guard = state.config.psnr_guard

    def keep_places(placed: Additions) -> Additions:
        return placed

    def refine(placed: Gaussians) -> Refined:
        return refine_to_photographs(placed, frozen, state)

    def keep_budgets(added: Additions, refined: Refined) -> Additions:
        budgets = [
            share_budgets(photo.budgets, scene.render.image, guard)
            for photo, scene in zip(state.photos, frozen, strict=True)
        ]
        kept = meet_error_budgets(refined.gaussians, frozen, budgets, refined.plans, guard)
        if len(kept) == 0:
            return added.then("psnr", kept)
        views = [photo.view for photo in state.photos]
        thinned = drop_doubled(kept, views, frozen)
        # Colours that were fitted before opacities changed, and before some went, are not right any
        # more: of eight photographs of a fountain the mean gains 0.25 dB, one kept back 0.2 dB.
        fitted = fit_to_photographs(thinned, views, frozen)
        plans = [scene.vary_opacities(fitted) for scene in frozen]
        met = meet_error_budgets(fitted, frozen, budgets, plans, guard)
        return added.then("psnr", kept).then("superfluous", met)

    return accept(candidates, keep_places, refine, keep_budgets)


def refine_to_photographs(
    placed: Gaussians, frozen: Sequence[FrozenScene], state: Completion
) -> Refined:
    """Fit new Gaussians to all photographs that see them.

    Colours, then opacities (Eq. 13): photographs are true images, so each has the weight 1.
    """
    views = [photo.view for photo in state.photos]
    colored = fit_to_photographs(placed, views, frozen)
    plans = tuple(scene.vary_opacities(colored) for scene in frozen)
    settings = replace(state.config.refine, target_weight=1.0)
    refined, losses = refine_opacities(colored, plans[0], views[0], plans[1:], views[1:], settings)
    return Refined(refined, plans, losses)


def fit_to_photographs(
    added: Gaussians, views: Sequence[View], frozen: Sequence[FrozenScene]
) -> Gaussians:
    """Fit the colours of additions to all photographs that see them."""
    # In ignored pixels colours stay as the scene shows them.
    wanted = [
        view.paint_ignored(scene.render.image) for view, scene in zip(views, frozen, strict=True)
    ]
    return fit_colors(added, frozen, wanted, [RELAXATION] * OBSERVED_COLOR_ROUNDS)
