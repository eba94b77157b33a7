"""Dynamic masks (not in the paper): regions that moved between photographs.

A moved object gets the depth of its surroundings, so that it reprojects onto another colour. With
two photographs, both are masked there; with more, they vote. Wrong depths cause such differences,
too, so images are compared small, with tolerance, and confirmed pixels must surround a region in
both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

from gscompleter.config import DynamicMasksConfig
from gscompleter.config.coverage import COVERED
from gscompleter.generators.exposure import fit_robust_affine
from gscompleter.geometry import (
    is_inside,
    measure_baseline,
    project,
    sample,
    shrink_camera,
    unproject,
)
from gscompleter.guards import Guard
from gscompleter.image_ops import dilate
from gscompleter.render.cache import SceneRenderer
from gscompleter.state import Completion
from gscompleter.types import Camera, Render, View

IMAGE_SIDE = 192
"""Longer side of the compared images, in pixels; coarser than most errors of poses."""
NUM_NEIGHBOURS = 2
"""Nearest photographs that each one is compared with."""
MIN_SHARED_PIXELS = 100
"""Fewest pixels that two compared photographs must share."""
MAX_SHIFT = 2
"""Tolerated displacement in each direction, in pixels."""
PATCH_RADIUS = 2
"""Radius of the patches over which differences are averaged, in pixels."""
MAX_MEDIAN_RATIO = 6.0
"""Multiple of a pair's median difference that reflections and exposure may cause."""
HIDDEN_TOLERANCE = 0.05
"""Tolerated distance of a visible surface behind the other depth map, relative to depth."""
BORDER = 3
"""Width of the image border that is not compared, in pixels."""
GAP_RADIUS = 3
"""Radius of gaps that are closed in a region, in pixels: moving objects may match by chance."""
NOISE_RADIUS = 2
"""Radius of the largest parts that are removed as noise, in pixels."""
MIN_AREA = 0.005
"""Smallest region, as a fraction of the image."""
OUTLINE_WIDTH = 3
"""Width of the outline of a region, in pixels."""
MAX_OUT_OF_FRAME = 0.1
"""Largest fraction of an outline outside of the other image.
An object that enters there occludes the scene, and its depth is unknown."""
MIN_CONFIRMED = 0.4
"""Smallest fraction of an outline that the other photograph confirms."""
MIN_SHARED_REGION = 0.5
"""Smallest fraction of a region that projects onto regions of the other photograph."""


