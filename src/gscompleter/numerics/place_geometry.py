"""Placement of geometry from elsewhere in the frame of a scene, by what both show.

Where it stands it may fit already, be a little off, or be in a frame of its own. Whatever is found
is tested at pixels that were kept back from the fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.numerics.geometry import unproject
from gscompleter.numerics.given_geometry import (
    FRAME_ADVICE,
    MAX_DEVIATION,
    MIN_COMPARED,
    GeometryPlacement,
    GivenGeometry,
)
from gscompleter.numerics.surface_alignment import (
    SeenPoints,
    SurfacePoints,
    SurfaceSimilarity,
    align_surface,
    are_same_place,
    fit_closest_points,
    get_similarity_scale,
    make_seen_points,
    move_least_determined,
    sample_surface,
)
from gscompleter.system.errors import InputError
from gscompleter.types import Camera, DepthMap

MAX_COMPARED_VIEWS = 8
"""Most photographs, at even steps, at which places are compared."""
NUM_SEEN = 2000
"""About how many points of what they see are aligned."""
NUM_BLOCKS = 8
"""Blocks along the longer side of an image, of which every other one is kept back from the fit."""
MIN_GAIN = 2.0
"""Factor by which a small move has to lower the deviation of what fits already: a scan that is
right deviates by the errors of the scene's own depth, which a fit can only follow."""
MAX_PLACED_DEVIATION = 0.1
"""Largest deviation of depth, relative, that is no other surface: at the edges of surfaces a render
mixes the depth of two."""
MIN_PLACED = 0.85
"""Smallest share of the compared pixels that have to agree in a place that was found. With seven
free numbers more is asked than of what stands there: rooms of other shape reach 0.8."""
MIN_SEEN_SHARE = 0.25
"""Smallest share of what is seen that has to be compared there."""
MIN_LEAD = 0.03
"""Share of the compared pixels by which one place has to be better than another."""
LONG_MOVE = 0.4
"""Length of the move that tests whether anything determines a place, relative to the size of what
is seen. Places that are right then agree by a tenth less, those along a wall as before."""


@dataclass(frozen=True)
class SurfaceComparison:
    """Geometry against what a scene shows, at pixels that were kept back from the fit."""

    deviations: Float[Tensor, "n"]
    """Of its depth, as logarithms, where both have one."""
    num_seen: int
    """Pixels at which the scene has a depth."""

    @property
    def deviation(self) -> float:
        """Median deviation, relative; infinite if hardly anything is compared."""
        if len(self.deviations) < max(1, MIN_COMPARED * self.num_seen):
            return float("inf")
        return self.deviations.abs().median().expm1().item()

    @property
    def agreement(self) -> float:
        """Share of the compared pixels at which both may be the same surface."""
        agrees = self.deviations.abs().expm1() <= MAX_PLACED_DEVIATION
        return agrees.float().mean().item() if len(agrees) else 0.0

    @property
    def is_compared(self) -> bool:
        """True if enough of what is seen is compared to judge a place that was found."""
        return len(self.deviations) >= MIN_SEEN_SHARE * self.num_seen

    @property
    def is_placed(self) -> bool:
        """True if a place that was found is believed, provided that what is seen determines it."""
        return self.is_compared and self.agreement >= MIN_PLACED


