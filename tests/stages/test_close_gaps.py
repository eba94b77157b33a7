"""Thin gaps beside a target: closed by the farther surface, and nowhere else."""

from dataclasses import replace

import pytest
import torch

from gscompleter import CompleterConfig, load_renderer
from gscompleter.config import GapConfig
from gscompleter.guards import prepare_guards
from gscompleter.numerics.geometry import compute_z_depths, pad_camera
from gscompleter.numerics.image_ops import keep_thin
from gscompleter.parts import PartOrigin, make_part
from gscompleter.render.cache import SceneRenderer
from gscompleter.stages.close_gaps import (
    are_worth_closing,
    continue_surfaces,
    displace_camera,
    view_gaps,
)
from gscompleter.stages.target_view import TargetView, render_target
from gscompleter.types import Gaussians, View, merge
from knowing_models import knowing
from scenes import Room, camera_at, gaussians_of, view_of
from target_views import begin_with

SIZE = 64
CAMERA = camera_at(0.0, size=SIZE)
WALL = 4.0
SCREEN = 2.0
COLUMN = 30
"""First column of the gap; the screen is left of it, the wall right of it."""
WIDTH = 3


def make_torn_scene(width: int = WIDTH) -> tuple[View, Gaussians]:
    """Return a photograph of a wall, and the wall behind a screen with a gap beside its edge."""
    image = torch.full((SIZE, SIZE, 3), 0.2)
    image[:, :COLUMN] = torch.tensor([0.8, 0.3, 0.1])
    depth = torch.full((SIZE, SIZE), WALL)
    depth[:, :COLUMN] = SCREEN
    photograph = View(image, CAMERA, 0, depth)
    columns = torch.arange(SIZE * SIZE) % SIZE
    is_gap = (columns >= COLUMN) & (columns < COLUMN + width)
    return photograph, gaussians_of(photograph)[~is_gap]


def look_at_gap(width: int = WIDTH) -> TargetView:
    photograph, scene = make_torn_scene(width)
    scenes = SceneRenderer(load_renderer("cpu"))
    state = begin_with(scene, [photograph], CompleterConfig())
    # The camera does not move on: it is that of the photograph.
    return view_gaps(state, CAMERA, scenes, GapConfig())


def test_cameras_move_on_from_the_nearest_photograph_and_to_both_sides_without_turning():
    views = [view_of(Room(), camera_at(x, size=SIZE)) for x in (-1.0, 0.0)]
    target = camera_at(0.4, yaw=12, size=SIZE)
    moved = displace_camera(target, views, 0.5)
    to_the_right = 0.2 * target.c2w[:3, 0]
    expected = [
        torch.tensor([0.6, 0.0, 0.0]),
        *(target.center + move * to_the_right for move in (0.75, -0.75, 1.25, -1.25)),
    ]
    for camera, center in zip(moved, expected, strict=True):
        assert torch.allclose(camera.center, center, atol=1e-6)
        assert torch.equal(camera.c2w[:3, :3], target.c2w[:3, :3])
        assert torch.equal(camera.K, target.K)


def test_a_photograph_at_the_target_does_not_tell_how_far_cameras_move():
    """Something is removed, or marked, as photographs see it."""
    target = camera_at(0.4, size=SIZE)
    at_target = view_of(Room(), target)
    beside = view_of(Room(), camera_at(0.0, size=SIZE))
    moved = displace_camera(target, [at_target, beside], 0.5)
    expected = displace_camera(target, [beside], 0.5)
    assert [one.center.tolist() for one in moved] == [one.center.tolist() for one in expected]
    assert displace_camera(target, [at_target], 0.5) == ()


