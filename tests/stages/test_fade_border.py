"""Additions fade towards the end of the padding, where no photograph looks."""

import torch

from gscompleter import CompleterConfig, load_renderer
from gscompleter.numerics.geometry import pad_camera, project
from gscompleter.render.cache import SceneRenderer
from gscompleter.stages.fade_border import FADED_SHARE, fade_border
from gscompleter.stages.target_view import TargetView, render_target
from gscompleter.types import Gaussians, View
from scenes import Room, camera_at, gaussians_of, view_of
from target_views import begin_with

SIZE = 160
TARGET = camera_at(0.0, size=SIZE)
MARGIN = 0.25


def look(photograph: View, margin: float = MARGIN) -> tuple[TargetView, Gaussians]:
    """Return a padded target and additions that fill all of it."""
    scene = gaussians_of(photograph)
    scenes = SceneRenderer(load_renderer("cpu"))
    state = begin_with(scene, [photograph], CompleterConfig())
    view = render_target(state, pad_camera(TARGET, margin), scenes)
    return view, gaussians_of(view_of(Room(), view.camera.padded))


def measure_distances(added: Gaussians, view: TargetView) -> torch.Tensor:
    """Measure the distance of each addition to the border of the padded image, in pixels."""
    pixels, _ = project(added.means, view.camera.padded)
    side = view.camera.padded.width
    return torch.minimum(pixels, side - pixels).amin(dim=-1)


def test_they_fade_outside_of_the_target_alone():
    # The photograph looks to the other side.
    view, added = look(view_of(Room(), camera_at(0.0, yaw=180, size=SIZE)))
    faded = fade_border(added, view)
    width = FADED_SHARE * MARGIN * SIZE
    distance = measure_distances(faded, view)
    full = added.opacities[0]
    assert torch.equal(
        faded.opacities[distance >= width], full.expand(int((distance >= width).sum()))
    )
    outer = faded.opacities[distance < width] / full
    assert (outer - distance[distance < width] / width).abs().max() < 1e-4
    assert outer.min() < 0.2
    # The target sees none of it.
    before = view.frozen.composite(added).crop(view.camera)
    after = view.frozen.composite(faded).crop(view.camera)
    assert torch.equal(before.image, after.image)


def test_what_a_photograph_sees_stays():
    view, added = look(view_of(Room(), camera_at(0.0, size=SIZE, focal=0.4)))
    assert fade_border(added, view) is added


def test_without_padding_nothing_fades():
    view, added = look(view_of(Room(), camera_at(0.0, yaw=180, size=SIZE)), 0.0)
    assert fade_border(added, view) is added
