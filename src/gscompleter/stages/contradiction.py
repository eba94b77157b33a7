"""Stage 1, ours: where photographs contradict each other, because something moved between them.

A thing that stands elsewhere in each photograph has no match, so that Ψ gives it the depth of what
surrounds it. Placed there it falls, in the other photograph, on something of another colour. Of two
photographs nobody knows which is right, and what is completed takes nothing from either there; of
more, most decide. The scene itself stays as it is.

Depths are wrong in other ways, too, and what they mislead is no contradiction. So images are
compared small and loosely, and only regions count that the other photograph encloses by what it
confirms, and that it finds at the same place when it asks in turn.
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
"""Pixels of the longer side of the images that are compared: a pixel is then wider than most errors
of poses and depths."""
NUM_NEIGHBOURS = 2
"""Photographs, the nearest ones, that each is compared with."""
MIN_SHARED = 100
"""Fewest pixels that two photographs must share to be compared."""
SHIFT = 2
"""Pixels by which a surface may lie aside, in each direction, and still be the same."""
RADIUS = 2
"""Of the patches over which differences are averaged, in pixels."""
USUAL = 6.0
"""How many times the median difference between two photographs is no contradiction: reflections
and exposure make some pairs differ everywhere."""
HIDDEN = 0.05
"""How far behind what the other photograph sees a surface may lie and be seen by it, relative to
its depth."""
BORDER = 3
"""Pixels at the border of an image in which it does not say that it sees something."""
GAP = 3
"""Radius of the gaps in a region that belong to it, in pixels: what moves may match by chance."""
SPECK = 2
"""Radius of the largest parts that belong to no region, in pixels."""
MIN_AREA = 0.005
"""Share of the image that a region fills at least."""
RING = 3
"""Width of the outline of a region, in pixels."""
MAX_OUT_OF_SIGHT = 0.1
"""Largest share of the outline that leaves the frame of either photograph: what enters there stands
before the scene, and nothing has measured its depth."""
MIN_CONFIRMED = 0.4
"""Least share of the outline that the other photograph confirms."""
MIN_SHARED_REGION = 0.5
"""Least share of a region that falls on regions of the other photograph."""


@dataclass(frozen=True)
class Sight:
    """A photograph made small, and the scene as its camera sees it."""

    image: Float[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"]
    """z-depth in scene units."""
    known: Bool[Tensor, "h w"]
    """Where the scene has a surface, and the photograph is not to be ignored."""
    camera: Camera


@dataclass(frozen=True)
class Match:
    """The surfaces that a photograph shows, where another photograph has them."""

    pixels: Float[Tensor, "h w 2"]
    """Where they lie in the other photograph."""
    z: Float[Tensor, "h w"]
    """Their z-depth there."""
    framed: Bool[Tensor, "h w"]
    """Whether that is within its frame."""
    known: Bool[Tensor, "h w"]
    """Whether both photographs show a surface there."""
    difference: Float[Tensor, "h w"]
    """How different they look, in [0, 1]."""
    usual: float
    """The median difference of what both see."""


@dataclass(frozen=True)
class Answer:
    """What another photograph says of the surfaces that a photograph shows."""

    match: Match
    confirmed: Bool[Tensor, "h w"]
    """Whether it sees them, in the same colour."""
    denied: Bool[Tensor, "h w"]
    """Whether it sees something of another colour in their place."""


def contradicted(
    views: Sequence[View],
    renders: Sequence[Render],
    config: DynamicMasksConfig = DynamicMasksConfig(),
) -> list[Bool[Tensor, "_ _"]]:
    """Which pixels of each photograph its neighbours contradict, as regions.

    Args:
        views: Photographs with their cameras.
        renders: The scene that Ψ made of them, as these cameras see it.
        config: From which difference on.
    """
    if config.min_color_difference is None:
        return [torch.zeros_like(view.counted) for view in views]
    sights = [small(view, render) for view, render in zip(views, renders, strict=True)]
    votes = [torch.zeros_like(sight.known, dtype=torch.int32) for sight in sights]
    for one, other in neighbours([view.camera for view in views]):
        answers = questioned(sights[one], sights[other], config.min_color_difference)
        for index, answer, region in zip((one, other), answers, agreed(*answers), strict=True):
            votes[index] += region.int() - (answer.confirmed & ~region).int()
    return [at_size(vote > 0, view.camera) for vote, view in zip(votes, views, strict=True)]


def neighbours(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    """Each camera with those that stand nearest to it; a pair once."""
    pairs: set[tuple[int, int]] = set()
    for index, camera in enumerate(cameras):
        others = [other for other in range(len(cameras)) if other != index]
        others.sort(key=lambda other: baseline_between(camera, cameras[other]))
        pairs.update((min(index, o), max(index, o)) for o in others[:NUM_NEIGHBOURS])
    return sorted(pairs)


def small(view: View, render: Render) -> Sight:
    """A photograph of at most SIDE pixels. Depths are taken, not averaged."""
    camera = shrunk(view.camera, SIDE)
    size = camera.height, camera.width
    image = interpolate(view.image.permute(2, 0, 1)[None], size, mode="area")[0].permute(1, 2, 0)
    depth, alpha = interpolate(torch.stack([render.depth, render.alpha])[None], size)[0]
    ignored = interpolate((~view.counted)[None, None].float(), size, mode="area")[0, 0]
    return Sight(image, depth, (alpha >= COVERED) & (ignored == 0), camera)


def questioned(one: Sight, other: Sight, min_difference: float) -> tuple[Answer, Answer]:
    """What two photographs say of each other. What one of them denies hides nothing in the other,
    so they are asked again."""
    there, back = compared(one, other), compared(other, one)
    first = answered(there, other.depth, min_difference)
    second = answered(back, one.depth, min_difference)
    return (
        answered(there, other.depth.where(~second.denied, torch.inf), min_difference),
        answered(back, one.depth.where(~first.denied, torch.inf), min_difference),
    )


def compared(asked: Sight, other: Sight) -> Match:
    """The surfaces of `asked`, and what `other` shows in their places."""
    pixels, z = project(unproject(asked.depth, asked.camera), other.camera)
    framed = within(pixels, z, other.camera)
    known = framed & asked.known & (sample(other.known[..., None].float(), pixels)[..., 0] == 1)
    seen = known & unhidden(pixels, z, other.depth)
    if int(seen.sum()) < MIN_SHARED:
        nothing = torch.zeros_like(known)
        return Match(pixels, z, framed, nothing, nothing.float(), 0.0)
    differences = difference(asked, other, pixels, seen)
    return Match(pixels, z, framed, known, differences, differences[seen].median().item())


def answered(match: Match, depth: Float[Tensor, "_ _"], min_difference: float) -> Answer:
    """What the other photograph says, where things stand at `depth` in it."""
    seen = match.known & unhidden(match.pixels, match.z, depth)
    denied = seen & (match.difference > max(min_difference, USUAL * match.usual))
    return Answer(match, seen & ~denied, denied)


def unhidden(
    pixels: Float[Tensor, "h w 2"], z: Float[Tensor, "h w"], depth: Float[Tensor, "_ _"]
) -> Bool[Tensor, "h w"]:
    """Where nothing of `depth` stands before what lies at `pixels` and at `z`, nor beside it."""
    nearest = -max_pool2d(-depth[None, None], 3, stride=1, padding=1)[0, 0]
    return sample(nearest[..., None], pixels, "nearest")[..., 0] >= (1 - HIDDEN) * z


def within(
    pixels: Float[Tensor, "h w 2"], z: Float[Tensor, "h w"], camera: Camera
) -> Bool[Tensor, "h w"]:
    """Where points lie in an image, and not at its border."""
    return inside(pixels - BORDER, z, camera) & inside(pixels + BORDER, z, camera)


def difference(
    asked: Sight, other: Sight, pixels: Float[Tensor, "h w 2"], seen: Bool[Tensor, "h w"]
) -> Float[Tensor, "h w"]:
    """Difference of colour between a photograph and another at `pixels`: the mean over a patch of
    the channel that differs most, at the shift where it is least, in the exposure of the first."""
    gain, offset = robust_affine(sample(other.image, pixels)[seen], asked.image[seen])
    evened = (gain * other.image + offset).clamp(0, 1)
    least = torch.ones_like(asked.image[..., 0])
    for shift in product(range(-SHIFT, SHIFT + 1), repeat=2):
        shown = sample(evened, pixels + pixels.new_tensor(shift))
        differs = (shown - asked.image).abs().amax(dim=-1)
        least = torch.minimum(least, averaged(differs))
    return least


def averaged(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Means over patches."""
    side = 2 * RADIUS + 1
    return avg_pool2d(values[None, None], side, 1, RADIUS, count_include_pad=False)[0, 0]


