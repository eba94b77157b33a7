"""Padding of a target: how much of it there is, and which holes in it count."""

from dataclasses import replace

import pytest
import torch

from gscompleter import GSCompleter
from gscompleter.config import LIFTED_MARGIN, CompleterConfig
from gscompleter.numerics.geometry import pad_pixels, project
from gscompleter.render.protocols import FrozenScene
from gscompleter.stages.context import choose_config
from gscompleter.stages.hole_masks import mark_beside_holes
from gscompleter.target_result import TargetResult
from gscompleter.types import Camera, Gaussians, Render
from gscompleter.virtual_capture.render_views import render_views
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 48


@pytest.fixture(scope="module")
def lifted() -> Gaussians:
    return gaussians_of(view_of(Room(), camera_at(size=SIZE)))


@pytest.fixture(scope="module")
def trained(lifted) -> Gaussians:
    """Return the same surfaces, with sizes that tell of no camera."""
    return replace(lifted, scales=torch.full_like(lifted.scales, 0.08))


def test_a_trained_splat_has_no_padding_unless_it_is_asked_for(lifted, trained):
    bare = CompleterConfig.bare()
    assert choose_config(bare, trained, None).margin == 0
    assert choose_config(bare, lifted, None).margin == LIFTED_MARGIN
    assert choose_config(None, None, None).margin == LIFTED_MARGIN
    assert choose_config(replace(bare, margin=0.1), trained, None).margin == 0.1
    # With photographs as without: what the Gaussians are decides.
    splat = CompleterConfig.splat()
    assert choose_config(splat, lifted, ()).margin == LIFTED_MARGIN
    assert choose_config(splat, trained, ()).margin == 0


def test_padding_follows_the_hole_that_touches_the_border():
    camera = pad_pixels(camera_at(size=8), 4, 4)
    holes = torch.ones((16, 16), dtype=torch.bool)
    inside = camera.crop(holes)
    inside[:] = False
    inside[3, 7] = True
    beside = mark_beside_holes(holes, camera, 1)
    # The image itself stays open for whatever is a hole in it.
    assert camera.crop(beside).all()
    # To the right of the hole, with its seam, and nowhere else.
    padding = beside.clone()
    camera.crop(padding).fill_(False)
    assert padding.nonzero()[:, 0].unique().tolist() == [6, 7, 8]
    assert padding.nonzero()[:, 1].unique().tolist() == [12, 13, 14, 15]


def test_one_pixel_of_a_hole_at_the_border_does_not_open_all_of_the_padding(trained):
    # The right half of the image is empty, the left half is not, and beyond it all is.
    scene = trained[trained.means[:, 0] < 0.9]
    camera = replace(camera_at(size=SIZE), near=None, far=None)
    views = render_views(scene, [camera, replace(camera_at(0.2, size=SIZE), near=None, far=None)])
    for kind, is_open in (("beside", False), ("all", True)):
        bare = CompleterConfig.bare()
        config = replace(bare, margin=0.25, holes=replace(bare.holes, padding=kind))
        completer = GSCompleter(config=config)
        view = completer.observe(completer.begin(views, scene), camera_at(0.02, size=SIZE))
        left = view.holes[:, : view.camera.left - 4]
        right = view.holes[:, -view.camera.left :]
        assert right.float().mean() > 0.5
        assert bool(left.float().mean() > 0.5) is is_open


@pytest.mark.parametrize(("margin", "count"), [(0.0, 1), (0.25, 2)])
def test_a_target_is_rendered_again_only_to_take_its_padding_off(
    trained, monkeypatch, margin, count
):
    x, y = project(trained.means, camera_at(size=SIZE))[0].unbind(-1)
    scene = trained[((x - SIZE / 2).abs() > 6) | ((y - SIZE / 2).abs() > 6)]
    cameras = [replace(camera_at(x, size=SIZE), near=None, far=None) for x in (0.0, 0.2)]
    completer = GSCompleter(config=replace(CompleterConfig.bare(), margin=margin))
    state = completer.begin(render_views(scene, cameras), scene)
    seen = []
    freeze = completer.scenes.freeze

    def record(parts: tuple[Gaussians, ...], camera: Camera) -> FrozenScene:
        seen.append(camera)
        return freeze(parts, camera)

    monkeypatch.setattr(completer.scenes, "freeze", record)
    view = completer.observe(state, camera_at(0.02, size=SIZE))
    # The hole is enclosed by the image.
    assert view.holes.any()
    assert view.camera.left == 0
    assert len(seen) == count


def test_a_line_says_that_most_of_the_additions_are_outside_of_the_image(trained):
    alpha = torch.ones((SIZE, SIZE))
    render = Render(torch.zeros((SIZE, SIZE, 3)), alpha, alpha)
    hole = torch.zeros((SIZE, SIZE), dtype=torch.bool)
    hole[0, :37] = True
    added = trained[:1000]
    result = TargetResult(camera_at(size=SIZE), render, render, hole, alpha, 0, False, added)
    assert result.describe_outside() == ""
    note = replace(result, num_outside=985).notes[-1]
    assert "985 of the 1,000 added Gaussians lie outside" in note
    assert "37 pixels" in note