@dataclass(frozen=True)
class SmallPhoto:
    """A small photograph and the rendered depth at its camera."""

    image: Float[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"]
    valid_mask: Bool[Tensor, "h w"]
    """True where the scene has a surface and the photograph is valid."""
    camera: Camera


@dataclass(frozen=True)
class Reprojection:
    """Surfaces of one photograph, reprojected into another."""

    pixels: Float[Tensor, "h w 2"]
    """Positions in the other photograph."""
    z: Float[Tensor, "h w"]
    in_frame_mask: Bool[Tensor, "h w"]
    """True inside the other image."""
    valid_mask: Bool[Tensor, "h w"]
    """True where both photographs have a known surface."""
    difference: Float[Tensor, "h w"]
    """Colour difference in [0, 1]."""
    median_difference: float


@dataclass(frozen=True)
class Comparison:
    """Agreement of one photograph with the surfaces of another."""

    reprojection: Reprojection
    confirmed_mask: Bool[Tensor, "h w"]
    """True where it shows the same colour."""
    conflict_mask: Bool[Tensor, "h w"]
    """True where it shows another colour."""


class DynamicMasks(Guard):
    """Copy nothing from regions that moved between photographs."""

    name = "dynamic-masks"

    def begin(self, state: Completion, scenes: SceneRenderer) -> Completion:
        """Add a dynamic mask to each context photograph."""
        frozen = scenes.freeze_at(state.parts, [view.camera for view in state.views])
        renders = [scene.render for scene in frozen]
        masks = find_dynamic_masks(state.views, renders, state.config.dynamic_masks)
        masked = tuple(
            replace(photo, view=replace(photo.view, dynamic_mask=mask)) if mask.any() else photo
            for photo, mask in zip(state.photos, masks, strict=False)
        )
        return replace(state, photos=(*masked, *state.photos[len(masked) :]))


def find_dynamic_masks(
    views: Sequence[View],
    renders: Sequence[Render],
    config: DynamicMasksConfig = DynamicMasksConfig(),
) -> list[Bool[Tensor, "_ _"]]:
    """Compute a dynamic mask for each photograph by comparison with its neighbours."""
    photos = [shrink_photo(view, render) for view, render in zip(views, renders, strict=True)]
    votes = [torch.zeros_like(photo.valid_mask, dtype=torch.int32) for photo in photos]
    for one, other in pair_with_neighbours([view.camera for view in views]):
        pair = compare_both_ways(photos[one], photos[other], config.min_color_difference)
        for index, comparison, region in zip(
            (one, other), pair, find_mutual_regions(*pair), strict=True
        ):
            votes[index] += region.int() - (comparison.confirmed_mask & ~region).int()
    return [resize_mask(vote > 0, view.camera) for vote, view in zip(votes, views, strict=True)]


def pair_with_neighbours(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    """List each camera with its nearest ones, every pair once."""
    pairs: set[tuple[int, int]] = set()
    for index, camera in enumerate(cameras):
        others = [other for other in range(len(cameras)) if other != index]
        others.sort(key=lambda other: measure_baseline(camera, cameras[other]))
        pairs.update((min(index, o), max(index, o)) for o in others[:NUM_NEIGHBOURS])
    return sorted(pairs)


def shrink_photo(view: View, render: Render) -> SmallPhoto:
    """Shrink a photograph to `IMAGE_SIDE` pixels; depths are sampled, not averaged."""
    camera = shrink_camera(view.camera, IMAGE_SIDE)
    size = camera.height, camera.width
    image = interpolate(view.image.permute(2, 0, 1)[None], size, mode="area")[0].permute(1, 2, 0)
    depth, alpha = interpolate(torch.stack([render.depth, render.alpha])[None], size)[0]
    ignored = interpolate((~view.valid_mask)[None, None].float(), size, mode="area")[0, 0]
    return SmallPhoto(image, depth, (alpha >= COVERED) & (ignored == 0), camera)


def compare_both_ways(
    one: SmallPhoto, other: SmallPhoto, min_difference: float
) -> tuple[Comparison, Comparison]:
    """Compare two photographs both ways, twice: surfaces in conflict then occlude nothing."""
    there, back = reproject(one, other), reproject(other, one)
    first = classify_surfaces(there, other.depth, min_difference)
    second = classify_surfaces(back, one.depth, min_difference)
    return (
        classify_surfaces(
            there, other.depth.where(~second.conflict_mask, torch.inf), min_difference
        ),
        classify_surfaces(back, one.depth.where(~first.conflict_mask, torch.inf), min_difference),
    )


def reproject(photo: SmallPhoto, other: SmallPhoto) -> Reprojection:
    """Reproject the surfaces of one photograph into another and compare colours."""
    pixels, z = project(unproject(photo.depth, photo.camera), other.camera)
    framed = find_inside_border(pixels, z, other.camera)
    known = (
        framed
        & photo.valid_mask
        & (sample(other.valid_mask[..., None].float(), pixels)[..., 0] == 1)
    )
    visible = known & find_unoccluded(pixels, z, other.depth)
    if int(visible.sum()) < MIN_SHARED_PIXELS:
        nothing = torch.zeros_like(known)
        return Reprojection(pixels, z, framed, nothing, nothing.float(), 0.0)
    differences = compute_patch_difference(photo, other, pixels, visible)
    return Reprojection(pixels, z, framed, known, differences, differences[visible].median().item())


def classify_surfaces(
    match: Reprojection, depth: Float[Tensor, "_ _"], min_difference: float
) -> Comparison:
    """Mark visible surfaces as confirmed or in conflict, given the other depth map."""
    visible = match.valid_mask & find_unoccluded(match.pixels, match.z, depth)
    conflict = visible & (
        match.difference > max(min_difference, MAX_MEDIAN_RATIO * match.median_difference)
    )
    return Comparison(match, visible & ~conflict, conflict)


def find_unoccluded(
    pixels: Float[Tensor, "h w 2"], z: Float[Tensor, "h w"], depth: Float[Tensor, "_ _"]
) -> Bool[Tensor, "h w"]:
    """Find points that no surface of a depth map occludes, including its 3 x 3 neighbours."""
    nearest = -max_pool2d(-depth[None, None], 3, stride=1, padding=1)[0, 0]
    return sample(nearest[..., None], pixels, "nearest")[..., 0] >= (1 - HIDDEN_TOLERANCE) * z


def find_inside_border(
    pixels: Float[Tensor, "h w 2"], z: Float[Tensor, "h w"], camera: Camera
) -> Bool[Tensor, "h w"]:
    """Find points inside an image without its border."""
    return is_inside(pixels - BORDER, z, camera) & is_inside(pixels + BORDER, z, camera)


def compute_patch_difference(
    photo: SmallPhoto,
    other: SmallPhoto,
    pixels: Float[Tensor, "h w 2"],
    visible: Bool[Tensor, "h w"],
) -> Float[Tensor, "h w"]:
    """Compute colour differences to another photograph after an exposure fit.

    The largest channel counts, averaged over a patch, at the shift of the smallest difference.
    """
    gain, offset = fit_robust_affine(sample(other.image, pixels)[visible], photo.image[visible])
    normalized = (gain * other.image + offset).clamp(0, 1)
    least = torch.ones_like(photo.image[..., 0])
    for shift in product(range(-MAX_SHIFT, MAX_SHIFT + 1), repeat=2):
        shown = sample(normalized, pixels + pixels.new_tensor(shift))
        differs = (shown - photo.image).abs().amax(dim=-1)
        least = torch.minimum(least, average_patches(differs))
    return least


def average_patches(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Average values over patches."""
    side = 2 * PATCH_RADIUS + 1
    return avg_pool2d(values[None, None], side, 1, PATCH_RADIUS, count_include_pad=False)[0, 0]


def find_mutual_regions(
    one: Comparison, other: Comparison
) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "other_h other_w"]]:
    """Find regions in which two photographs contradict each other, each in both images."""
    other_regions = find_regions(other)
    own_regions = keep_shared_parts(find_regions(one), other_regions, one.reprojection.pixels)
    other_regions = keep_shared_parts(other_regions, own_regions, other.reprojection.pixels)
    return keep_shared_parts(own_regions, other_regions, one.reprojection.pixels), other_regions


def find_regions(comparison: Comparison) -> Bool[Tensor, "h w"]:
    """Find regions in conflict that are large enough and surrounded by confirmed pixels."""
    width = GAP_RADIUS + OUTLINE_WIDTH
    padded = (
        np.pad(mask.cpu().numpy().astype(np.uint8), width)
        for mask in (
            comparison.conflict_mask,
            comparison.reprojection.in_frame_mask,
            comparison.confirmed_mask,
        )
    )
    conflict, framed, confirmed = padded
    whole = cv2.morphologyEx(conflict, cv2.MORPH_CLOSE, make_disc(GAP_RADIUS))
    labels = label_components(cv2.morphologyEx(whole, cv2.MORPH_OPEN, make_disc(NOISE_RADIUS)))
    found = np.zeros_like(labels, dtype=bool)
    for region in (labels == label for label in range(1, labels.max() + 1)):
        outline = compute_outline(region)
        closed = framed[outline].mean() >= 1 - MAX_OUT_OF_FRAME
        certain = confirmed[outline].mean() >= MIN_CONFIRMED
        if region.sum() >= MIN_AREA * comparison.conflict_mask.numel() and closed and certain:
            found |= region
    return torch.from_numpy(found[width:-width, width:-width]).to(comparison.conflict_mask.device)


def keep_shared_parts(
    region: Bool[Tensor, "h w"],
    others: Bool[Tensor, "other_h other_w"],
    pixels: Float[Tensor, "h w 2"],
) -> Bool[Tensor, "h w"]:
    """Keep the parts of a region that project onto regions of the other photograph."""
    falls = sample(dilate(others, 2)[..., None].float(), pixels, "nearest")[..., 0] > 0
    labels = torch.from_numpy(label_components(region.cpu().numpy().astype(np.uint8))).to(
        region.device
    )
    found = torch.zeros_like(region)
    for part in (labels == label for label in range(1, int(labels.max()) + 1)):
        if int((part & falls).sum()) >= MIN_SHARED_REGION * int(part.sum()):
            found |= part
    return found


def compute_outline(region: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Compute the ring around a region, without the pixels that touch it."""
    mask = region.astype(np.uint8)
    return (cv2.dilate(mask, make_disc(OUTLINE_WIDTH)) > 0) & (cv2.dilate(mask, make_disc(1)) == 0)


def label_components(mask: np.ndarray) -> Int[np.ndarray, "h w"]:
    """Label connected components from 1; 0 is background."""
    return cv2.connectedComponents(mask, connectivity=4)[1]


def make_disc(radius: int) -> np.ndarray:
    """Make a disc for morphological operations."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def resize_mask(mask: Bool[Tensor, "small_h small_w"], camera: Camera) -> Bool[Tensor, "h w"]:
    """Resize a small mask to the image of a camera."""
    size = camera.height, camera.width
    return interpolate(mask[None, None].float(), size)[0, 0] > 0
