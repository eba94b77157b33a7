"""The hull guard: nothing is added outside of an object."""

from dataclasses import replace

import torch

import gscompleter as gsc
from gscompleter.config import CompleterConfig
from gscompleter.numerics.geometry import look_along
from gscompleter.render.loading import load_renderer
from gscompleter.render.outside import find_in_hull, look_from_outside
from gscompleter.types import Camera
from gscompleter.virtual_capture.around_target import choose_cameras_around
from scenes import camera_at
from solids import chair, cover, stone

RENDERER = load_renderer("cpu")
UP = torch.tensor([0.0, -1.0, 0.0])
SIZE = 64


def look_at_chair() -> Camera:
    """Look at the gap between an arm and the seat, and past the back."""
    camera = replace(camera_at(size=SIZE), near=None, far=None)
    c2w = camera.c2w.clone()
    c2w[:3, 3] = torch.tensor([1.0, -0.7, -1.0])
    posed = replace(camera, c2w=c2w)
    return look_along(posed, torch.tensor([0.0, -0.1, 0.1]) - posed.center, UP)


def test_points_beside_an_object_lie_outside_of_its_hull():
    views = look_from_outside(chair(), RENDERER, 192)
    assert len(views) == 12
    assert max(view.border_share for view in views) == 0
    beside = cover(
        [torch.tensor([[0.6, 0, 0], [0, 0.25, -0.6], [0, -0.7, 0.24], [9.0, 9, 9]])], 0.01
    )
    assert not find_in_hull(beside, views).any()
    assert find_in_hull(chair(), views).float().mean() > 0.999


def test_a_hole_that_was_cut_through_a_surface_lies_in_the_hull():
    whole = stone()
    axis = whole.means[:, [0, 1]].norm(dim=1)
    # Looked through along z, the stone is empty in its middle.
    cut = whole[axis > 0.15]
    views = look_from_outside(cut, RENDERER, 192)
    assert find_in_hull(whole[axis <= 0.15], views).all()


def test_what_is_added_for_an_object_lies_in_its_hull():
    seat = chair()
    target = look_at_chair()
    contexts = choose_cameras_around(seat, target, RENDERER)
    views = gsc.render_views(seat, contexts)
    hull = look_from_outside(seat, RENDERER, 96)
    outside = {}
    for name in ("without", "with"):
        config = CompleterConfig.bare()
        if name == "with":
            # The guard alone: the holes are still all that is empty.
            guards = config.for_object().guards
            config = replace(config, guards=guards)
        completion = gsc.GSCompleter(config=config)(views, target, scene=seat)
        outside[name] = (~find_in_hull(completion.added, hull)).sum().item()
    assert outside["without"] > 100
    assert outside["with"] == 0


def test_the_settings_of_an_object_keep_all_others():
    config = CompleterConfig.bare()
    changed = config.for_object()
    assert changed.holes.kind == "enclosed"
    assert changed.guards == (*config.guards, "hull")
    assert changed.for_object() == changed
    assert changed.without_guard("hull").guards == config.guards
