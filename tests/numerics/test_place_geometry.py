"""Places of geometry from elsewhere: in the frame of a scene, beside it, or in another one."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter import GSCompleter, InputError
from gscompleter.numerics.given_geometry import GivenGeometry, make_geometry
from gscompleter.numerics.place_geometry import place_geometry
from gscompleter.types import Camera, DepthMap
from room_mesh import OTHER_ROOM, mesh_of, points_of, triangles_of
from scenes import Room, camera_at, cast, gaussians_of, merge, view_of

CAMERAS = [camera_at(x, size=64) for x in (-0.3, 0.1)]
BOX = Room().boxes[0]
ONE_WALL = [camera_at(x, y=-0.6, z=2.6, size=64, focal=1.5) for x in (-1.3, -1.0)]
"""Cameras that see nothing but the wall at the end of the room."""
CORNER = [camera_at(x, y=0.6, z=1.5, yaw=35, size=64, focal=0.6) for x in (-0.3, 0.1)]
"""Cameras that see two walls and the floor, and hardly anything else."""
BESIDE_CAMERAS = ((0.5, -0.5, -0.95), (2.9, 1.5, 0.3))


def make_mesh(room: Room = Room()) -> GivenGeometry:
    """Make the mesh of a room."""
    vertices, quads = mesh_of(room)
    return make_geometry(vertices, triangles_of(quads), "room.ply")


def move_elsewhere(geometry: GivenGeometry) -> GivenGeometry:
    """Move geometry to another unit, other axes and another origin."""
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    similarity = np.eye(4)
    similarity[:3, :3] = 0.2 * turn
    similarity[:3, 3] = 4, -20, 7
    return geometry.transform(similarity)


def place(
    geometry: GivenGeometry, room: Room = Room(), cameras: Sequence[Camera] = CAMERAS
) -> GivenGeometry:
    """Place geometry by the true depth of what two cameras see of a room."""
    surfaces = []
    for camera in cameras:
        depth = cast(room, camera)[1]
        surfaces.append(DepthMap(depth, torch.ones_like(depth, dtype=torch.bool)))
    return place_geometry(geometry, cameras, surfaces)


def measure_move(geometry: GivenGeometry, truth: GivenGeometry) -> float:
    """Measure the largest distance of a corner from where it belongs, relative to the room."""
    return float(np.linalg.norm(geometry.vertices - truth.vertices, axis=1).max()) / 6


def test_what_stands_where_the_scene_shows_it_stays_as_it_is():
    mesh = make_mesh()
    assert place(mesh) is mesh


def test_a_scan_that_is_2_cm_off_is_corrected():
    scan = make_mesh().move(np.array([0.02, 0.0, -0.02]))
    placed = place(scan)
    assert measure_move(placed, make_mesh()) < 0.2 * measure_move(scan, make_mesh())
    assert placed.placement is not None
    assert placed.placement.scale == pytest.approx(1, abs=0.002)
    np.testing.assert_allclose(placed.placement.shift, [-0.02, 0, 0.02], atol=0.005)


@pytest.mark.parametrize("kind", ["mesh", pytest.param("points", marks=pytest.mark.slow)])
def test_geometry_in_a_frame_of_its_own_comes_to_its_place(kind):
    scan = make_geometry(points_of(), np.empty((0, 3), np.int64), "scan.ply")
    geometry = make_mesh() if kind == "mesh" else scan
    placed = place(move_elsewhere(geometry))
    assert measure_move(placed, geometry) < 0.02
    placement = placed.placement
    assert placement is not None
    assert placement.scale == pytest.approx(5, rel=0.01)
    assert placement.degrees == pytest.approx(120, abs=0.5)
    assert placement.deviation < 0.005
    assert placement.describe().startswith(f"{geometry.name} was moved to where the scene shows")


@pytest.mark.parametrize(
    "geometry",
    [
        pytest.param(make_mesh(OTHER_ROOM), marks=pytest.mark.slow),
        move_elsewhere(make_mesh(OTHER_ROOM)),
    ],
)
def test_a_mesh_of_another_room_is_refused(geometry):
    with pytest.raises(InputError, match="room.ply is not what the scene shows, neither"):
        place(geometry)


def test_a_geometry_without_an_area_is_refused():
    line = GivenGeometry(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]))
    with pytest.raises(InputError, match="in the best place 0 % of the compared pixels"):
        place(line)


@pytest.mark.slow
def test_a_symmetric_room_is_placed_by_any_of_its_symmetries():
    empty = Room((BOX,))
    placed = place(move_elsewhere(make_mesh(empty)), empty)
    # Each corner comes to one of the corners.
    corners = make_mesh(empty).vertices
    gaps = np.linalg.norm(placed.vertices[:, None] - corners, axis=2)
    assert gaps.min(axis=1).max() < 0.12
    assert len(set(gaps.argmin(axis=1))) == 8


def test_a_room_that_is_symmetric_as_far_as_it_is_seen_is_refused():
    """Upside down it fits as well, and what stands beside the cameras is then elsewhere."""
    mesh = make_mesh(Room((BOX, BESIDE_CAMERAS)))
    with pytest.raises(InputError, match="fits the scene in several places alike"):
        place(move_elsewhere(mesh), Room((BOX,)))


# `test_a_room_that_is_symmetric_as_far_as_it_is_seen_is_refused` is refused for the same reason.
@pytest.mark.slow
@pytest.mark.parametrize("shown", ["wall", "corner"])
def test_geometry_that_slides_along_all_that_is_seen_is_refused(shown):
    """At any scale, about the corner too, it counts as in the same place: it has no other walls."""
    mesh = make_mesh(Room((BOX,)))
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    is_shown = middles[:, 2] > 4.9
    if shown == "corner":
        is_shown |= (middles[:, 0] > 2.9) | (middles[:, 1] > 1.4)
    walls = replace(mesh, faces=mesh.faces[is_shown])
    cameras = ONE_WALL if shown == "wall" else CORNER
    with pytest.raises(InputError, match="several places alike.* opposite walls and furniture"):
        place(move_elsewhere(walls), Room((BOX,)), cameras)


def test_what_stands_before_a_single_wall_stays_as_it_is():
    mesh = make_mesh()
    off = mesh.move(np.array([0.05, 0.05, 0.05]))
    assert place(mesh, cameras=ONE_WALL) is mesh
    assert place(off, cameras=ONE_WALL) is off


@pytest.mark.slow
@pytest.mark.parametrize("is_given", [True, False])
def test_a_completion_uses_geometry_in_a_frame_of_its_own(is_given):
    """The scene is a splat, or made of the photographs alone, whose depth is less exact."""
    views = [
        replace(view_of(Room(), camera, frame), depth=None) for frame, camera in enumerate(CAMERAS)
    ]
    scene = merge([gaussians_of(view_of(Room(), camera)) for camera in CAMERAS])
    mesh = make_mesh()
    begun = GSCompleter().begin(views, scene if is_given else None, geometry=move_elsewhere(mesh))
    assert begun.geometry is not None
    assert measure_move(begun.geometry, mesh) < 0.05
    assert all(view.given_depth is not None for view in begun.views)
