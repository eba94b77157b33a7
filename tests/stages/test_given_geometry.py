"""Depth of geometry from elsewhere: how true holes become with it, and which geometry is refused.

The scene is what two photographs see of a room, and the target looks beside it.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter import CompleterConfig, GSCompleter, InputError, TargetResult
from gscompleter.numerics.given_geometry import count_at_given_depth, make_geometry
from gscompleter.stages.given_geometry import (
    ContradictedError,
    check_geometry,
    fit_to_surface,
    give_depth_before_scene,
    require_uncontradicted,
)
from gscompleter.types import DepthMap
from room_mesh import mesh_of, points_of, triangles_of
from scenes import Room, camera_at, cast, gaussians_of, merge, view_of

SIZE = 64
ROOM = Room()
CAMERAS = [camera_at(x, size=SIZE) for x in (-0.3, 0.1)]
TARGET = camera_at(0.9, yaw=35, size=SIZE)
VIEWS = [replace(view_of(ROOM, camera, frame), depth=None) for frame, camera in enumerate(CAMERAS)]
MESH = make_geometry(mesh_of()[0], triangles_of(mesh_of()[1]), "room.ply")
POINTS = make_geometry(points_of(), np.empty((0, 3), np.int64), "scan.ply")
SHIFTED = MESH.move(np.array([0.6, 0.3, 0.6]))
"""The room shifted by 10 % of its size."""
ENLARGED = replace(MESH, vertices=1.5 * MESH.vertices)


def seen_scene():
    """Return the Gaussians that the photographs see of the room."""
    return merge([gaussians_of(view_of(ROOM, camera)) for camera in CAMERAS])


def measure_hole_error(result: TargetResult) -> float:
    """Measure the mean relative error of depth in the filled hole."""
    truth = cast(ROOM, TARGET)[1]
    filled = result.hole_mask & (result.after.alpha > 0.5)
    assert filled.sum() > 0.9 * result.hole_mask.sum()
    return float(((result.after.depth - truth).abs() / truth)[filled].mean())


@pytest.fixture(scope="module")
def without():
    """Complete the scene without geometry."""
    return GSCompleter()(VIEWS, TARGET, seen_scene())


def test_a_mesh_gives_a_given_scene_the_depth_of_its_hole():
    (result,) = GSCompleter()(VIEWS, TARGET, seen_scene(), geometry=MESH).targets
    # Without it the error is 0.2.
    assert measure_hole_error(result) < 0.04
    assert result.geometry.share > 0.95
    assert 0 < result.geometry.added <= len(result.added)
    assert "room.ply gives the depth of 100 % of the hole." in result.notes
    # Its colours are invented all the same.
    assert (result.added.generated == result.target_id).all()


@pytest.mark.slow
def test_points_give_a_given_scene_the_depth_of_its_hole(without):
    (result,) = GSCompleter()(VIEWS, TARGET, seen_scene(), geometry=POINTS).targets
    assert measure_hole_error(without.targets[0]) > 0.1
    assert measure_hole_error(result) < 0.4 * measure_hole_error(without.targets[0])


@pytest.mark.slow
def test_a_mesh_gives_depth_where_holes_continue_the_scene():
    """As of a trained splat, whose holes have no depth of Ψ."""
    before, after = (
        GSCompleter()(VIEWS, TARGET, seen_scene(), check_views=[], geometry=geometry)
        for geometry in (None, MESH)
    )
    assert after.config.registration.hole_depth == "scene"
    assert measure_hole_error(after.targets[0]) < 0.4 * measure_hole_error(before.targets[0])


@pytest.mark.slow
def test_a_mesh_gives_photographs_depth_before_a_scene_is_made_of_them():
    before, after = (GSCompleter()(VIEWS, TARGET, geometry=each) for each in (None, MESH))
    assert measure_hole_error(after.targets[0]) < 0.3 * measure_hole_error(before.targets[0])
    assert all(view.given_depth is not None for view in after.views)


@pytest.mark.parametrize(
    ("geometry", "words"),
    [
        (SHIFTED, "room.ply differs from what the photographs measure"),
        (ENLARGED, r"room.ply differs by a factor of 1\.5\d* from what the photographs measure"),
        (MESH.move(np.array([0.0, 0, 1000])), "covers hardly anything that the photographs show"),
    ],
)
def test_photographs_contradict_a_mesh_that_is_not_in_their_frame(geometry, words):
    with pytest.raises(ContradictedError, match=words):
        give_depth_before_scene(geometry, VIEWS)


def test_geometry_that_stereo_contradicts_in_half_the_photographs_is_refused():
    given = [replace(view, given_depth=torch.ones(SIZE, SIZE)) for view in VIEWS]
    require_uncontradicted(MESH, VIEWS, given, given)
    with pytest.raises(InputError, match="surfaces of room.ply .* in 1 of 2 photographs"):
        require_uncontradicted(MESH, VIEWS, given, [given[0], VIEWS[1]])
    # Depth that came with a photograph says nothing about the geometry.
    require_uncontradicted(MESH, [VIEWS[0], given[1]], given, [given[0], VIEWS[1]])


def test_one_photograph_cannot_tell_where_geometry_belongs():
    behind = MESH.move(np.array([0.0, 0.0, -100.0]))
    with pytest.raises(InputError, match="room.ply covers hardly anything"):
        GSCompleter().begin(VIEWS[:1], geometry=behind)


def test_photographs_keep_the_depth_that_was_measured_with_them():
    measured = torch.full((SIZE, SIZE), 4.0)
    views = [replace(VIEWS[0], given_depth=measured), VIEWS[1]]
    begun = GSCompleter().begin(views, seen_scene(), geometry=MESH)
    assert torch.equal(begun.views[0].given_depth, measured)
    assert (begun.views[1].given_depth > 0).float().mean() > 0.7


def test_what_is_no_geometry_is_refused():
    with pytest.raises(InputError, match="what gsc.load_geometry returns"):
        check_geometry("room.ply", CompleterConfig())


def test_the_paper_takes_no_geometry():
    with pytest.raises(InputError, match="paper"):
        GSCompleter(config=CompleterConfig.paper()).begin(VIEWS, geometry=MESH)


def test_a_small_deviation_leaves_no_step_and_a_large_one_nothing():
    """The left half of a scene is seen, and its geometry is 3 % too far."""
    surface = DepthMap(torch.full((32, 32), 2.0), torch.arange(32).repeat(32, 1) < 16)
    near = fit_to_surface(torch.full((32, 32), 2.06), surface)
    torch.testing.assert_close(near.depth, torch.full((32, 32), 2.0), rtol=1e-3, atol=0)
    assert not near.contradicted.any()
    far = fit_to_surface(torch.full((32, 32), 2.4), surface)
    assert far.contradicted.all()
    assert not far.depth.any()


def test_only_the_part_beside_a_contradiction_is_left_out():
    """A hole in the middle, whose geometry is right below and wrong above."""
    rows = torch.arange(64)[:, None].expand(64, 64)
    surface = DepthMap(torch.full((64, 64), 2.0), (rows.T < 20) | (rows.T >= 44))
    drawn = torch.where(rows < 32, 3.0, 2.0)
    fit = fit_to_surface(drawn, surface)
    assert fit.contradicted[:26].all()
    torch.testing.assert_close(fit.depth[38:], torch.full((26, 64), 2.0))


def test_a_gaussian_that_was_moved_away_does_not_stand_where_the_geometry_says():
    view = view_of(ROOM, CAMERAS[0])
    depth = view.depth
    assert depth is not None
    image = replace(view, depth=None, given_depth=depth)
    assert count_at_given_depth(gaussians_of(view), image) > 0.9 * SIZE**2
    assert count_at_given_depth(gaussians_of(view, 0.8 * depth), image) == 0
