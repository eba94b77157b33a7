"""Additions that no image shows are dropped, and no image changes by it."""

from dataclasses import replace

import torch

from gscompleter.guards.contribution import find_shown
from gscompleter.render.loading import load_renderer
from gscompleter.types import merge
from scenes import Room, camera_at, gaussians_of, view_of

CAMERA = camera_at(size=32)
VIEW = view_of(Room(), CAMERA)
RENDERER = load_renderer("cpu")


def test_hidden_transparent_and_outer_gaussians_are_not_shown():
    assert VIEW.depth is not None
    surface = gaussians_of(VIEW)
    before, hidden = gaussians_of(VIEW, 0.5 * VIEW.depth), gaussians_of(VIEW, 2.0 * VIEW.depth)
    faint = replace(before, opacities=torch.full_like(before.opacities, 0.001))
    outside = replace(before, means=-before.means)
    added = merge([before, hidden, faint, outside])
    shown = find_shown(added, RENDERER.freeze(surface, CAMERA)).split(len(before))
    assert [float(part.float().mean()) for part in shown[2:]] == [0.0, 0.0]
    assert shown[0].all()
    assert shown[1].float().mean() < 0.1
    kept = added[torch.cat(shown)]
    images = [RENDERER.render(merge([surface, some]), CAMERA).image for some in (added, kept)]
    assert (images[0] - images[1]).abs().max() < 0.005
