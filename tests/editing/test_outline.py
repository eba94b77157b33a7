"""The outline of something removed: where a surface goes on beyond it, and where it ends."""

from __future__ import annotations

import torch

from gscompleter.editing.outline import Outline, trace_outline
from gscompleter.types import Render
from scenes import camera_at

SIDE = 100
CAMERA = camera_at(size=SIDE)
OBJECT = (slice(30, 70), slice(30, 70))


def make_image(color: float = 0.8, depth: float = 2.0) -> Render:
    """Return a dark wall at depth 4, and a square object before it."""
    image, z = torch.full((SIDE, SIDE, 3), 0.2), torch.full((SIDE, SIDE), 4.0)
    image[OBJECT], z[OBJECT] = color, depth
    return Render(image, z, torch.ones(SIDE, SIDE))


def trace(before: Render, left: int = 30, after: Render | None = None) -> Outline:
    """Trace the outline of the object right of a column, as far as it was removed."""
    removed = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    removed[30:70, left:70] = True
    return trace_outline(removed, before, after or before, CAMERA)


def test_an_object_that_goes_as_a_whole_leaves_nothing():
    outline = trace(make_image())
    assert outline.pixels.sum() == 44**2 - 40**2
    assert outline.share == 0.0


def test_a_cut_through_the_object_is_continued_along_the_cut_alone():
    outline = trace(make_image(), left=50)
    # At both ends the wall is beside it as well.
    assert outline.continued[34:66, 48:50].all()
    assert outline.continued.sum() <= 2 * 40
    assert 0.2 < outline.share < 0.4


def test_what_it_touches_counts_if_it_has_its_colour():
    assert trace(make_image(depth=4.0)).share == 0.0
    assert trace(make_image(color=0.25, depth=4.0)).share == 1.0
    assert trace(make_image(color=0.25, depth=2.0)).share == 0.0


def test_texture_is_no_end_of_a_surface_and_a_slanted_one_goes_on():
    before = make_image(depth=2.0)
    columns = torch.arange(SIDE)
    striped = torch.where(columns % 4 < 2, 0.2, 0.8)[None, :, None].expand(SIDE, SIDE, 3)
    slanted = before.depth * (1 + (columns - 50) / CAMERA.K[0, 0])
    textured = Render(striped, slanted, before.alpha)
    outline = trace(textured, left=50)
    assert outline.continued[34:66, 48:50].all()
    assert not outline.continued[:, 60:].any()


def test_a_surface_that_is_covered_afterwards_is_not_left():
    before = make_image()
    assert trace(before, left=50, after=make_image(color=0.2, depth=4.0)).share == 0.0


def test_nothing_removed_has_no_outline():
    assert trace(make_image(), left=70).share == 0.0
