"""Renders that stand in for photographs."""

from dataclasses import replace

import pytest
import torch

import gscompleter as gsc
from gscompleter.system.errors import InputError
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 64


@pytest.fixture(scope="module")
def wall() -> gsc.Gaussians:
    """Return what one camera sees of a room."""
    return gaussians_of(view_of(Room(), camera_at(size=SIZE)))


def test_a_render_at_the_camera_of_the_scene_is_the_photograph(wall):
    photograph = view_of(Room(), camera_at(size=SIZE))
    (view,) = gsc.render_views(wall, [replace(photograph.camera, near=None, far=None)])
    inner = view.valid_mask
    assert inner.float().mean() > 0.9
    # Round Gaussians blur the texture, but nothing is shifted.
    error = (view.image - photograph.image)[inner].abs().mean()
    mirrored = (view.image - photograph.image.flip(1))[inner].abs().mean()
    assert error < 0.5 * mirrored
    known = view.given_depth > 0
    assert torch.equal(known, inner)
    wrong = (view.given_depth - photograph.depth).abs() / photograph.depth
    assert wrong[inner].median() < 0.02


def test_what_is_not_opaque_is_ignored_and_has_no_depth(wall):
    # Turned by half of the field of view, so that half of the image shows nothing.
    (view,) = gsc.render_views(wall, [camera_at(yaw=29, size=SIZE)])
    assert 0.2 < view.valid_mask.float().mean() < 0.8
    assert not view.valid_mask[:, -SIZE // 4 :].any()
    assert (view.given_depth[~view.valid_mask] == 0).all()


def test_any_unit_of_the_scene_gives_the_same_render(wall):
    camera = replace(camera_at(0.2, size=SIZE), near=None, far=None)
    (usual,) = gsc.render_views(wall, [camera])
    for unit in (1e-3, 1e3):
        scaled = replace(wall, means=wall.means * unit, scales=wall.scales * unit)
        pose = camera.c2w.clone()
        pose[:3, 3] *= unit
        (view,) = gsc.render_views(scaled, [replace(camera, c2w=pose)])
        assert (view.image - usual.image).abs().max() < 1e-3
        assert (view.given_depth / unit - usual.given_depth).abs().max() < 1e-2


def test_views_are_numbered_and_complete_a_scene_without_photographs(wall):
    cameras = [replace(camera_at(x, size=SIZE), near=None, far=None) for x in (-0.3, 0.3)]
    views = gsc.render_views(wall, cameras)
    assert [view.frame for view in views] == [0, 1]
    completer = gsc.GSCompleter(config=gsc.CompleterConfig.bare())
    target = replace(camera_at(yaw=12, size=SIZE), near=None, far=None)
    done = completer(views, target, scene=wall)
    (result,) = done.targets
    assert len(result.added) > 0
    before = result.before.alpha[result.hole_mask].mean()
    assert result.after.alpha[result.hole_mask].mean() > before + 0.5
    # Ignored pixels of the renders are black, and pull no colour of the additions towards it.
    hole = result.hole_mask & (result.after.alpha > 0.8)
    assert (result.after.image - result.reference.image)[hole].abs().mean() < 0.1
    # What was given is kept bit for bit, and stands first.
    assert torch.equal(done.scene.means[: len(wall)], wall.means)
    assert torch.equal(done.scene.sh[: len(wall)], wall.sh)


def test_a_camera_that_sees_nothing_opaque_is_refused(wall):
    with pytest.raises(InputError, match="Camera 1 sees nothing opaque of the scene"):
        gsc.render_views(wall, [camera_at(size=SIZE), camera_at(yaw=180, size=SIZE)])
