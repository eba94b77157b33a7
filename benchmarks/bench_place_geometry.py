"""Meshes of true depth that are right, and some that lie, against what two photographs show.

    python benchmarks/bench_place_geometry.py hololens_room:20+22 hololens_room:30+33

A mesh is what the depth sensor measured in other photographs of the scene, and the scene what it
measured in the two. The mesh is given as it stands, and moved by similarities; so are meshes with
a half enlarged, with the largest plane shifted or stretched along one axis, and those of the other
cases. `--apart` uses scenes that are kept apart, and notes that in apart_uses.md.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from apart import HELP, select_scenes
from gscompleter import InputError, View
from gscompleter.data.formats import open_photographs
from gscompleter.numerics.geometry import unproject
from gscompleter.numerics.given_geometry import GivenGeometry
from gscompleter.numerics.place_geometry import place_geometry
from gscompleter.types import DepthMap

SIZE = (256, 256)
NEAR, FAR = 0.5, 10.0
NUM_SCANNED = 8
"""Photographs of which a mesh is made, at even steps around those that are completed."""
MAX_STEP = 0.05
"""Largest difference of depth within a triangle, relative: beyond it is an edge."""
LIE = 0.2
"""By how much a mesh lies: share of its lengths, or of its size."""
NUM_MOVES = 3
PLANE = 0.02
"""Largest distance of points from a plane on which they lie, relative to the size of the mesh."""


@dataclass(frozen=True)
class Shown:
    """A scene at two photographs, and a mesh of it from others."""

    name: str
    views: list[View]
    surfaces: list[DepthMap]
    mesh: GivenGeometry


def read_shown(word: str) -> Shown:
    """Read a case such as `redkitchen:10+11`."""
    scene, frames = word.split(":")
    context = tuple(int(frame) for frame in frames.split("+"))
    folder = Path(os.environ["GSCOMPLETER_DATA"]) / "data" / scene
    photographs = open_photographs(folder, near=NEAR, far=FAR)
    views = photographs.views(context, SIZE)
    first, last = max(0, min(context) - NUM_SCANNED), max(context) + NUM_SCANNED
    around = [n for n in range(first, min(last + 1, len(photographs))) if n not in context]
    scanned = photographs.views(around[:: -(-len(around) // NUM_SCANNED)], SIZE)
    surfaces = [sense_surface(view) for view in views]
    return Shown(word, views, surfaces, join([make_mesh(view) for view in scanned], word))


def sense_surface(view: View) -> DepthMap:
    """Return the surface that an exact splat of a photograph would show."""
    depth = get_depth(view)
    return DepthMap(depth, depth > 0)


def get_depth(view: View) -> Float[torch.Tensor, "h w"]:
    """Return the depth of the sensor, 0 where there is none."""
    assert view.depth is not None
    return view.depth.nan_to_num(nan=0.0, posinf=0.0)


def make_mesh(view: View) -> tuple[Float[np.ndarray, "n 3"], np.ndarray]:
    """Make two triangles of each square of four pixels, away from edges."""
    depth = get_depth(view)
    points = unproject(depth, view.camera).reshape(-1, 3).double().numpy()
    numbers = np.arange(depth.numel()).reshape(depth.shape)
    corners = [numbers[:-1, :-1], numbers[:-1, 1:], numbers[1:, :-1], numbers[1:, 1:]]
    faces = np.concatenate(
        [np.stack([corners[k].ravel() for k in half], axis=1) for half in ((0, 1, 2), (1, 3, 2))]
    )
    depths = depth.numpy().ravel()[faces]
    low, high = depths.min(axis=1), depths.max(axis=1)
    return points, faces[(low > 0) & (high - low <= MAX_STEP * low)]


def join(parts: list[tuple[np.ndarray, np.ndarray]], name: str) -> GivenGeometry:
    """Join meshes to one, without vertices that no triangle has."""
    starts = np.cumsum([0, *(len(points) for points, _ in parts)])
    faces = np.concatenate([f + start for (_, f), start in zip(parts, starts, strict=False)])
    used, faces = np.unique(faces, return_inverse=True)
    vertices = np.concatenate([points for points, _ in parts])[used]
    return GivenGeometry(vertices, faces.reshape(-1, 3).astype(np.int64), name)


def draw_similarities(rng: np.random.Generator) -> Iterator[Float[np.ndarray, "4 4"]]:
    """Draw similarities: a scale of e^-2 to e^2, any turn, a shift of about 10."""
    for _ in range(NUM_MOVES):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        similarity = np.eye(4)
        similarity[:3, :3] = np.exp(rng.uniform(-2, 2)) * turn * np.linalg.det(turn)
        similarity[:3, 3] = rng.normal(scale=10 / 3**0.5, size=3)
        yield similarity


def list_lies(
    mesh: GivenGeometry, rng: np.random.Generator
) -> Iterator[tuple[str, GivenGeometry, float]]:
    """List meshes that lie, each with the share of its vertices that do."""
    points = mesh.vertices
    middle = np.median(points, axis=0)
    size = float(np.linalg.norm(np.quantile(points, 0.95, axis=0) - middle))

    # The part beyond the middle along the axis in which the scene is longest.
    axis = np.argmax(points.std(axis=0))
    is_part = points[:, axis] > middle[axis]
    centre = np.median(points[is_part], axis=0)
    enlarged = np.where(is_part[:, None], centre + (1 + LIE) * (points - centre), points)
    yield "half enlarged", replace(mesh, vertices=enlarged), float(is_part.mean())

    normal, is_on_plane = find_plane(points, PLANE * size, rng)
    shifted = points + LIE * size * is_on_plane[:, None] * normal
    yield "plane shifted", replace(mesh, vertices=shifted), float(is_on_plane.mean())

    stretched = points.copy()
    stretched[:, axis] *= 1 + LIE
    yield "stretched", replace(mesh, vertices=stretched), 1.0


def find_plane(
    points: np.ndarray, distance: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Find the plane on which most points lie: its normal, and True for these points."""
    best = (points[0], np.zeros(len(points), bool))
    sample = points[:: max(1, len(points) // 20_000)]
    most = 0
    for _ in range(300):
        a, b, c = sample[rng.choice(len(sample), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        normal /= max(np.linalg.norm(normal), 1e-12)
        count = int((np.abs((sample - a) @ normal) < distance).sum())
        if count > most:
            most = count
            best = (normal, np.abs((points - a) @ normal) < distance)
    return best


def judge(geometry: GivenGeometry, shown: Shown, truth: GivenGeometry | None) -> str:
    """Place geometry, and say in a word what became of it."""
    try:
        cameras = [view.camera for view in shown.views]
        placed = place_geometry(geometry, cameras, shown.surfaces)
    except InputError as error:
        return f"refused: {error}"
    how = "kept" if placed is geometry else "moved"
    if truth is None:
        return how
    size = np.linalg.norm(truth.vertices.std(axis=0))
    distance = np.linalg.norm(placed.vertices - truth.vertices, axis=1)
    return f"{how}, {100 * float(np.median(distance)) / size:.1f} % off"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="+")
    parser.add_argument("--apart", action="store_true", help=HELP)
    options = parser.parse_args()
    used = select_scenes([word.split(":")[0] for word in options.cases], options.apart)
    cases = [read_shown(word) for word in options.cases if word.split(":")[0] in used]
    for shown in cases:
        rng = np.random.default_rng(0)
        moves = list(draw_similarities(rng))
        meshes = [("right", shown.mesh, 0.0), *list_lies(shown.mesh, rng)]
        meshes += [(f"mesh of {each.name}", each.mesh, 1.0) for each in cases if each is not shown]
        for what, mesh, share in meshes:
            truth = shown.mesh if what == "right" else None
            given = [mesh, *(mesh.transform(move) for move in moves)]
            for place, geometry in zip(
                ("as it stands", *["moved"] * NUM_MOVES), given, strict=True
            ):
                answer = judge(geometry, shown, truth)
                print(f"{shown.name} | {what} ({share:.0%}) | {place} | {answer}", flush=True)


if __name__ == "__main__":
    main()
