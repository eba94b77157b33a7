"""Detection of the vehicle that carries the camera, such as its bonnet, in photographs.

The vehicle does not move in the image, and a road hardly changes either. The difference is the
outline: it stays in place although it crosses the direction in which the ground moves.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from gscompleter.data.cameras import Pinhole, find_pose_defect
from gscompleter.data.frame import Frame
from gscompleter.data.photograph import StoredPhotograph
from gscompleter.system.errors import InputError
from gscompleter.system.files.image import read_brightness, turn_upright

FEWEST = 6
"""Fewest photographs of a camera that are searched; with fewer, nothing is found."""
MOST = 12
"""Most photographs of a camera that are searched."""
COPY_SIDE = 256
"""Longer side of the small copies, in pixels."""
MAX_TURN = 25.0
"""Largest deviation of the travel direction and the down axis from their means, in degrees."""
MIN_STEADY_SHARE = 0.8
"""Smallest share of the photographs within `MAX_TURN`."""
MIN_GRADIENT = 2.5
"""Smallest brightness gradient of an edge, in 256ths per pixel."""
MIN_STATIC_SHARE = 0.7
"""Smallest share of the photographs in which a static edge has the same direction."""
MIN_CROSSING = 0.4
"""Smallest cosine between an edge normal and the ground's motion that would move the edge."""
HORIZON = 0.1
"""First row of the ground below the vanishing point, as a share of the image height."""
STRICT = 0.55
"""Cost per column of an outline, to detect a vehicle."""
LENIENT = 0.4
"""Cost per column of an outline, to follow a faint one."""
MAX_ROW_STEP = 4
"""Largest change of the outline from one column to the next, in rows."""
BEND_COST = 0.1
"""Cost of each such row, relative to an edge that is static in every photograph."""
MIN_EDGE_SHARE = 0.25
"""Smallest share of the columns with a static edge that moving ground would have moved."""
MIN_SUPPORT = 0.6
"""Smallest static share of the length of an outline."""
MIN_VEHICLE_AREA = 0.01
"""Smallest share of the image that a vehicle covers."""
MAX_AREA = 0.5
"""Largest share of the image that a vehicle covers."""
MAX_STATIC_ELSEWHERE = 0.3
"""Largest static share of the edges elsewhere; above it the camera hardly moves."""
OUTLINE_CLEARANCE = 4
"""Rows between two outlines, and between an outline and other edges, in small copies."""
MAX_DIP_WIDTH = 0.12
"""Largest width of a dip of the outline that is filled, as a share of the columns."""
OUTLINE_MARGIN = 1
"""Rows added above the outline, in pixels of the small copies."""