def agreed(
    one: Answer, other: Answer
) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "other_h other_w"]]:
    """Regions in which two photographs deny each other, each found in the other's place."""
    yours = regions(other)
    mine = common(regions(one), yours, one.match.pixels)
    yours = common(yours, mine, other.match.pixels)
    return common(mine, yours, one.match.pixels), yours


def regions(answer: Answer) -> Bool[Tensor, "h w"]:
    """What is denied and neither a speck nor open to what nobody confirms."""
    width = GAP + RING
    padded = (
        np.pad(mask.cpu().numpy().astype(np.uint8), width)
        for mask in (answer.denied, answer.match.framed, answer.confirmed)
    )
    denied, framed, confirmed = padded
    whole = cv2.morphologyEx(denied, cv2.MORPH_CLOSE, disc(GAP))
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
    """Those parts of `region` that fall, at `pixels`, on regions of the other photograph."""
    falls = sample(dilate(others, 2)[..., None].float(), pixels, "nearest")[..., 0] > 0
    labels = torch.from_numpy(labelled(region.cpu().numpy().astype(np.uint8))).to(region.device)
    found = torch.zeros_like(region)
    for part in (labels == label for label in range(1, int(labels.max()) + 1)):
        if int((part & falls).sum()) >= MIN_SHARED_REGION * int(part.sum()):
            found |= part
    return found


def outline_of(region: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The pixels around a region, but for those that touch it."""
    mask = region.astype(np.uint8)
    return (cv2.dilate(mask, disc(RING)) > 0) & (cv2.dilate(mask, disc(1)) == 0)


def labelled(mask: np.ndarray) -> Int[np.ndarray, "h w"]:
    """The number of the connected part that each pixel belongs to, from 1; 0 for none."""
    return cv2.connectedComponents(mask, connectivity=4)[1]


def disc(radius: int) -> np.ndarray:
    """A disc of that radius, to grow and shrink masks with."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def at_size(mask: Bool[Tensor, "small_h small_w"], camera: Camera) -> Bool[Tensor, "h w"]:
    """A small mask at the size of a camera's image."""
    size = camera.height, camera.width
    return interpolate(mask[None, None].float(), size)[0, 0] > 0
