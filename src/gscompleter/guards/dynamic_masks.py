"""Dynamic masks (not in the paper): regions that moved between photographs.

A moved object gets the depth of its surroundings, so that it reprojects onto another colour. With
two photographs, both are masked there; with more, they vote. Wrong depths cause such differences,
too, so images are compared small, with tolerance, and confirmed pixels must surround a region in
both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from gscompleter.config import DynamicMasksConfig
from gscompleter.config.settings import COVERED
from gscompleter.guards import Guard
from gscompleter.numerics.geometry import (
    is_inside,
    measure_baseline,
    project,
    sample,
    shrink_camera,
    unproject,
)
from gscompleter.numerics.image_ops import average_box, dilate
from gscompleter.numerics.robust import fit_robust_affine
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.view_map import get_view_map
from gscompleter.state import Completion
from gscompleter.types import Camera, Render, View

IMAGE_SIDE = 192
"""Longer side of the compared images, in pixels; coarser than most errors of poses."""
NUM_NEIGHBOURS = 2
"""Nearest photographs that each one is compared with."""
MIN_SHARED_PIXELS = 100
"""Fewest pixels that two compared photographs must share."""
MAX_DISPLACEMENT = 2
"""Tolerated displacement in each direction, in pixels."""
PATCH_RADIUS = 2
"""Radius of the patches over which differences are averaged, in pixels."""
MAX_MEDIAN_RATIO = 6.0
"""Multiple of a pair's median difference that reflections and exposure may cause."""
HIDDEN_TOLERANCE = 0.05
"""Tolerated distance of a visible surface behind the other depth map, relative to depth."""
IGNORED_BORDER = 3
"""Width of the image border that is not compared, in pixels."""
GAP_RADIUS = 3
"""Radius of gaps that are closed in a region, in pixels: moving objects may match by chance."""
NOISE_RADIUS = 2
"""Radius of the largest parts that are removed as noise, in pixels."""
MIN_REGION_AREA = 0.005
"""Smallest region, as a fraction of the image."""
REGION_OUTLINE_WIDTH = 3
"""Width of the outline of a region, in pixels."""
MAX_OUT_OF_FRAME = 0.1
"""Largest fraction of an outline outside of the other image.
An object that enters there occludes the scene, and its depth is unknown."""
MIN_OUTLINE_CONFIRMED = 0.4
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
class Comparison:
    """Surfaces of one photograph, reprojected into another and compared with it."""

    pixels: Float[Tensor, "h w 2"]
    """Positions in the other photograph, in its pixels."""
    z: Float[Tensor, "h w"]
    """z-depth at the other camera, in scene units."""
    in_frame_mask: Bool[Tensor, "h w"]
    valid_mask: Bool[Tensor, "h w"]
    """True where both photographs have a known surface."""
    visible_mask: Bool[Tensor, "h w"]
    """True where, besides, no surface of the other photograph is in front."""
    differs_mask: Bool[Tensor, "h w"]

    @property
    def match_mask(self) -> Bool[Tensor, "h w"]:
        """True where the other photograph shows the same colour."""
        return self.visible_mask & ~self.differs_mask

    @property
    def conflict_mask(self) -> Bool[Tensor, "h w"]:
        """True where the other photograph shows another colour."""
        return self.visible_mask & self.differs_mask

    def occlude_by(self, depth: Float[Tensor, "_ _"]) -> Comparison:
        """Determine the visible surfaces again, from another depth map of the other photograph."""
        visible = self.valid_mask & find_unoccluded(self.pixels, self.z, depth)
        return replace(self, visible_mask=visible)


class DynamicMasks(Guard):
    """Copy nothing from regions that moved between photographs."""

    name = "dynamic-masks"

    def begin(self, state: Completion, scenes: SceneRenderer) -> Completion:
        """Add a dynamic mask to each context photograph."""
        frozen = scenes.freeze_at(state.parts, [view.camera for view in state.views])
        renders = [scene.render for scene in frozen]
        masks = find_dynamic_masks(state.views, renders, state.config.dynamic_masks)
        # The context photographs are the first; check photographs follow, and are left as they are.
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
    """Compute a dynamic mask for each photograph by comparison with its neighbours.

    `renders` show the scene at `views`. Masks have the sizes of the photographs.
    """
    photos = [shrink_photo(view, render) for view, render in zip(views, renders, strict=True)]
    votes = [torch.zeros_like(photo.valid_mask, dtype=torch.int32) for photo in photos]
    for one, other in pair_with_neighbours([view.camera for view in views]):
        comparisons = compare_both_ways(photos[one], photos[other], config.min_color_difference)
        regions = find_mutual_regions(*comparisons)
        # Each neighbour votes: +1 for a pixel that contradicts it, -1 for one that it confirms, 0
        # where it does not show the surface. With two photographs the only vote decides, so that
        # both are masked; with more, the majority does.
        for index, comparison, region in zip((one, other), comparisons, regions, strict=True):
            votes[index] += region.int() - (comparison.match_mask & ~region).int()
    return [
        interpolate((vote > 0)[None, None].float(), view.image.shape[:2])[0, 0] > 0
        for vote, view in zip(votes, views, strict=True)
    ]


