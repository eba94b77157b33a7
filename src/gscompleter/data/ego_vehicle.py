"""Pixels that show the vehicle that carries the camera, such as its bonnet.

They stay where they are in the image while the camera moves, so that stereo finds them at infinity.
What tells them from a road, which hardly changes either, is their outline: it lies across the
direction in which everything fixed to the ground moves through the image, and it stays.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.lib.stride_tricks import sliding_window_view

from gscompleter.data.frame import Frame
from gscompleter.data.lens import Pinhole
from gscompleter.data.poses import pose_defect
from gscompleter.errors import InputError

FEWEST, MOST = 6, 12
"""Photographs of a camera that a vehicle is searched in: none is found in fewer."""
SIDE, MIN_SIDE = 256, 16
"""Longer side of the small copies of them, and the least of the shorter, in pixels."""
MAX_TURN = 25.0
"""Degrees by which the direction of travel and the downward axis of a camera on a vehicle may be
off their means."""
STEADY = 0.8
"""Smallest share of the photographs in which they are not."""
MIN_GRADIENT = 2.5
"""Change of brightness, in 256ths a pixel, from which there is an edge."""
PERSISTENT = 0.7
"""Smallest share of the photographs in which an edge that stays has the same direction."""
ACROSS = 0.4
"""Smallest cosine between the normal of an edge and the motion of the ground through the image at
which the ground would have moved the edge away."""
HORIZON = 0.1
"""First row of the ground, below the vanishing point, as a share of the image's height."""
STRICT, LENIENT = 0.55, 0.4
"""Cost of a column of an outline: to decide whether there is a vehicle, and to follow its outline
where that is faint."""
STEEPEST = 4
"""Rows by which an outline rises or falls at most from a column to the next."""
BEND_COST = 0.1
"""Cost of each of these rows, against an edge that stays in every photograph."""
MIN_WIDTH = 0.25
"""Smallest share of the columns in which the outline stays although the ground would move it."""
MIN_SUPPORT = 0.6
"""Smallest share of the length of an outline that stays."""
MIN_AREA, MAX_AREA = 0.01, 0.5
"""Smallest and largest share of an image that a vehicle fills."""
MAX_STAYING = 0.3
"""Largest share of the edges elsewhere that stay: of more the camera hardly moves."""
CLEAR = 4
"""Rows between two outlines, and from one to what else is looked at, in pixels of small copies."""
DENT = 0.12
"""Share of the columns over which an outline falls at most where it was lost in between."""
MARGIN = 1
"""Rows by which an outline is raised, in pixels of the small copies."""


@dataclass(frozen=True, eq=False)
class EgoVehicle:
    """Finds the vehicle in the photographs of one of its cameras, once it is asked for."""

    frames: tuple[Frame, ...]
    """Those of the camera, in their order."""

    def __call__(self) -> Bool[np.ndarray, "h w"] | None:
        """True on the vehicle, in a small copy of the photograph as it is stored; None where there
        is none."""
        return self._mask

    @cached_property
    def _mask(self) -> Bool[np.ndarray, "h w"] | None:
        chosen, motion = select_frames(self.frames)
        if motion is None:
            return None
        small = read_small(chosen)
        if len(small) < FEWEST or min(small[0][1].shape) < MIN_SIDE:
            return None
        size = small[0][0].size()
        if small[0][0].defect(*size) is not None:
            return None
        images = np.stack([image for _, image in small])
        flow, first = ground_flow(motion, small[0][0].intrinsics.at(*size), images.shape[1:])
        return find_static_region(images, flow, first)


def read_small(frames: Sequence[Frame]) -> list[tuple[Frame, Float[np.ndarray, "h w"]]]:
    """Read small copies of photographs; none of those that cannot be read, or are of another size
    than most are."""
    found = []
    for frame in frames:
        with suppress(InputError):
            found.append((frame, frame.small_pixels(SIDE)))
    sizes = [image.shape for _, image in found]
    usual = max(dict.fromkeys(sizes), key=sizes.count, default=None)
    return [(frame, image) for frame, image in found if image.shape == usual]


