"""Depth of triangles and points at a camera."""

import numpy as np
import pytest
import torch

from gscompleter import GivenGeometry, InputError
from gscompleter.numerics.given_geometry import make_geometry
from room_mesh import mesh_of, points_of, triangles_of
from scenes import Room, camera_at, cast

NO_FACES = np.empty((0, 3), np.int64)


def test_walls_that_reach_behind_the_camera_are_drawn():
    """The walls beside a camera in a room begin behind it."""
    vertices, quads = mesh_of()
    geometry = make_geometry(vertices, triangles_of(quads), "room")
    for yaw in (0, 100, 215):
        camera = camera_at(0.4, 0.2, 1.0, yaw, size=48, focal=0.3)
        truth = cast(Room(), camera)[1]
        assert (geometry.draw_depth(camera) - truth).abs().max() < 1e-5 * truth.max()


def test_what_lies_behind_the_camera_is_not_drawn():
    vertices = np.array([[-1.0, -1, -2], [1, -1, -2], [0, 1, -2]])
    geometry = GivenGeometry(vertices, np.array([[0, 1, 2]]))
    assert not geometry.draw_depth(camera_at(size=32)).any()


def test_points_of_a_slanted_plane_have_its_depth():
    x, y = np.meshgrid(np.linspace(-2, 2, 60), np.linspace(-2, 2, 60))
    points = np.stack([x, y, 4 + 0.5 * x], axis=-1).reshape(-1, 3)
    geometry = make_geometry(points, NO_FACES, "plane")
    camera = camera_at(size=48, focal=1.5)
    rays = camera.z_rays()
    truth = 4 / (rays[..., 2] - 0.5 * rays[..., 0])
    assert (geometry.draw_depth(camera) - truth).abs().max() < 1e-5 * truth.max()


def test_a_stray_point_stays_small():
    points = np.concatenate([points_of(size=32), [[0.0, 0.0, 0.5]]])
    geometry = make_geometry(points, NO_FACES, "scan")
    alone = make_geometry(points[:-1], NO_FACES, "scan")
    camera = camera_at(size=64)
    changed = geometry.draw_depth(camera) != alone.draw_depth(camera)
    assert changed.float().mean() < 0.1


def test_moving_geometry_moves_its_depth():
    vertices = np.array([[-9.0, -9, 2], [9, -9, 2], [0, 9, 2]])
    geometry = GivenGeometry(vertices, np.array([[0, 1, 2]])).move(np.array([0.0, 0, 1]))
    torch.testing.assert_close(geometry.draw_depth(camera_at(size=8))[4, 4], torch.tensor(3.0))


def test_vertices_that_are_not_finite_are_refused():
    with pytest.raises(InputError, match="not finite"):
        GivenGeometry(np.full((3, 3), np.nan), np.array([[0, 1, 2]]))
