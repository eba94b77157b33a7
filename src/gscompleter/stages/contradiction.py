"""Dynamic masks (not in the paper): regions that moved between photographs.

A moved object gets the depth of its surroundings, so that it reprojects onto another colour. With
two photographs, both are masked there; with more, they vote. Wrong depths cause such differences,
too, so images are compared small, with tolerance, and confirmed pixels must surround a region in
both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

from gscompleter.config import DynamicMasksConfig
from gscompleter.coverage import COVERED
from gscompleter.generators.robust import robust_affine
from gscompleter.geometry import baseline_between, inside, project, sample, unproject
from gscompleter.masks import dilate
from gscompleter.stages.candidates import shrunk
from gscompleter.types import Camera, Render, View

SIDE = 192
"""Longer side of the compared images, in pixels; coarser than most errors of poses."""
NUM_NEIGHBOURS = 2
"""Nearest photographs that each one is compared with."""
MIN_SHARED = 100
"""Fewest pixels that two compared photographs must share."""
SHIFT = 2
"""Tolerated displacement in each direction, in pixels."""
RADIUS = 2
"""Radius of the patches over which differences are averaged, in pixels."""
USUAL = 6.0
"""Multiple of a pair's median difference that reflections and exposure may cause."""
HIDDEN = 0.05
"""Tolerated distance of a visible surface behind the other depth map, relative to depth."""
BORDER = 3
"""Width of the image border that is not compared, in pixels."""
GAP = 3
"""Radius of gaps that are closed in a region, in pixels: moving objects may match by chance."""
SPECK = 2
"""Radius of the largest parts that are removed as noise, in pixels."""
MIN_AREA = 0.005
"""Smallest region, as a fraction of the image."""
RING = 3
"""Width of the outline of a region, in pixels."""
MAX_OUT_OF_SIGHT = 0.1
"""Largest fraction of an outline outside of the other image.
An object that enters there occludes the scene, and its depth is unknown."""
MIN_CONFIRMED = 0.4
"""Smallest fraction of an outline that the other photograph confirms."""
MIN_SHARED_REGION = 0.5
"""Smallest fraction of a region that projects onto regions of the other photograph."""


