"""Scenes that are kept frozen equal scenes that are frozen anew."""

from dataclasses import replace

import pytest
import torch

from gscompleter.render.cache import SceneRenderer
from gscompleter.render.cpu import CpuRenderer
from render_scenes import CAMERA, SCENES

SCENE, ADDED = SCENES["harmonics"][::2], SCENES["harmonics"][1::2]


@pytest.fixture
def frozen_scenes(monkeypatch) -> list:
    """Scenes that were frozen from the start, in their order."""
    scenes = []
    freeze = CpuRenderer.freeze

    def count(self, context, camera):
        scenes.append(context)
        return freeze(self, context, camera)

    monkeypatch.setattr(CpuRenderer, "freeze", count)
    return scenes


@pytest.mark.parametrize("is_longer", [False, True])
def test_a_recoloured_scene_is_painted_over(frozen_scenes, is_longer):
    scenes = SceneRenderer(CpuRenderer())
    parts = (SCENE, ADDED[::2])
    scenes.freeze_at(parts, [CAMERA])
    assert frozen_scenes == [SCENE]

    sh = SCENE.sh.clone()
    sh[::3] = sh[::3].flip(0)
    labels = SCENE.generated.clone()
    labels[::3] = 1
    recolored = (replace(SCENE, sh=sh, generated=labels), *parts[1:])
    if is_longer:
        recolored = (*recolored, ADDED[1::2])
    (ours,) = scenes.freeze_at(recolored, [CAMERA])
    assert len(frozen_scenes) == 1
    truth = SceneRenderer(CpuRenderer()).freeze(recolored, CAMERA)
    for name in ("image", "depth", "alpha"):
        assert torch.equal(getattr(ours.render, name), getattr(truth.render, name)), name
    image = truth.render.image
    assert torch.equal(ours.backproject(image), truth.backproject(image))


@pytest.mark.parametrize(
    "change",
    [
        {"means": SCENE.means.clone()},
        {"opacities": 0.5 * SCENE.opacities},
        {"sh": SCENE.sh[:, :1]},
        {"is_antialiased": True},
    ],
)
def test_another_scene_is_frozen_anew(frozen_scenes, change):
    scenes = SceneRenderer(CpuRenderer())
    scenes.freeze_at((SCENE,), [CAMERA])
    scenes.freeze_at((replace(SCENE, **change),), [CAMERA])
    assert len(frozen_scenes) == 2