def test_a_gap_takes_depth_and_colour_of_the_farther_surface():
    view = look_at_gap()
    gaps = keep_thin(view.empty)
    assert gaps[SIZE // 2].nonzero()[:, 0].tolist() == [COLUMN, COLUMN + 1, COLUMN + 2]
    image, added = continue_surfaces(view, gaps)
    depths = compute_z_depths(added.means, CAMERA)
    assert (depths - WALL).abs().max() < 0.02 * WALL
    assert (image.image[:, COLUMN : COLUMN + WIDTH] - 0.2).abs().max() < 0.05
    # All pixels of the gap are opaque now.
    after = view.frozen.composite(added)
    assert view.render.alpha[gaps].max() < 0.85
    assert after.alpha[gaps].min() > 0.85
    assert not keep_thin(replace_frozen(view, added).empty).any()


def replace_frozen(view: TargetView, added: Gaussians) -> TargetView:
    part = make_part(PartOrigin("gap", 1), added)
    state = replace(view.state, added_parts=(*view.state.added_parts, part))
    return render_target(state, view.camera, view.scenes)


def test_what_is_wide_or_opaque_is_no_gap():
    assert not keep_thin(look_at_gap(12).empty).any()
    assert not keep_thin(look_at_gap(0).empty).any()


def photograph_screen(x: float) -> View:
    """Photograph a screen before a wall, from `x`."""
    camera = camera_at(x, size=SIZE)
    across = camera.center[0] + SCREEN * camera.z_rays()[..., 0]
    is_screen = across.abs() < 0.3
    depth = torch.where(is_screen, SCREEN, WALL)
    image = torch.where(is_screen[..., None], torch.tensor([0.8, 0.3, 0.1]), torch.tensor(0.2))
    return View(image, camera, 0, depth)


@pytest.mark.parametrize("baseline", [0.4, 0.5])
def test_gaps_on_both_sides_of_a_screen_are_closed(baseline):
    """From the far cameras of the larger baseline they are too wide to be gaps."""
    scene = gaussians_of(photograph_screen(0.0))
    photograph = replace(photograph_screen(-baseline), depth=None)
    completer = knowing(CompleterConfig())
    begun = begin_with(scene, [photograph], CompleterConfig())
    state = prepare_guards(begun, completer.scenes)
    target = completer.observe(state, CAMERA)
    # The target sees no hole, and nothing is behind the screen.
    added = make_part(PartOrigin("target", 1), scene[-SIZE:])
    closing = completer.close_gaps(state, target, added)
    for camera in displace_camera(CAMERA, [photograph], GapConfig().displacement):
        before, after = (
            view_gaps(replace(state, added_parts=parts), camera, completer.scenes, GapConfig())
            for parts in ((added,), (added, closing))
        )
        # Beyond the border of the photograph nothing is known.
        before, after = (view.empty[:, 8:-8] for view in (before, after))
        assert before.sum() > SIZE
        assert after.sum() < 0.1 * before.sum()


def test_a_few_pixels_are_not_worth_closing():
    gaps = torch.zeros((256, 256), dtype=torch.bool)
    gaps[100, 100:106] = True
    assert not are_worth_closing(gaps)
    gaps[101, 100] = True
    assert are_worth_closing(gaps)


def test_where_nothing_is_known_nothing_is_added():
    photograph, scene = make_torn_scene()
    scenes = SceneRenderer(load_renderer("cpu"))
    state = begin_with(scene[:0], [photograph], CompleterConfig())
    view = render_target(state, pad_camera(CAMERA, 0.0), scenes)
    _, added = continue_surfaces(view, torch.ones((SIZE, SIZE), dtype=torch.bool))
    assert len(added) == 0


def views_of_room() -> list[View]:
    return [view_of(Room(), camera_at(x, size=SIZE), i) for i, x in enumerate((-0.3, 0.1))]


def complete(config: CompleterConfig) -> tuple[list[int], Gaussians]:
    """Complete the room; return the pixels of gaps beside the target, and the additions."""
    views = views_of_room()
    completer = knowing(config)
    done = completer(views, camera_at(0.7, yaw=12, size=SIZE))
    (result,) = done.targets
    beside = displace_camera(result.target, views, GapConfig().displacement)
    looks = [view_gaps(done, camera, completer.scenes, GapConfig()) for camera in beside]
    return [int(keep_thin(look.empty).sum()) for look in looks], result.added


def test_a_completion_leaves_fewer_gaps_on_each_side_under_the_number_of_its_target():
    with_gaps, former = complete(replace(CompleterConfig(), gaps=GapConfig(displacement=0.0)))
    without, added = complete(CompleterConfig())
    assert max(with_gaps) > 0
    assert all(after <= before / 2 for before, after in zip(with_gaps, without, strict=True))
    # What the target added before is still there, and comes first.
    assert len(added) > len(former)
    assert torch.equal(added.means[: len(former)], former.means)
    assert set(added.generated.tolist()) == {1}


def test_the_paper_closes_none(monkeypatch):
    monkeypatch.setattr("gscompleter.completer.view_gaps", None)
    _, added = complete_plainly(CompleterConfig.paper())
    assert len(added) > 0


def complete_plainly(config: CompleterConfig) -> tuple[Gaussians, Gaussians]:
    done = knowing(config)(views_of_room(), camera_at(0.7, yaw=12, size=SIZE))
    return done.scene, merge([result.added for result in done.targets])
