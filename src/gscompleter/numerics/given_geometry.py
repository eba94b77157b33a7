"""Geometry from elsewhere, such as a scan or a mesh, and its depth at a camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from gscompleter.numerics.geometry import compute_z_depths, look_up
from gscompleter.numerics.kernels import surface_depth as kernels
from gscompleter.system.errors import InputError
from gscompleter.types import Camera, Gaussians, View

NUM_PLANE_POINTS = 8
"""Neighbours of a point that tell the plane of its surface: in a grid, those all around."""
SPACING_NEIGHBOUR = 4
"""The neighbour whose distance is the spacing: in a grid, the last of those beside a point."""
HALF_SIDE = 0.75
"""Half the side of the square in place of a point, relative to the spacing: squares that are turned
in their plane at random still touch (√2/2)."""
MAX_SPACING = 2.0
"""Largest spacing relative to the median of the neighbours, so that a stray point stays small."""
MAX_POINTS = 4_000_000
"""Most points that are kept; a denser cloud tells no more at the size of an image."""
MAX_DEVIATION = 0.05
"""Largest deviation of depth, relative, that still counts as the same surface."""
MIN_COMPARED = 0.001
"""Smallest share of the photographs' pixels that has to be compared."""
FRAME_ADVICE = "give it in the frame and unit of the scene"
"""Advice on geometry that is not what the scene shows, as a clause of a sentence."""


@dataclass(frozen=True)
class GeometryPlacement:
    """How geometry was moved from its own frame to that of a scene, and how well it fits there."""

    name: str
    """Name of the geometry for sentences."""
    scale: float
    """Factor of its lengths."""
    degrees: float
    """Angle of its turn."""
    shift: tuple[float, float, float]
    """Move of the middle of its vertices, in scene units."""
    deviation: float
    """Median deviation of its depth from what the scene shows, relative, after the move."""
    agreement: float
    """Share of the compared pixels at which both are the same surface."""

    def describe(self) -> str:
        """Write the sentence for people."""
        length = float(np.linalg.norm(self.shift))
        return (
            f"{self.name} was moved to where the scene shows the same: scaled by {self.scale:.4g}, "
            f"turned by {self.degrees:.1f}°, shifted by {length:.3g}; its depth then differs by "
            f"{100 * self.deviation:.1f} % (median)."
        )


@dataclass(frozen=True)
class GivenGeometry:
    """Triangles of a mesh, or of squares in place of points, in the frame of a scene."""

    vertices: Float[np.ndarray, "n 3"]
    """float64, in scene units."""
    faces: Int[np.ndarray, "m 3"]
    """Indices of the corners of each triangle."""
    name: str = "geometry"
    """Name for sentences, such as that of its file."""
    placement: GeometryPlacement | None = None
    """How it was moved to the scene; None if it stands as it was given."""

    def __post_init__(self) -> None:
        """Raise InputError for values that are no triangles."""
        for values, kind in ((self.vertices, "f"), (self.faces, "i")):
            if not isinstance(values, np.ndarray) or values.dtype.kind != kind:
                raise InputError(
                    "Geometry has float vertices [n, 3] and integer faces [m, 3] as NumPy arrays; "
                    "gsc.load_geometry reads them from a file."
                )
            if values.ndim != 2 or values.shape[1] != 3:
                raise InputError(
                    f"Vertices and faces of a geometry have three columns, and here the shape "
                    f"{list(values.shape)}."
                )
        if len(self.faces) == 0:
            raise InputError(f"{self.name} holds neither triangles nor points.")
        if not np.isfinite(self.vertices).all():
            raise InputError(f"{self.name} has vertices that are not finite; export it again.")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise InputError(
                f"{self.name} has triangles of vertices that are not there; export it again."
            )

    def move(self, shift: Float[np.ndarray, "3"]) -> GivenGeometry:
        """Return the geometry shifted by a vector in scene units."""
        return replace(self, vertices=self.vertices + shift)

    def transform(self, similarity: Float[np.ndarray, "4 4"]) -> GivenGeometry:
        """Return the geometry moved by a similarity, without a placement."""
        moved = move_points(similarity, self.vertices)
        return replace(self, vertices=moved, placement=None)

    def draw_depth(self, camera: Camera) -> Float[Tensor, "h w"]:
        """Draw its z-depth at the pixels of a camera, in scene units; 0 where there is none."""
        known = camera.on_cpu
        rotation = known.c2w[:3, :3].double().numpy()
        in_camera = (self.vertices - known.center.double().numpy()) @ rotation
        corners = np.ascontiguousarray(in_camera @ known.K.double().numpy().T)
        depth = kernels.draw_depth(corners, self.faces, camera.width, camera.height)
        return torch.from_numpy(depth).to(camera.K)


def make_geometry(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], name: str
) -> GivenGeometry:
    """Make a geometry of a mesh, or of points if there are no faces."""
    vertices = np.asarray(vertices, np.float64)
    if len(faces) == 0:
        vertices, faces = replace_points(vertices[np.isfinite(vertices).all(axis=1)])
    return GivenGeometry(vertices, np.ascontiguousarray(faces, np.int64), name)


def replace_points(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "k 3"], Int[np.ndarray, "m 3"]]:
    """Replace points by squares of their spacing in the planes of their neighbours.

    Returns the corners of the squares, four in a row, and two triangles for each.
    """
    # Imported here, since nothing else of a completion needs it, and it takes long.
    from scipy.spatial import cKDTree

    step = -(-len(points) // MAX_POINTS) if len(points) else 1
    points = points[::step]
    if len(points) <= NUM_PLANE_POINTS:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    distances, neighbours = cKDTree(points).query(points, NUM_PLANE_POINTS + 1)
    spacing = distances[:, SPACING_NEIGHBOUR]
    spacing = np.minimum(spacing, MAX_SPACING * np.median(spacing[neighbours[:, 1:]], axis=1))

    axes = fit_planes(points, neighbours)
    along, across = (HALF_SIDE * spacing[:, None] * axes[:, :, i] for i in (1, 2))
    corners = points[:, None] + np.stack(
        [-along - across, along - across, along + across, across - along], axis=1
    )
    first = 4 * np.arange(len(points), dtype=np.int64)[:, None]
    halves = [first + np.array(half) for half in ((0, 1, 2), (0, 2, 3))]
    return corners.reshape(-1, 3), np.concatenate(halves)


def fit_planes(
    points: Float[np.ndarray, "n 3"], neighbours: Int[np.ndarray, "n k"]
) -> Float[np.ndarray, "n 3 3"]:
    """Fit the plane of each point's neighbours, which are given by their rows.

    Returns three axes, as columns: the normal, and two in the plane.
    """
    # The plane of least squares: its normal is the direction in which neighbours spread least, and
    # eigenvectors are in ascending order of that.
    offsets = points[neighbours] - points[:, None]
    offsets -= offsets.mean(axis=1, keepdims=True)
    return np.linalg.eigh(offsets.transpose(0, 2, 1) @ offsets).eigenvectors


def move_points(
    similarity: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Move points by a similarity."""
    return points @ similarity[:3, :3].T + similarity[:3, 3]


def count_at_given_depth(gaussians: Gaussians, view: View) -> int:
    """Count the Gaussians that stand at the given depth of a view; none if it has none.

    Some additions are moved away from it: by guards, and before what is left in a forced hole.
    """
    if view.given_depth is None:
        return 0
    given = look_up(view.given_depth, gaussians, view.camera)
    z = compute_z_depths(gaussians.means, view.camera)
    stands_there = (given > 0) & ((z - given).abs() <= MAX_DEVIATION * given)
    return int(stands_there.sum())