def attach_vehicle_detector(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """Attach a lazy vehicle detector to each frame; those of one camera share it.

    The order of the frames is taken for that of time, as it is in a drive. In any other order the
    steps between them have no steady direction, and nothing is found.
    """
    cameras: dict[Hashable, list[Frame]] = {}
    for frame in frames:
        cameras.setdefault((frame.sensor, frame.intrinsics), []).append(frame)
    seen = {camera: partial(detect_vehicle, tuple(group)) for camera, group in cameras.items()}
    return tuple(replace(f, vehicle=seen[f.sensor, f.intrinsics]) for f in frames)


@lru_cache(maxsize=64)
def detect_vehicle(frames: tuple[Frame, ...]) -> Bool[np.ndarray, "h w"] | None:
    """Mask the vehicle in a small copy of the photographs of one of its cameras, if it is seen.

    `frames` are all of that camera in the order of time. None if no vehicle is found, whatever the
    reason: damaged photographs are passed over.
    """
    usable = [f for f in frames if find_pose_defect(f.c2w) is None and f.has_photograph()]
    if len(usable) < FEWEST:
        return None
    poses = np.stack([frame.c2w for frame in usable])
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    motion = estimate_motion(poses, steps)

    # Photographs at equal distances along the way, because those taken while the vehicle waits are
    # all alike, and everything in them is static.
    way = np.concatenate([[0.0], np.cumsum(steps)])
    evenly = np.searchsorted(way, np.linspace(0, way[-1], MOST)).tolist()
    chosen = [usable[index] for index in dict.fromkeys(evenly)]
    small = {} if motion is None else read_small(chosen)
    if motion is None or len(small) < FEWEST:
        return None

    first = next(iter(small))
    images = np.stack(list(small.values()))
    size = first.size()
    # The small copy of a strip is one pixel wide, which has no gradient.
    if first.find_defect(*size) is not None or min(images.shape[1:]) < 2:
        return None
    pinhole = first.intrinsics.compute_pinhole(*size)
    return find_static_region(images, *predict_ground_flow(motion, pinhole, images.shape[1:]))


def read_small(frames: Sequence[Frame]) -> dict[Frame, Float[np.ndarray, "h w"]]:
    """Read small copies of the photographs that have the size of the first readable one."""
    copies: dict[Frame, Float[np.ndarray, "h w"]] = {}
    for frame in frames:
        with suppress(InputError):
            photograph = frame.require_photograph()
            # No vehicle carries the camera of a render.
            if isinstance(photograph, StoredPhotograph):
                small = read_brightness(photograph.stored, COPY_SIDE)
                copies[frame] = turn_upright(small, frame.find_turn())
    shape = next((image.shape for image in copies.values()), None)
    return {frame: image for frame, image in copies.items() if image.shape == shape}


def estimate_motion(
    poses: Float[np.ndarray, "n 4 4"], steps: Float[np.ndarray, "n-1"]
) -> Float[np.ndarray, "3"] | None:
    """Estimate the travel direction in camera axes; None if it varies or the camera tilts.

    `poses` are camera-to-world in time order, `steps` the distances between them in scene units.
    """
    if (steps > 0).sum() < FEWEST - 1:
        return None
    # Steps of a waiting vehicle have the direction of their noise.
    moving = steps > 0.1 * np.median(steps[steps > 0])
    # From world axes into those of each camera: R^T times the step.
    moves = np.einsum("nji,nj->ni", poses[:-1, :3, :3], np.diff(poses[:, :3, 3], axis=0))
    travel = average_directions(moves[moving])
    # A camera that rolls or is carried by hand would turn the down axis, and is no vehicle's.
    down = average_directions(poses[:, :3, 1])
    return None if travel is None or down is None else travel


def average_directions(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"] | None:
    """Average directions; None if they are not steady."""
    units = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    # The median of unit vectors ignores a few outliers, and is shorter than 1 where they disagree.
    mean = np.median(units, axis=0)
    length = np.linalg.norm(mean)
    near = units @ mean >= length * np.cos(np.radians(MAX_TURN))
    return mean / length if length > 0 and near.mean() >= MIN_STEADY_SHARE else None


def predict_ground_flow(
    motion: Float[np.ndarray, "3"], pinhole: Pinhole, shape: tuple[int, ...]
) -> tuple[Float[np.ndarray, "h w 2"], int]:
    """Predict the image motion of the static scene (unit x, y) and the first row of near ground.

    `motion` is the travel direction in camera axes, `shape` the height and width of the small
    copies. Lens distortion, which turns these directions slightly, is ignored.
    """
    height, width = shape
    small = pinhole.resize(width, height)
    y, x = np.mgrid[:height, :width] + 0.5
    # Points of a static scene move away from the vanishing point of the motion, at every depth in
    # the same direction: with motion (X, Y, Z), pixel x moves by (x - cx) Z - f X over the depth.
    right = (x - small.cx) * motion[2] - small.fl_x * motion[0]
    down = (y - small.cy) * motion[2] - small.fl_y * motion[1]
    flow = np.stack([right, down], axis=-1)
    flow /= np.maximum(np.linalg.norm(flow, axis=-1, keepdims=True), 1e-9)
    # The horizon is at the height of the vanishing point of a level motion. A camera that looks
    # sideways has none within the image, and is taken to be level.
    pitch = motion[1] / motion[2] if abs(motion[2]) > 0.5 else 0.0
    first = small.cy + small.fl_y * pitch + HORIZON * height
    return flow, int(np.clip(first, 0, height))


@dataclass(frozen=True)
class Edges:
    """Edge statistics of the photographs of one camera, per pixel."""

    edge_share: Float[np.ndarray, "h w"]
    """Share of the photographs with an edge there."""
    static_share: Float[np.ndarray, "h w"]
    """Share of the photographs with an edge of the same direction there."""
    crossing: Float[np.ndarray, "h w"]
    """Cosine between the normal of the static edge and the motion of the ground."""


def find_static_region(
    images: Float[np.ndarray, "n h w"], flow: Float[np.ndarray, "h w 2"], first: int
) -> Bool[np.ndarray, "h w"] | None:
    """Find the static region at the lower image border; None if there is none.

    Of several static outlines, such as those of the bonnet and the wipers, the highest counts.
    `images` are brightness in [0, 255], `flow` is from `predict_ground_flow`, and `first` is the
    highest row that the region may reach.
    """
    edges = find_edges(images, flow)
    height, width = images.shape[1:]
    # Row of the outline in each column; `height`, the lower border, where there is no vehicle.
    highest = np.full(width, height)
    limit = np.full(width, height)
    while True:
        outline = trace_vehicle_outline(edges, first, limit, STRICT)
        if not is_vehicle(edges, outline):
            break
        # Once a vehicle is certain, its outline may be followed where it is faint.
        top = max(first, int(outline.min()) - OUTLINE_CLEARANCE)
        fainter = trace_vehicle_outline(edges, top, limit, LENIENT)
        highest = np.minimum(highest, np.minimum(outline, fainter))
        # The next outline has to lie above this one where it is rewarded, so that the loop ends.
        limit = np.where(highest < height, highest - OUTLINE_CLEARANCE, height)
    if (highest == height).all():
        return None

    # A dip is a place where the outline fell to a lower edge. Rows count downwards, so that an
    # opening by a flat element removes narrow peaks of the row number.
    dips = np.ones((1, math.ceil(MAX_DIP_WIDTH * width)), np.uint8)
    rows = np.pad(highest, width // 2, mode="edge").astype(np.float32)[None]
    opened = cv2.morphologyEx(rows, cv2.MORPH_OPEN, dips)[0]
    filled = opened[width // 2 :][:width].astype(np.int64)
    return fill_below(np.where(filled < height, filled - OUTLINE_MARGIN, height), height)


def find_edges(images: Float[np.ndarray, "n h w"], flow: Float[np.ndarray, "h w 2"]) -> Edges:
    """Find edges and how static they are."""
    smooth = [cv2.GaussianBlur(image, (0, 0), 1.0) for image in images]
    # x and y of the gradient: `np.gradient` gives the rows first.
    gradients = np.stack([np.stack(np.gradient(image)[::-1], axis=-1) for image in smooth])
    # The median over the photographs keeps the edges that all of them share.
    normal = np.median(gradients, axis=0)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    # A static edge has the same gradient along that normal in each photograph.
    along = (gradients * normal).sum(axis=-1)
    return Edges(
        (np.linalg.norm(gradients, axis=-1) > MIN_GRADIENT).mean(axis=0),
        (along > MIN_GRADIENT).mean(axis=0),
        np.abs((normal * flow).sum(axis=-1)),
    )


def trace_vehicle_outline(
    edges: Edges, first: int, limit: Int[np.ndarray, "w"], cost: float
) -> Int[np.ndarray, "w"]:
    """Trace the outline along the most static edges by dynamic programming over columns.

    It stays below row `first` and above row `limit` of each column. `cost` per column is relative
    to an edge that is static in every photograph; the lower image border has neither cost nor
    reward.
    """
    height, width = edges.static_share.shape
    rows = np.arange(height + 1)
    # Edges along the motion of the ground stay in place anyway, and count half.
    reward = edges.static_share * (0.5 + 0.5 * edges.crossing) - cost
    reward = np.where((rows[:-1, None] >= first) & (rows[:-1, None] < limit), reward, -1.0)
    reward = np.concatenate([reward, np.zeros((1, width))])  # lower border: no vehicle

    # Viterbi's algorithm: `total` is the best sum of rewards of a path that ends in each row, and
    # `came` the row of that path in the column before.
    steps = np.abs(rows[:, None] - rows)
    bends = np.where(steps <= MAX_ROW_STEP, BEND_COST * steps, np.inf)
    total = reward[:, 0]
    came = []
    for column in range(1, width):
        reached = total - bends
        came.append(reached.argmax(axis=1))
        total = reached.max(axis=1) + reward[:, column]
    # The best path, followed back from the last column.
    outline = [int(total.argmax())]
    for before in reversed(came):
        outline.append(int(before[outline[-1]]))
    return np.array(outline[::-1])


def is_vehicle(edges: Edges, outline: Int[np.ndarray, "w"]) -> bool:
    """Decide whether the region below an outline moves with the camera."""
    height, width = edges.static_share.shape
    inside = fill_below(outline, height)
    if not MIN_VEHICLE_AREA <= inside.mean() <= MAX_AREA:
        return False

    # Most of the outline has to be static, and enough of it where moving ground would have moved
    # an edge: that is what a vehicle alone does.
    columns = np.nonzero(outline < height)[0]
    rows = outline[columns]
    kept = edges.static_share >= MIN_STATIC_SHARE
    across = kept & (edges.crossing >= MIN_CROSSING)
    near = np.ones((3, 1), np.uint8)  # a row above and one below
    staying = cv2.dilate(kept.astype(np.uint8), near)[rows, columns] > 0
    staying_across = cv2.dilate(across.astype(np.uint8), near)[rows, columns] > 0
    if staying.mean() < MIN_SUPPORT or staying_across.sum() < MIN_EDGE_SHARE * width:
        return False

    # If most other edges are static too, the camera hardly moved, and the outline says nothing.
    elsewhere = ~fill_below(outline - OUTLINE_CLEARANCE, height)
    occurring = np.where(elsewhere, edges.edge_share, 0)
    return bool(occurring[kept].sum() <= MAX_STATIC_ELSEWHERE * occurring.sum())


def fill_below(outline: Int[np.ndarray, "w"], height: int) -> Bool[np.ndarray, "h w"]:
    """Fill the region from each column's outline row downward."""
    return np.arange(height)[:, None] >= outline
