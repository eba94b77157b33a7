"""Files of a run: what is written is read back, and settings are compared as written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gscompleter.evaluation.methods import Models, Prediction
from gscompleter.evaluation.runner import load_or_reconstruct
from gscompleter.evaluation.store import (
    find_difference,
    load_prediction,
    load_values,
    save_prediction,
    save_values,
)
from gscompleter.generators import load_generator
from gscompleter.render.loading import load_renderer
from gscompleter.types import DepthMap, Gaussians, Reconstruction, View, merge
from scenes import Room, camera_at, gaussians_of, view_of

VIEWS = [view_of(Room(), camera_at(x, size=32)) for x in (0.0, 0.4)]


def make_antialiased() -> Gaussians:
    return replace(merge([gaussians_of(view) for view in VIEWS]), is_antialiased=True)


class MipSplatting:
    """Stands for a network whose Gaussians are those of Mip-Splatting."""

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        truths = [view_of(Room(), view.camera) for view in views]
        valid = torch.ones(32, 32, dtype=torch.bool)
        return Reconstruction(make_antialiased(), tuple(DepthMap(t.depth, valid) for t in truths))


def test_methods_get_an_antialiased_scene_as_it_was_reconstructed(tmp_path):
    """Another scene would be scored: without its mark, thin Gaussians are drawn too opaque."""
    models = Models(MipSplatting(), load_generator("warp-inpaint"), load_renderer("cpu"))
    views = [replace(v, camera=replace(v.camera, near=0.5, far=20.0)) for v in VIEWS]
    loaded = load_or_reconstruct(tmp_path / "context.pt", views, models).gaussians
    assert loaded.is_antialiased
    camera = VIEWS[0].camera
    expected, shown = (
        models.renderer.render(scene, camera).image for scene in (make_antialiased(), loaded)
    )
    assert torch.equal(shown, expected)


def test_what_a_method_added_to_an_antialiased_scene_is_read_back(tmp_path):
    scene = make_antialiased()
    before, added = scene[:1000], scene[1000:]
    save_prediction(tmp_path / "step.pt", Prediction(scene, added, {"total": 1.0}))
    loaded = load_prediction(tmp_path / "step.pt", before)
    assert loaded.scene.is_antialiased
    assert torch.equal(loaded.scene.means, scene.means)
    assert torch.equal(loaded.scene.opacities, scene.opacities)


def test_a_scene_of_a_map_keeps_its_origin(tmp_path: Path):
    scene = replace(make_antialiased(), origin=(4.5e6, -12.25, 0.0))
    save_values(tmp_path / "context.pt", {"gaussians": scene})
    assert load_values(tmp_path / "context.pt", "cpu")["gaussians"].origin == scene.origin


@pytest.mark.parametrize(
    ("existing", "wanted", "difference"),
    [
        ({"a": 1}, {"a": 1}, None),
        ({"a": 1}, {"a": 2}, ("a", 1, 2)),
        ({"a": None}, {}, None),
        ({"a": {"x": None, "y": 1}}, {"a": {"y": 1}}, None),
        ({"a": {"x": None}, "b": 1}, {"a": {}, "b": 2}, ("b", 1, 2)),
        ({"a": {"x": {"y": 1}}}, {"a": {"x": {"y": 2}}}, ("a.x.y", 1, 2)),
        ({"a": {"x": 1}}, {"a": 3}, ("a", {"x": 1}, 3)),
    ],
)
def test_the_first_setting_that_differs_is_named(existing, wanted, difference):
    """A setting that a folder does not have, and one that is not set, are the same."""
    assert find_difference(existing, wanted) == difference
