"""What is up in a splat: what is known of it, or what its floor shows.

Cameras that are found stand upright, and their pictures decide whether the result is of use: from a
splat whose z axis is up, those that take -y for up look straight down.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.numerics.geometry import estimate_up
from gscompleter.render.protocols import Renderer
from gscompleter.splats.upward import USUAL, Direction, read_upward
from gscompleter.system.errors import InputError
from gscompleter.trust.lifted import QUANTILE_SAMPLE, measure_core
from gscompleter.types import Camera, Gaussians
from gscompleter.virtual_capture.kind import is_object

OTHERS: tuple[Direction, ...] = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
"""Up in other files: that of surveys and nerfstudio, and that of modelling programs."""
UNUSUAL_UP: tuple[Direction, ...] = ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0))
"""Directions that are up in no file. What looks like their floor is a wall or a ceiling."""
MIN_FLOOR_OPACITY = 0.2
"""Least opacity of a Gaussian that counts."""
OUTLIERS = 0.002
"""Share of the lowest, and of the highest, that does not count."""
SLAB = 0.02
"""Thickness of a layer, in radii of the core; two adjacent ones hold a floor."""
MAX_SHARE_BELOW = 0.1
"""Largest share of the splat below a floor."""
MIN_FLOOR_SHARE = 0.15
"""Least share of the splat in a floor. Shares are of area times opacity."""
FLOOR_CELLS = 8
"""Cells along each side of the extent, in which a floor is looked for."""
MIN_CELLS = 0.9
"""Least share of the cells that a floor fills; each with a tenth of the mean at least."""
MIN_ADVANTAGE = 1.3
"""Score of another floor, relative to that of the usual direction, from which it is preferred."""
MIN_SHARE_IN_PART = 0.1
"""Least share of the splat in a floor seen in part, as in a room taken from one side."""
MIN_CELLS_IN_PART = 0.5
"""Least share of the cells that it fills."""
MIN_ADVANTAGE_IN_PART = 3.0
"""Its score, relative to those of all five other directions along axes. It was 5.1 and 8.3 for two
trained splats of a room, and 2.2 for a ceiling that was taken for a floor."""
SNAP = 0.999
"""Cosine from which a direction counts as that of an axis."""


@dataclass(frozen=True)
class Upward:
    """The upward direction of a splat, and how it is known."""

    direction: Float[Tensor, "3"]
    """Unit vector in the axes of a 3DGS .ply."""
    source: str
    """Clause on where it is from; empty if the user named it."""

    def describe(self) -> list[str]:
        """Describe it in a line, unless the user named it."""
        if not self.source:
            return []
        name = name_direction(self.direction)
        return [f"Up is {name}, {self.source}; --up X Y Z says otherwise."]


def find_upward(
    path: Path,
    scene: Gaussians,
    renderer: Renderer,
    named: Direction | None = None,
    cameras: Sequence[Camera] = (),
) -> Upward:
    """Find what is up: as named, as the file says, as its cameras stand, or from its floor.

    `path` is the file of the splat, `cameras` are those that were found beside it.
    """
    make = scene.means.new_tensor
    if named is not None:
        return Upward(normalize(make(named), dim=0), "")
    stated = read_upward(path)
    if stated is not None:
        return Upward(make(stated), "as its file says")
    if cameras:
        return Upward(estimate_up(cameras).to(scene.means), "from its cameras")
    floor = find_floor(scene)
    # A table seen from below has a floor, too; but nothing says that it stands upside down.
    if floor is not None and (floor == USUAL or not is_object(scene, renderer)):
        return Upward(make(floor), "from the splat's floor")
    return Upward(make(USUAL), "as in most files, since neither the file nor a floor tells")


def require_direction(up: Direction) -> None:
    """Raise InputError for an upward direction that is none."""
    length = math.hypot(*up)
    if not 0 < length < math.inf:
        raise InputError("The upward direction is three numbers that are not all zero.", "up")


@dataclass(frozen=True)
class Floor:
    """The largest level layer of a splat with nearly nothing below."""

    share: float
    """Its share of the splat."""
    filled: float
    """Share of the cells of the extent that it fills."""
    score: float
    """Its share, times the share of the rest that stands in the lower half."""


def find_floor(scene: Gaussians) -> Direction | None:
    """Find the direction in which a floor is below nearly all of a splat; None without one.

    A floor is a layer that fills the extent. A wall is one, too, if its splat lies on its side:
    a floor is larger, and what stands in a room stands on it. So it scores by its share, times the
    share of the rest that is in the lower half. A floor that was seen in part does not fill the
    extent; it counts where no other direction comes near its score.
    """
    solid = scene[scene.opacities > MIN_FLOOR_OPACITY]
    if len(solid) < FLOOR_CELLS**2:
        return None
    floors = {up: measure_floor(solid, up) for up in (USUAL, *OTHERS, *UNUSUAL_UP)}
    scores = {up: floors[up].score for up in (USUAL, *OTHERS) if is_whole_floor(floors[up])}
    if scores:
        best = max(scores, key=lambda up: scores[up])
        is_better = scores[best] >= MIN_ADVANTAGE * scores.get(USUAL, 0.0)
        return best if is_better else USUAL

    best = max(floors, key=lambda up: floors[up].score)
    rest = max(floor.score for up, floor in floors.items() if up != best)
    is_clear = floors[best].score >= MIN_ADVANTAGE_IN_PART * rest
    is_seen = floors[best].share >= MIN_SHARE_IN_PART and floors[best].filled >= MIN_CELLS_IN_PART
    return best if best not in UNUSUAL_UP and is_clear and is_seen else None


def is_whole_floor(floor: Floor) -> bool:
    """Tell a floor that was seen as a whole."""
    return floor.share >= MIN_FLOOR_SHARE and floor.filled >= MIN_CELLS


def measure_floor(scene: Gaussians, up: Direction) -> Floor:
    """Measure the largest level layer of a splat with nearly nothing below."""
    heights = scene.means @ scene.means.new_tensor(up)
    middle_scale, largest_scale = scene.scales.sort(dim=1).values[:, 1:].unbind(1)
    weights = (middle_scale * largest_scale * scene.opacities).double()
    # A few huge Gaussians are sky or floaters.
    sample = weights[:: max(1, len(weights) // QUANTILE_SAMPLE)]
    weights = weights.clamp_max(sample.quantile(0.99))
    weights = weights / weights.sum()

    order = heights.argsort()
    places = torch.searchsorted(
        weights[order].cumsum(0), weights.new_tensor([OUTLIERS, 1 - OUTLIERS])
    )
    low, high = heights[order][places.clamp_max(len(heights) - 1)].tolist()
    thickness = SLAB * measure_core(scene.means).radius
    num_layers = max(FLOOR_CELLS, int((high - low) / thickness))
    step = max(high - low, 1e-12) / num_layers
    layers = ((heights - low) / step).long().clamp(0, num_layers - 1)
    shares = sum_by_index(weights, layers, num_layers)

    # The share of two adjacent layers, of those with nearly nothing below.
    below = shares.cumsum(0) - shares
    pairs = (shares[:-1] + shares[1:]).where(below[:-1] <= MAX_SHARE_BELOW, 0.0)
    lowest = int(pairs.argmax())
    share = pairs[lowest].item()
    is_floor = (layers == lowest) | (layers == lowest + 1)
    rest = weights.where(~is_floor, 0.0)
    is_low = heights < (low + high) / 2
    score = share * (rest[is_low].sum() / rest.sum().clamp_min(1e-12)).item()
    return Floor(share, measure_filled(scene, weights, is_floor, up), score)


def measure_filled(
    scene: Gaussians, weights: Float[Tensor, "n"], is_floor: Tensor, up: Direction
) -> float:
    """Measure the share of the cells of the extent, seen from above, that a floor fills."""
    level = [axis for axis in range(3) if up[axis] == 0]
    points = scene.means[:, level]
    sample = points[:: max(1, len(points) // QUANTILE_SAMPLE)]
    low, high = sample.quantile(points.new_tensor([0.02, 0.98]), dim=0)
    cells = ((points - low) / (high - low).clamp_min(1e-12) * FLOOR_CELLS).floor().long()
    inside = is_floor & ((cells >= 0) & (cells < FLOOR_CELLS)).all(dim=1)
    numbers = (FLOOR_CELLS * cells[:, 0] + cells[:, 1])[inside]
    if not len(numbers):
        return 0.0
    sums = sum_by_index(weights[inside], numbers, FLOOR_CELLS**2)
    return (sums > 0.1 * sums.mean()).float().mean().item()


def sum_by_index(
    values: Float[Tensor, "n"], index: Int64[Tensor, "n"], count: int
) -> Float[Tensor, "m"]:
    """Sum values by their index, from 0 to `count` - 1."""
    return torch.bincount(index, values, minlength=count)


def estimate_axis_up(cameras: Sequence[Camera]) -> Float[Tensor, "3"]:
    """Estimate what is up for upright cameras: exactly an axis, if it is nearly one.

    So cameras that were found, written and read again have the same direction.
    """
    direction = estimate_up(cameras)
    axis = int(direction.abs().argmax())
    if direction[axis].abs() < SNAP:
        return direction
    along = torch.zeros_like(direction)
    along[axis] = direction[axis].sign()
    return along


def name_direction(direction: Float[Tensor, "3"]) -> str:
    """Name a direction by its axis, such as +z, or by its three numbers."""
    axis = int(direction.abs().argmax())
    if direction[axis].abs() >= SNAP:
        return ("+" if direction[axis] > 0 else "-") + "xyz"[axis]
    return " ".join(f"{value:.2f}" for value in direction.tolist())