@dataclass(frozen=True)
class Sight:
    """A small photograph and the rendered depth at its camera."""

    image: Float[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"]
    known: Bool[Tensor, "h w"]
    """True where the scene has a surface and the photograph is valid."""
    camera: Camera


@dataclass(frozen=True)
class Match:
    """Surfaces of one photograph, reprojected into another."""

    pixels: Float[Tensor, "h w 2"]
    """Positions in the other photograph."""
    z: Float[Tensor, "h w"]
    framed: Bool[Tensor, "h w"]
    """True inside the other image."""
    known: Bool[Tensor, "h w"]
    """True where both photographs have a known surface."""
    difference: Float[Tensor, "h w"]
    """Colour difference in [0, 1]."""
    usual: float


@dataclass(frozen=True)
class Answer:
    """Agreement of one photograph with the surfaces of another."""

    match: Match
    confirmed: Bool[Tensor, "h w"]
    """True where it shows the same colour."""
    denied: Bool[Tensor, "h w"]
    """True where it shows another colour."""


def contradicted(
    views: Sequence[View],
    renders: Sequence[Render],
    config: DynamicMasksConfig = DynamicMasksConfig(),
) -> list[Bool[Tensor, "_ _"]]:
    """Compute a dynamic mask for each photograph by comparison with its neighbours."""
    if config.min_color_difference is None:
        return [torch.zeros_like(view.counted) for view in views]
    photos = [small(view, render) for view, render in zip(views, renders, strict=True)]
    votes = [torch.zeros_like(photo.known, dtype=torch.int32) for photo in photos]
    for one, other in neighbours([view.camera for view in views]):
        pair = questioned(photos[one], photos[other], config.min_color_difference)
        for index, comparison, region in zip((one, other), pair, agreed(*pair), strict=True):
            votes[index] += region.int() - (comparison.confirmed & ~region).int()
    return [at_size(vote > 0, view.camera) for vote, view in zip(votes, views, strict=True)]


def neighbours(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    """List each camera with its nearest ones, every pair once."""
    pairs: set[tuple[int, int]] = set()
    for index, camera in enumerate(cameras):
        others = [other for other in range(len(cameras)) if other != index]
        others.sort(key=lambda other: baseline_between(camera, cameras[other]))
        pairs.update((min(index, o), max(index, o)) for o in others[:NUM_NEIGHBOURS])
    return sorted(pairs)


def small(view: View, render: Render) -> Sight:
    """Shrink a photograph to `IMAGE_SIDE` pixels; depths are sampled, not averaged."""
    camera = shrunk(view.camera, SIDE)
    size = camera.height, camera.width
    image = interpolate(view.image.permute(2, 0, 1)[None], size, mode="area")[0].permute(1, 2, 0)
    depth, alpha = interpolate(torch.stack([render.depth, render.alpha])[None], size)[0]
    ignored = interpolate((~view.counted)[None, None].float(), size, mode="area")[0, 0]
    return Sight(image, depth, (alpha >= COVERED) & (ignored == 0), camera)


def questioned(one: Sight, other: Sight, min_difference: float) -> tuple[Answer, Answer]:
    """Compare two photographs both ways, twice: surfaces in conflict then occlude nothing."""
    there, back = compared(one, other), compared(other, one)
    first = answered(there, other.depth, min_difference)
    second = answered(back, one.depth, min_difference)
    return (
        answered(there, other.depth.where(~second.denied, torch.inf), min_difference),
        answered(back, one.depth.where(~first.denied, torch.inf), min_difference),
    )


def compared(asked: Sight, other: Sight) -> Match:
    """Reproject the surfaces of one photograph into another and compare colours."""
    pixels, z = project(unproject(asked.depth, asked.camera), other.camera)
    framed = within(pixels, z, other.camera)
    known = framed & asked.known & (sample(other.known[..., None].float(), pixels)[..., 0] == 1)
    visible = known & unhidden(pixels, z, other.depth)
    if int(visible.sum()) < MIN_SHARED:
        nothing = torch.zeros_like(known)
        return Match(pixels, z, framed, nothing, nothing.float(), 0.0)
    differences = difference(asked, other, pixels, visible)
    return Match(pixels, z, framed, known, differences, differences[visible].median().item())


def answered(match: Match, depth: Float[Tensor, "_ _"], min_difference: float) -> Answer:
    """Mark visible surfaces as confirmed or in conflict, given the other depth map."""
    visible = match.known & unhidden(match.pixels, match.z, depth)
    conflict = visible & (match.difference > max(min_difference, USUAL * match.usual))
    return Answer(match, visible & ~conflict, conflict)


def unhidden(
    pixels: Float[Tensor, "h w 2"], z: Float[Tensor, "h w"], depth: Float[Tensor, "_ _"]
) -> Bool[Tensor, "h w"]:
    """Find points that no surface of a depth map occludes, including its 3 x 3 neighbours."""
    nearest = -max_pool2d(-depth[None, None], 3, stride=1, padding=1)[0, 0]
    return sample(nearest[..., None], pixels, "nearest")[..., 0] >= (1 - HIDDEN) * z


def within(
    pixels: Float[Tensor, "h w 2"], z: Float[Tensor, "h w"], camera: Camera
) -> Bool[Tensor, "h w"]:
    """Find points inside an image without its border."""
    return inside(pixels - BORDER, z, camera) & inside(pixels + BORDER, z, camera)


def difference(
    asked: Sight, other: Sight, pixels: Float[Tensor, "h w 2"], seen: Bool[Tensor, "h w"]
) -> Float[Tensor, "h w"]:
    """Compute colour differences to another photograph after an exposure fit.

    The largest channel counts, averaged over a patch, at the shift of the smallest difference.
    """
    gain, offset = robust_affine(sample(other.image, pixels)[seen], asked.image[seen])
    normalized = (gain * other.image + offset).clamp(0, 1)
    least = torch.ones_like(asked.image[..., 0])
    for shift in product(range(-SHIFT, SHIFT + 1), repeat=2):
        shown = sample(normalized, pixels + pixels.new_tensor(shift))
        differs = (shown - asked.image).abs().amax(dim=-1)
        least = torch.minimum(least, averaged(differs))
    return least


def averaged(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Average values over patches."""
    side = 2 * RADIUS + 1
    return avg_pool2d(values[None, None], side, 1, RADIUS, count_include_pad=False)[0, 0]


def agreed(
    one: Answer, other: Answer
) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "other_h other_w"]]:
    """Find regions in which two photographs contradict each other, each in both images."""
    other_regions = regions(other)
    own_regions = common(regions(one), other_regions, one.match.pixels)
    other_regions = common(other_regions, own_regions, other.match.pixels)
    return common(own_regions, other_regions, one.match.pixels), other_regions


def regions(answer: Answer) -> Bool[Tensor, "h w"]:
    """Find regions in conflict that are large enough and surrounded by confirmed pixels."""
    width = GAP + RING
    padded = (
        np.pad(mask.cpu().numpy().astype(np.uint8), width)
        for mask in (answer.denied, answer.match.framed, answer.confirmed)
    )
    conflict, framed, confirmed = padded
    whole = cv2.morphologyEx(conflict, cv2.MORPH_CLOSE, disc(GAP))
    labels = labelled(cv2.morphologyEx(whole, cv2.MORPH_OPEN, disc(SPECK)))
    found = np.zeros_like(labels, dtype=bool)
    for region in (labels == label for label in range(1, labels.max() + 1)):
        outline = outline_of(region)
        closed = framed[outline].mean() >= 1 - MAX_OUT_OF_SIGHT
        certain = confirmed[outline].mean() >= MIN_CONFIRMED
        if region.sum() >= MIN_AREA * answer.denied.numel() and closed and certain:
            found |= region
    return torch.from_numpy(found[width:-width, width:-width]).to(answer.denied.device)


def common(
    region: Bool[Tensor, "h w"],
    others: Bool[Tensor, "other_h other_w"],
    pixels: Float[Tensor, "h w 2"],
) -> Bool[Tensor, "h w"]:
    """Keep the parts of a region that project onto regions of the other photograph."""
    falls = sample(dilate(others, 2)[..., None].float(), pixels, "nearest")[..., 0] > 0
    labels = torch.from_numpy(labelled(region.cpu().numpy().astype(np.uint8))).to(region.device)
    found = torch.zeros_like(region)
    for part in (labels == label for label in range(1, int(labels.max()) + 1)):
        if int((part & falls).sum()) >= MIN_SHARED_REGION * int(part.sum()):
            found |= part
    return found


def outline_of(region: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Compute the ring around a region, without the pixels that touch it."""
    mask = region.astype(np.uint8)
    return (cv2.dilate(mask, disc(RING)) > 0) & (cv2.dilate(mask, disc(1)) == 0)


def labelled(mask: np.ndarray) -> Int[np.ndarray, "h w"]:
    """Label connected components from 1; 0 is background."""
    return cv2.connectedComponents(mask, connectivity=4)[1]


def disc(radius: int) -> np.ndarray:
    """Make a disc for morphological operations."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def at_size(mask: Bool[Tensor, "small_h small_w"], camera: Camera) -> Bool[Tensor, "h w"]:
    """Resize a small mask to the image of a camera."""
    size = camera.height, camera.width
    return interpolate(mask[None, None].float(), size)[0, 0] > 0