def pair_with_neighbours(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    """List each camera with its nearest ones, every pair once."""
    pairs: set[tuple[int, int]] = set()
    for index, camera in enumerate(cameras):
        others = [other for other in range(len(cameras)) if other != index]
        others.sort(key=lambda other: measure_baseline(camera, cameras[other]))
        for other in others[:NUM_NEIGHBOURS]:
            pairs.add((min(index, other), max(index, other)))
    return sorted(pairs)


def shrink_photo(view: View, render: Render) -> SmallPhoto:
    """Shrink a photograph and the render at its camera to `IMAGE_SIDE` pixels."""
    camera = shrink_camera(view.camera, IMAGE_SIDE)
    size = (camera.height, camera.width)
    image = interpolate(view.image.permute(2, 0, 1)[None], size, mode="area")[0].permute(1, 2, 0)
    # Depths are sampled: a mean over an edge would be a surface that does not exist.
    depth, alpha = interpolate(torch.stack([render.depth, render.alpha])[None], size)[0]
    # A small pixel is invalid if any part of it is ignored.
    ignored_share = interpolate((~view.valid_mask)[None, None].float(), size, mode="area")[0, 0]
    return SmallPhoto(image, depth, (alpha >= COVERED) & (ignored_share == 0), camera)


def compare_both_ways(
    one: SmallPhoto, other: SmallPhoto, min_difference: float
) -> tuple[Comparison, Comparison]:
    """Compare two photographs both ways: `one` reprojected into `other`, then the reverse."""
    map_views = get_view_map(one.image)
    there, back = map_views(compare_photographs, (one, other), (other, one), [min_difference] * 2)
    # The depth of a moved object is wrong, and may hide what the photograph does show. So surfaces
    # that are in conflict in the reverse comparison occlude nothing: they are put at infinity.
    return (
        there.occlude_by(other.depth.where(~back.conflict_mask, torch.inf)),
        back.occlude_by(one.depth.where(~there.conflict_mask, torch.inf)),
    )


def compare_photographs(photo: SmallPhoto, other: SmallPhoto, min_difference: float) -> Comparison:
    """Reproject the surfaces of one photograph into another and compare colours.

    Masks of the result have the size of `photo`.
    """
    pixels, z = project(unproject(photo.depth, photo.camera), other.camera)
    in_frame = is_inside(pixels - IGNORED_BORDER, z, other.camera)
    in_frame &= is_inside(pixels + IGNORED_BORDER, z, other.camera)
    # Bilinear samples of what is invalid are 0 only if all pixels around are valid. Those of ones
    # are not always 1 in float32.
    is_valid_there = sample((~other.valid_mask)[..., None].float(), pixels)[..., 0] == 0
    known = in_frame & photo.valid_mask & is_valid_there
    visible = known & find_unoccluded(pixels, z, other.depth)
    if int(visible.sum()) < MIN_SHARED_PIXELS:
        nothing = torch.zeros_like(known)
        return Comparison(pixels, z, in_frame, nothing, nothing, nothing)

    # Reflections, exposure and errors of depth make colours differ everywhere. Motion is what
    # differs far more than usual in this pair.
    difference = compute_patch_difference(photo, other, pixels, visible)
    usual = difference[visible].median().item()
    limit = max(min_difference, MAX_MEDIAN_RATIO * usual)
    return Comparison(pixels, z, in_frame, known, visible, difference > limit)


def find_unoccluded(
    pixels: Float[Tensor, "h w 2"], z: Float[Tensor, "h w"], depth: Float[Tensor, "_ _"]
) -> Bool[Tensor, "h w"]:
    """Find points that no surface of a depth map occludes, including its 3 x 3 neighbours."""
    nearest = -max_pool2d(-depth[None, None], 3, stride=1, padding=1)[0, 0]
    surface = sample(nearest[..., None], pixels, "nearest")[..., 0]
    return surface >= (1 - HIDDEN_TOLERANCE) * z


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

    # Errors of depth and pose displace what is compared by a pixel or two.
    # One tensor of all shifts: each would be copied to the GPU by itself.
    shifts = pixels.new_tensor(
        list(product(range(-MAX_DISPLACEMENT, MAX_DISPLACEMENT + 1), repeat=2))
    )
    smallest = torch.ones_like(photo.image[..., 0])
    for shift in shifts:
        shown = sample(normalized, pixels + shift)
        difference = (shown - photo.image).abs().amax(dim=-1)
        smallest = torch.minimum(smallest, average_box(difference, PATCH_RADIUS))
    return smallest


def find_mutual_regions(
    one: Comparison, other: Comparison
) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "other_h other_w"]]:
    """Find regions in which two photographs contradict each other, each in both images.

    A moved object is in conflict at its place in either photograph. Wrong depths often are in one
    alone, so regions stay that project onto a region of the other photograph.
    """
    # The regions of one photograph that go may have confirmed some of the other, so those of the
    # first are tested again.
    other_regions = find_moving_regions(other)
    own_regions = keep_shared_parts(find_moving_regions(one), other_regions, one.pixels)
    other_regions = keep_shared_parts(other_regions, own_regions, other.pixels)
    return keep_shared_parts(own_regions, other_regions, one.pixels), other_regions