def looking_for_vehicle(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """Let frames find the vehicle that carries their camera, where there is one. Nothing is read
    before they are asked for it."""
    cameras: dict[Hashable, list[Frame]] = {}
    for frame in frames:
        cameras.setdefault((frame.sensor, frame.intrinsics), []).append(frame)
    seen = {camera: EgoVehicle(tuple(group)) for camera, group in cameras.items()}
    return tuple(replace(f, vehicle=seen[f.sensor, f.intrinsics]) for f in frames)


def select_frames(
    frames: Sequence[Frame],
) -> tuple[list[Frame], Float[np.ndarray, "3"] | None]:
    """Select photographs at equal distances along the way of a camera on a vehicle, and measure the
    direction of travel in the axes of the camera; None where it does not travel as on a vehicle."""
    usable = [f for f in frames if pose_defect(f.c2w) is None and f.has_photograph()]
    if len(usable) < FEWEST:
        return [], None
    poses = np.stack([frame.c2w for frame in usable])
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    motion = steady_motion(poses, steps)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    places = np.searchsorted(way, np.linspace(0, way[-1], MOST))
    chosen = [usable[index] for index in dict.fromkeys(places.tolist())]
    return chosen, None if len(chosen) < FEWEST else motion


def steady_motion(
    poses: Float[np.ndarray, "n 4 4"], steps: Float[np.ndarray, "n-1"]
) -> Float[np.ndarray, "3"] | None:
    """Measure the direction of travel in the axes of a camera; None where it is not the same all
    the time, or the camera tilts.

    Args:
        poses: Camera-to-world, in the order of time.
        steps: Distances from each to the next, in scene units.
    """
    if (steps > 0).sum() < FEWEST - 1:
        return None
    moving = steps > 0.1 * np.median(steps[steps > 0])
    moves = np.einsum("nji,nj->ni", poses[:-1, :3, :3], np.diff(poses[:, :3, 3], axis=0))
    travel, down = mean_direction(moves[moving]), mean_direction(poses[:, :3, 1])
    return None if travel is None or down is None else travel


def mean_direction(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"] | None:
    """Average directions; None where they are not steady."""
    units = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    mean = np.median(units, axis=0)
    length = np.linalg.norm(mean)
    near = units @ mean >= length * np.cos(np.radians(MAX_TURN))
    return mean / length if length > 0 and near.mean() >= STEADY else None


def ground_flow(
    motion: Float[np.ndarray, "3"], pinhole: Pinhole, shape: tuple[int, ...]
) -> tuple[Float[np.ndarray, "h w 2"], int]:
    """Predict in which direction (x, y) what stands still moves through the image, as unit vectors,
    and from which row downward it is ground that is near.

    Lens distortion, which turns these directions a little, is left out.

    Args:
        motion: Direction of travel in the axes of the camera.
        pinhole: The camera.
        shape: Height and width of the small copies.
    """
    height, width = shape
    small = pinhole.resized(width, height)
    y, x = np.mgrid[:height, :width] + 0.5
    right = (x - small.cx) * motion[2] - small.fl_x * motion[0]
    down = (y - small.cy) * motion[2] - small.fl_y * motion[1]
    flow = np.stack([right, down], axis=-1)
    flow /= np.maximum(np.linalg.norm(flow, axis=-1, keepdims=True), 1e-9)
    pitch = motion[1] / motion[2] if abs(motion[2]) > 0.5 else 0.0
    first = small.cy + small.fl_y * pitch + HORIZON * height
    return flow, int(np.clip(first, 0, height))


@dataclass(frozen=True)
class Edges:
    """Edges of photographs of one camera, pixel by pixel."""

    occurring: Float[np.ndarray, "h w"]
    """Share of the photographs that have an edge there."""
    staying: Float[np.ndarray, "h w"]
    """Share of them that have an edge there of the same direction."""
    across: Float[np.ndarray, "h w"]
    """Cosine between the normal of what stays and the motion of the ground."""


def find_static_region(
    images: Float[np.ndarray, "n h w"], flow: Float[np.ndarray, "h w 2"], first: int
) -> Bool[np.ndarray, "h w"] | None:
    """Find the region at the lower edge that stays the same; None where there is none.

    Of several outlines that stay, such as those of a bonnet and of wipers before it, the highest
    counts.

    Args:
        images: Brightness, from 0 to 255, of photographs of one camera at distant places.
        flow: As `ground_flow` has it.
        first: Highest row that the region may reach.
    """
    edges, (height, width) = find_edges(images, flow), images.shape[1:]
    found, limit = np.full(width, height), np.full(width, height)
    while is_vehicle(edges, outline := trace_outline(edges, first, limit, STRICT)):
        top = max(first, int(outline.min()) - CLEAR)
        fainter = trace_outline(edges, top, limit, LENIENT)
        found = np.minimum(found, np.minimum(outline, fainter))
        limit = np.where(found < height, found - CLEAR, height)
    if (found == height).all():
        return None
    filled = without_dents(found)
    return below(np.where(filled < height, filled - MARGIN, height), height)


def without_dents(outline: Int[np.ndarray, "w"]) -> Int[np.ndarray, "w"]:
    """Raise an outline where it falls for a few columns and rises again."""
    window = np.ones((1, math.ceil(DENT * len(outline))), np.uint8)
    rows = np.pad(outline, len(outline) // 2, mode="edge").astype(np.float32)[None]
    filled = cv2.morphologyEx(rows, cv2.MORPH_OPEN, window)[0]
    return filled[len(outline) // 2 :][: len(outline)].astype(np.int64)


def find_edges(images: Float[np.ndarray, "n h w"], flow: Float[np.ndarray, "h w 2"]) -> Edges:
    """Find edges, and which of them stay where they are."""
    smooth = [cv2.GaussianBlur(image, (0, 0), 1.0) for image in images]
    gradients = np.stack([np.stack(np.gradient(image)[::-1], axis=-1) for image in smooth])
    normal = np.median(gradients, axis=0)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    along = (gradients * normal).sum(axis=-1)
    return Edges(
        (np.linalg.norm(gradients, axis=-1) > MIN_GRADIENT).mean(axis=0),
        (along > MIN_GRADIENT).mean(axis=0),
        np.abs((normal * flow).sum(axis=-1)),
    )


def trace_outline(
    edges: Edges, first: int, limit: Int[np.ndarray, "w"], cost: float
) -> Int[np.ndarray, "w"]:
    """Trace the outline that follows best what stays, column by column, by dynamic programming.

    Args:
        edges: What stays.
        first: Highest row that it may reach.
        limit: Row of each column above which it has to stay; the image's height where there is
            none.
        cost: Of each column, against the reward for an edge that stays in every photograph. Where
            the outline runs along the lower edge, there is neither.
    """
    height, width = edges.staying.shape
    rows = np.arange(height)[:, None]
    reward = edges.staying * (0.5 + 0.5 * edges.across) - cost
    reward = np.where((rows >= first) & (rows < limit), reward, -1.0)
    reward = np.concatenate([reward, np.zeros((1, width))])  # the lower edge: no vehicle there
    bends = np.array([0, *range(-STEEPEST, 0), *range(1, STEEPEST + 1)])  # of equals the first one
    total, came = reward[:, 0], np.zeros((height + 1, width), np.int64)
    for column in range(1, width):
        padded = np.pad(total, STEEPEST, constant_values=-np.inf)
        reached = sliding_window_view(padded, height + 1)[STEEPEST + bends]
        reached = reached - BEND_COST * np.abs(bends)[:, None]
        came[:, column] = np.arange(height + 1) + bends[reached.argmax(axis=0)]
        total = reached.max(axis=0) + reward[:, column]
    outline = np.empty(width, np.int64)
    outline[-1] = total.argmax()
    for column in range(width - 1, 0, -1):
        outline[column - 1] = came[outline[column], column]
    return outline


def is_vehicle(edges: Edges, outline: Int[np.ndarray, "w"]) -> bool:
    """Decide whether what lies below an outline is carried along with the camera."""
    height, width = edges.staying.shape
    inside = below(outline, height)
    if not MIN_AREA <= inside.mean() <= MAX_AREA:
        return False
    columns = np.nonzero(outline < height)[0]
    rows = outline[columns]
    kept = edges.staying >= PERSISTENT
    across = kept & (edges.across >= ACROSS)
    staying, staying_across = (near_rows(mask)[rows, columns] for mask in (kept, across))
    if staying.mean() < MIN_SUPPORT or staying_across.sum() < MIN_WIDTH * width:
        return False
    elsewhere = ~below(outline - CLEAR, height)
    occurring = np.where(elsewhere, edges.occurring, 0)
    return bool(occurring[kept].sum() <= MAX_STAYING * occurring.sum())


def near_rows(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Grow a mask by a row upward and downward."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((3, 1), np.uint8)) > 0


def below(outline: Int[np.ndarray, "w"], height: int) -> Bool[np.ndarray, "h w"]:
    """True from the row of an outline downward."""
    return np.arange(height)[:, None] >= outline