@dataclass(frozen=True)
class SeenScene:
    """What some photographs show of a scene."""

    cameras: tuple[Camera, ...]
    surfaces: tuple[DepthMap, ...]

    @classmethod
    def make(cls, cameras: Sequence[Camera], surfaces: Sequence[DepthMap]) -> SeenScene:
        """Take photographs at even steps."""
        step = -(-len(cameras) // MAX_COMPARED_VIEWS)
        return cls(tuple(cameras[::step]), tuple(surfaces[::step]))

    def compare(self, geometry: GivenGeometry) -> SurfaceComparison:
        """Compare geometry with what is seen, where it was kept back."""
        deviations = []
        num_seen = 0
        for camera, surface in zip(self.cameras, self.surfaces, strict=True):
            seen = surface.valid & keep_back(camera).to(surface.valid.device)
            drawn = geometry.draw_depth(camera)
            both = seen & (drawn > 0)
            deviations.append((drawn[both] / surface.depth[both]).log().cpu())
            num_seen += int(seen.sum())
        return SurfaceComparison(torch.cat(deviations), num_seen)

    def choose_points(self) -> SeenPoints:
        """Choose points for the fit, at even steps of each image."""
        num_pixels = sum(camera.width * camera.height for camera in self.cameras)
        # Half of the pixels are kept back.
        step = max(1, math.ceil((num_pixels / 2 / NUM_SEEN) ** 0.5))
        points = []
        depths = []
        for camera, surface in zip(self.cameras, self.surfaces, strict=True):
            chosen = (surface.valid & ~keep_back(camera).to(surface.valid.device))[::step, ::step]
            points.append(unproject(surface.depth, camera)[::step, ::step][chosen].double().cpu())
            depths.append(surface.depth[::step, ::step][chosen].double().cpu())
        return make_seen_points(torch.cat(points).numpy(), torch.cat(depths).numpy())


def keep_back(camera: Camera) -> Bool[Tensor, "h w"]:
    """Return the blocks of an image that are kept back, like the black fields of a chessboard."""
    side = -(-max(camera.height, camera.width) // NUM_BLOCKS)
    rows, columns = (torch.arange(size) // side for size in (camera.height, camera.width))
    return (rows[:, None] + columns) % 2 == 1


def place_geometry(
    geometry: GivenGeometry, cameras: Sequence[Camera], surfaces: Sequence[DepthMap]
) -> GivenGeometry:
    """Move geometry to where photographs of a scene show the same; it may stand there already.

    `surfaces` are those of the scene at the cameras of the photographs, without the sky.
    Raises InputError if there is no such place, or if several are as good.
    """
    scene = SeenScene.make(cameras, surfaces)
    seen = scene.choose_points()
    # Fixed, so that the place does not change with the seed of the images.
    rng = np.random.default_rng(0)
    surface = sample_surface(geometry, rng)
    before = scene.compare(geometry)
    if before.deviation > MAX_DEVIATION:
        return search_place(geometry, scene, surface, seen, rng)

    similarity, _ = fit_closest_points(np.eye(4), surface, seen)
    after = scene.compare(geometry.transform(similarity))
    is_better = after.is_placed and MIN_GAIN * after.deviation <= before.deviation
    if is_better and is_determined(geometry, similarity, after, scene, surface, seen):
        return move_to(geometry, similarity, after)
    return geometry


def search_place(
    geometry: GivenGeometry,
    scene: SeenScene,
    surface: SurfacePoints,
    seen: SeenPoints,
    rng: np.random.Generator,
) -> GivenGeometry:
    """Move geometry, which is in a frame of its own, to the only place where it fits a scene."""
    places = align_surface(surface, seen, rng)
    compared = [scene.compare(geometry.transform(place)) for place in places]
    found = [number for number, each in enumerate(compared) if each.is_placed]
    if not found:
        share = max((each.agreement for each in compared), default=0.0)
        raise InputError(
            f"{geometry.name} is not what the scene shows, neither where it stands nor moved, "
            f"turned and scaled: in the best place {100 * share:.0f} % of the compared pixels show "
            f"the same surface, and {100 * MIN_PLACED:.0f} % have to; {FRAME_ADVICE}.",
            "geometry",
        )
    # Furniture tells which of several walls is the right one, and the median how well it fits.
    most = max(compared[number].agreement for number in found)
    alike = [number for number in found if compared[number].agreement > most - MIN_LEAD]
    best = min(alike, key=lambda number: compared[number].deviation)
    if not (
        all(are_same_place(places[best], places[i], surface, seen) for i in alike)
        and is_determined(geometry, places[best], compared[best], scene, surface, seen)
    ):
        raise InputError(
            f"{geometry.name} fits the scene in several places alike, as in a symmetric room, "
            f"along a single wall or in a corner; {FRAME_ADVICE}, or photographs that show "
            f"opposite walls and furniture.",
            "geometry",
        )
    return move_to(geometry, places[best], compared[best])


def is_determined(
    geometry: GivenGeometry,
    place: SurfaceSimilarity,
    compared: SurfaceComparison,
    scene: SeenScene,
    surface: SurfacePoints,
    seen: SeenPoints,
) -> bool:
    """Return True if geometry fits worse when the move that is least determined goes on.

    One wall does not tell where along it the geometry is, and no single corner how large.
    `compared` is the geometry at `place` itself.
    """
    others = [
        scene.compare(geometry.transform(moved))
        for moved in move_least_determined(place, surface, seen, LONG_MOVE)
    ]
    return not any(
        other.is_compared and other.agreement > compared.agreement - MIN_LEAD for other in others
    )


def move_to(
    geometry: GivenGeometry, similarity: SurfaceSimilarity, compared: SurfaceComparison
) -> GivenGeometry:
    """Move geometry by a similarity, and keep what is to be told about it."""
    moved = geometry.transform(similarity)
    scale = get_similarity_scale(similarity)
    cosine = (np.trace(similarity[:3, :3]) / scale - 1) / 2
    shift = np.median(moved.vertices, axis=0) - np.median(geometry.vertices, axis=0)
    placement = GeometryPlacement(
        geometry.name,
        scale,
        float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
        (float(shift[0]), float(shift[1]), float(shift[2])),
        compared.deviation,
        compared.agreement,
    )
    return replace(moved, placement=placement)