def find_moving_regions(comparison: Comparison) -> Bool[Tensor, "h w"]:
    """Find regions in conflict that are large enough and surrounded by confirmed pixels."""
    # Beyond the image nothing is in frame and nothing confirmed, so that an outline that leaves it
    # counts there like one that the other photograph does not show.
    width = GAP_RADIUS + REGION_OUTLINE_WIDTH

    def pad_mask(mask: Bool[Tensor, "h w"]) -> UInt8[np.ndarray, "padded_h padded_w"]:
        return np.pad(mask.cpu().numpy().astype(np.uint8), width)

    conflict = pad_mask(comparison.conflict_mask)
    in_frame = pad_mask(comparison.in_frame_mask)
    confirmed = pad_mask(comparison.match_mask)

    # Parts of a moving object may match by chance: such gaps are closed, then specks removed.
    closed = cv2.morphologyEx(conflict, cv2.MORPH_CLOSE, make_disc(GAP_RADIUS))
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, make_disc(NOISE_RADIUS))
    min_size = MIN_REGION_AREA * comparison.conflict_mask.numel()
    regions = np.zeros(conflict.shape, bool)
    for region in split_parts(opened):
        # The outline is a ring around the region, without the pixels that touch it.
        mask = region.astype(np.uint8)
        outer = cv2.dilate(mask, make_disc(REGION_OUTLINE_WIDTH)) > 0
        outline = outer & (cv2.dilate(mask, make_disc(1)) == 0)
        is_framed = in_frame[outline].mean() >= 1 - MAX_OUT_OF_FRAME
        # Around an object the background agrees; around a wrong depth little does.
        is_surrounded = confirmed[outline].mean() >= MIN_OUTLINE_CONFIRMED
        if region.sum() >= min_size and is_framed and is_surrounded:
            regions |= region
    inner = regions[width:-width, width:-width]
    return torch.from_numpy(inner).to(comparison.conflict_mask.device)


def keep_shared_parts(
    region: Bool[Tensor, "h w"],
    others: Bool[Tensor, "other_h other_w"],
    pixels: Float[Tensor, "h w 2"],
) -> Bool[Tensor, "h w"]:
    """Keep the parts of a region that project onto regions of the other photograph."""
    # With the tolerance of the comparison around the regions of the other photograph.
    reached = dilate(others, MAX_DISPLACEMENT)[..., None].float()
    is_shared = (sample(reached, pixels, "nearest")[..., 0] > 0).cpu().numpy()
    kept = np.zeros(region.shape, bool)
    for part in split_parts(region.cpu().numpy().astype(np.uint8)):
        if (part & is_shared).sum() >= MIN_SHARED_REGION * part.sum():
            kept |= part
    return torch.from_numpy(kept).to(region.device)


def split_parts(mask: UInt8[np.ndarray, "h w"]) -> Iterator[Bool[np.ndarray, "h w"]]:
    """Split a mask into its connected parts."""
    count, labels = cv2.connectedComponents(mask, connectivity=4)
    return (labels == label for label in range(1, count))


def make_disc(radius: int) -> np.ndarray:
    """Make a disc for morphological operations."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
