"""The plane behind something removed, head-on, from all photographs."""

from __future__ import annotations

import json

import pytest
import torch

from command import run
from gscompleter import GSCompleter, save_ply
from gscompleter.apps.report.surface_mosaic import draw_mosaic, face_plane, fit_surroundings
from gscompleter.config import CompleterConfig
from gscompleter.editing.removal import remove_gaussians
from gscompleter.numerics.geometry import pad_camera
from gscompleter.numerics.robust import fit_plane_ransac
from gscompleter.planning.remove import contain_nothing
from gscompleter.stages.target_view import TargetView, render_target
from gscompleter.system.files.image import read_image
from gscompleter.types import merge
from scenes import Room, camera_at, cast, gaussians_of, photographed, view_of

BOX = ((-0.2, -0.3, 2.6), (0.4, 0.3, 3.2))
"""A box that floats before the far wall."""
ROOM = Room((Room().boxes[0], BOX))
EMPTY = Room((Room().boxes[0],))
SIZE = 64
CAMERAS = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in ((-0.8, 8), (0.0, 0), (0.8, -8))]
COMPLETER = GSCompleter(config=CompleterConfig.splat().for_removal())


def test_a_plane_is_fitted_in_spite_of_outliers():
    rng = torch.Generator().manual_seed(1)
    plane = torch.tensor([0.1, -0.05, 0.4])
    rays = torch.cat([torch.rand(1000, 2, generator=rng) - 0.5, torch.ones(1000, 1)], dim=1)
    depths = 1 / (rays @ plane)
    depths[::3] *= 0.5 + torch.rand(len(depths[::3]), generator=rng)
    fitted = fit_plane_ransac(rays, depths, torch.Generator().manual_seed(0))
    assert torch.allclose(fitted, plane, atol=0.01)
    # Points on one line have no plane, and no numbers that are none.
    line = rays[:1].repeat(50, 1)
    assert fit_plane_ransac(line, torch.ones(50), torch.Generator()).isfinite().all()


def view_hole(step: float = 0.0) -> TargetView:
    """Look from the side at the place of the removed box; surfaces have steps of relative depth."""
    views = [view_of(ROOM, camera) for camera in CAMERAS]
    steps = 1 + step * (torch.arange(SIZE) // 4 % 4)
    scene = merge([gaussians_of(view, view.depth * steps) for view in views])
    low, high = torch.tensor(BOX)
    chosen = ((scene.means > low - 0.05) & (scene.means < high + 0.05)).all(dim=1)
    state = COMPLETER.begin(views, scene, [])
    state = remove_gaussians(state, chosen, contain_nothing, COMPLETER.scenes)
    camera = state.with_depth_range(CAMERAS[0])
    return render_target(state, pad_camera(camera, 0.0), COMPLETER.scenes)


def test_the_mosaic_is_what_a_camera_before_the_wall_would_see():
    view = view_hole()
    plane = fit_surroundings(view)
    camera = face_plane(plane, view.holes, view.camera.target)
    # The far wall is seen head-on, at the distance that the target has from the hole.
    assert torch.allclose(camera.forward, torch.tensor([0.0, 0.0, 1.0]), atol=0.03)
    colors, depth = cast(EMPTY, camera)
    mosaic = draw_mosaic(view)
    assert mosaic.shape == colors.shape
    is_shown = (mosaic > 0).any(dim=-1)
    assert is_shown.float().mean() > 0.2
    error = (mosaic - colors).abs().amax(dim=-1)[is_shown].median()
    shifted = (mosaic - colors.roll(4, dims=1)).abs().amax(dim=-1)[is_shown].median()
    assert error < 0.08
    assert error < shifted / 2
    wall = 5.0 - camera.center[2]
    assert ((depth / wall - 1).abs() < 0.1)[is_shown].float().mean() > 0.9


def test_surroundings_that_are_no_plane_have_no_mosaic():
    assert draw_mosaic(view_hole(0.3)) is None


# The tests above make mosaics, and `test_painters.py` exports holes.
@pytest.mark.slow
def test_an_export_of_a_removal_has_it(tmp_path, monkeypatch):
    scene = photographed(tmp_path / "room", CAMERAS, ROOM)
    save_ply(scene / "splat.ply", merge([gaussians_of(view_of(ROOM, c)) for c in CAMERAS]))
    holes = tmp_path / "holes"
    words = ("remove", scene, "--scene", scene / "splat.ply", "--out", tmp_path / "out")
    box = [c + s * 0.05 for c, s in zip((*BOX[0], *BOX[1]), (-1, -1, -1, 1, 1, 1), strict=True)]
    more = ("--box", *box, "--auto", 1, "--export-holes", holes, "--near", 0.5, "--far", 20)
    assert run(monkeypatch, *words, *more, "--quiet") == 0
    (row,) = json.loads((holes / "holes.json").read_text())["frames"]
    assert row["mosaic_path"] == "target1_mosaic.png"
    mosaic = read_image(holes / row["mosaic_path"])
    assert mosaic.shape[0] == mosaic.shape[1] == round(1.5 * SIZE)
    assert (mosaic > 0).any(dim=-1).float().mean() > 0.2
