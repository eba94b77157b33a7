"""Similarities that are found from surfaces alone: what cameras see of a room, and its mesh."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gscompleter.numerics.given_geometry import GivenGeometry, make_geometry, move_points
from gscompleter.numerics.surface_alignment import (
    DistanceField,
    SeenPoints,
    align_surface,
    find_least_determined_move,
    fit_closest_points,
    make_gap_equations,
    make_move,
    make_seen_points,
    sample_surface,
)
from room_mesh import mesh_of, triangles_of
from scenes import Room, camera_at, cast

MESH = make_geometry(mesh_of()[0], triangles_of(mesh_of()[1]), "room")
CAMERAS = [camera_at(x, size=48) for x in (-0.3, 0.1)]


def make_similarity_of(scale: float, degrees: float, shift: tuple[float, ...]) -> np.ndarray:
    """Make a similarity that turns about a skewed axis."""
    axis = np.array([1.0, 2, -1]) / np.sqrt(6)
    similarity = np.eye(4)
    similarity[:3, :3] = scale * Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
    similarity[:3, 3] = shift
    return similarity


def see_room(noise: float = 0.0):
    """Make the points that two cameras see, with noise relative to their depth."""
    rng = np.random.default_rng(0)
    points = []
    depths = []
    for camera in CAMERAS:
        errors = torch.from_numpy(rng.normal(size=(48, 48)))
        depth = cast(Room(), camera)[1].double() * (1 + noise * errors)
        seen = camera.center + depth[..., None] * camera.z_rays()
        points.append(seen[::2, ::2].reshape(-1, 3).numpy())
        depths.append(depth[::2, ::2].reshape(-1).numpy())
    return make_seen_points(np.concatenate(points), np.concatenate(depths))


def measure_error(similarity, moved: GivenGeometry) -> float:
    """Measure the mean distance of corners from where they were, relative to the room's 6 m."""
    gaps = move_points(similarity, moved.vertices) - MESH.vertices
    return float(np.linalg.norm(gaps, axis=1).mean()) / 6


# `tests/numerics/test_place_geometry.py` finds one.
@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.2, 30.0])
def test_a_mesh_in_a_frame_of_its_own_is_found(scale):
    moved = MESH.transform(make_similarity_of(scale, 130, (4.0, -20.0, 7.0)))
    surface = sample_surface(moved, np.random.default_rng(0))
    places = align_surface(surface, see_room(0.01), np.random.default_rng(0))
    assert min(measure_error(place, moved) for place in places) < 0.02


def test_a_small_error_is_fitted_away():
    moved = MESH.transform(make_similarity_of(1.01, 1, (0.05, 0.0, -0.05)))
    surface = sample_surface(moved, np.random.default_rng(0))
    assert measure_error(np.eye(4), moved) > 0.008
    similarity, share = fit_closest_points(np.eye(4), surface, see_room())
    assert measure_error(similarity, moved) < 0.002
    assert share > 0.95


@pytest.mark.parametrize("growth", [0.98, 1.02])
def test_what_is_seen_a_little_behind_the_outermost_walls_lies_on_them(growth):
    surface = sample_surface(MESH, np.random.default_rng(0))
    middle = MESH.vertices.mean(axis=0)
    points = middle + growth * (surface.points[:2000] - middle)
    seen = SeenPoints(points, surface.normals[:2000], np.full(2000, 3.0))
    assert DistanceField.make(surface).measure_agreement(np.eye(4)[None], seen)[0] > 0.95


def make_seen_grid(shape: str):
    """Make the points of a plane or of a half cylinder, in a frame that is turned."""
    u, v = (part.ravel() for part in np.meshgrid(np.linspace(-1, 1, 30), np.linspace(-1, 1, 30)))
    angles = np.pi / 2 * u
    flat = np.stack([u, v, 0 * u], axis=1)
    points = flat if shape == "plane" else np.stack([np.sin(angles), v, np.cos(angles)], axis=1)
    return make_seen_points(
        move_points(make_similarity_of(1, 50, (0, 0, 4)), points), np.full(900, 4.0)
    )


@pytest.mark.parametrize("shape", ["plane", "cylinder"])
def test_the_least_determined_move_goes_along_the_surface_however_long(shape):
    seen = make_seen_grid(shape)
    move = find_least_determined_move(np.eye(4), seen, seen)
    assert np.linalg.norm(move) == pytest.approx(1)
    # Shorter than the surface, beyond whose borders nothing is close.
    place = make_move(0.4 * move, seen)
    inside = np.linalg.norm(seen.points - seen.middle, axis=1) < 0.5
    moved = move_points(place, seen.points[inside])
    gaps, rows = seen.tree.query(moved)
    along_normals = np.abs(np.einsum("ni,ni->n", moved - seen.points[rows], seen.normals[rows]))
    assert np.linalg.norm(moved - seen.points[inside], axis=1).max() > 0.1
    assert along_normals.max() < 0.01
    assert gaps.max() < 0.1


def test_a_room_is_determined_in_each_direction():
    rng = np.random.default_rng(0)
    seen = see_room()
    surface = sample_surface(MESH, rng)
    move = find_least_determined_move(np.eye(4), surface, seen)
    gaps = [
        make_gap_equations(make_move(step * move, seen), surface, seen, 0.3).gaps
        for step in (0, 0.4)
    ]
    assert np.abs(gaps[1]).mean() > 10 * np.abs(gaps[0]).mean()


def test_points_of_a_surface_lie_on_it_in_proportion_to_areas():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    vertices = np.concatenate([square, 2 * square + [5.0, 0, 0]])
    faces = triangles_of(np.array([[0, 1, 2, 3], [4, 5, 6, 7]]))
    surface = sample_surface(GivenGeometry(vertices, faces), np.random.default_rng(0))
    assert not surface.points[:, 2].any()
    np.testing.assert_allclose(np.abs(surface.normals), [[0, 0, 1]] * len(surface.points))
    is_large = surface.points[:, 0] > 3
    assert is_large.mean() == pytest.approx(0.8, abs=0.02)
    np.testing.assert_allclose(surface.points[is_large].mean(axis=0), [6, 1, 0], atol=0.03)


def test_nothing_is_found_of_a_geometry_without_an_area_or_of_too_few_points():
    line = GivenGeometry(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]))
    rng = np.random.default_rng(0)
    assert align_surface(sample_surface(line, rng), see_room(), rng) == []
    few = make_seen_points(np.zeros((5, 3)), np.ones(5))
    assert align_surface(sample_surface(MESH, rng), few, rng) == []
    assert fit_closest_points(np.eye(4), sample_surface(MESH, rng), few)[1] == 0
