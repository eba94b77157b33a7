"""Scenes that are kept frozen equal scenes that are frozen anew."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter.render.cache import SceneRenderer
from gscompleter.render.cpu import CpuRenderer
from gscompleter.system.files.mapping import is_mapped, move_to_file
from gscompleter.types import merge
from render_scenes import CAMERA, SCENES
from scenes import Room, camera_at, gaussians_of, view_of

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


@pytest.mark.linux
def test_views_of_a_scene_in_a_file_lie_in_files_too(tmp_path):
    """They are painted over, extended and hidden as those in memory."""
    scene = replace(SCENE, sh=move_to_file(SCENE.sh, tmp_path))
    sh = SCENE.sh.clone()
    sh[::3] = sh[::3].flip(0)
    recolored = replace(scene, sh=move_to_file(sh, tmp_path))
    hidden = recolored.hide(torch.arange(len(SCENE)) % 5 == 0)
    scenes = SceneRenderer(CpuRenderer())
    for parts in [(scene,), (recolored,), (recolored, ADDED), (hidden, ADDED)]:
        (ours,) = scenes.freeze_at(parts, [CAMERA])
        for array in (ours.layer.splats, ours.layer.entries, ours.rows):
            assert is_mapped(array.base), len(parts)
        truth = SceneRenderer(CpuRenderer()).freeze(parts, CAMERA)
        image = truth.render.image
        assert torch.equal(ours.render.image, image)
        assert torch.equal(ours.backproject(image), truth.backproject(image))
        values = torch.rand(sum(map(len, parts)), generator=torch.Generator().manual_seed(0))
        assert torch.equal(ours.splat(values), truth.splat(values))
        assert scenes.freeze_at(parts, [CAMERA])[0] is ours


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


def test_an_image_that_widens_splats_otherwise_is_another_one(frozen_scenes):
    scenes = SceneRenderer(CpuRenderer())
    scenes.freeze_at((SCENE,), [CAMERA])
    (sampled,) = scenes.freeze_at((SCENE,), [replace(CAMERA, blur=0.05)])
    assert len(frozen_scenes) == 2
    plain = CpuRenderer().render(SCENE, CAMERA)
    assert not torch.allclose(sampled.render.alpha, plain.alpha)


@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "antialiased"])
def test_what_is_hidden_is_drawn_again_only_where_it_showed(frozen_scenes, antialiased):
    camera = camera_at(size=96)
    wall = replace(gaussians_of(view_of(Room(), camera)), is_antialiased=antialiased)
    behind = replace(wall, means=1.2 * wall.means, scales=1.2 * wall.scales)
    scene = merge([wall, behind])
    parts = (scene, replace(ADDED[::2], is_antialiased=antialiased))
    later = replace(ADDED[1::2], is_antialiased=antialiased)
    scenes = SceneRenderer(CpuRenderer())
    (before,) = scenes.freeze_at(parts, [camera])

    left = wall.means[:, 0] < -0.5
    gone = torch.cat([left, torch.zeros(len(behind)).bool()])
    for hidden in (gone, gone | (scene.means[:, 1] < -0.9)):
        # Once more, so that what was hidden before stays hidden.
        parts = (parts[0].hide(hidden), *parts[1:])
        (ours,) = scenes.freeze_at(parts, [camera])
        assert len(frozen_scenes) == 1
        truth = CpuRenderer().freeze(scene.hide(hidden), camera).extend(parts[1])
        frozen_scenes.pop()
        assert not torch.equal(ours.render.image, before.render.image)
        assert (ours.render.image == before.render.image).all(dim=-1).float().mean() > 0.3
        image = torch.rand(truth.render.image.shape, generator=torch.Generator().manual_seed(0))
        assert torch.equal(ours.backproject(image), truth.backproject(image))
        values = image.flatten()[: len(scene) + len(parts[1])]
        assert torch.equal(ours.splat(values), truth.splat(values))
        for drawn, expected in (
            (ours.render, truth.render),
            (ours.composite(later), truth.composite(later)),
            (ours.extend(later).render, truth.extend(later).render),
        ):
            for name in ("image", "depth", "alpha"):
                assert torch.equal(getattr(drawn, name), getattr(expected, name)), name
        assert np.array_equal(ours.depth_limits, truth.depth_limits)
        assert len(ours.rows) == len(set(ours.rows.tolist())) == len(truth.rows)


def test_what_appears_is_frozen_anew(frozen_scenes):
    scenes = SceneRenderer(CpuRenderer())
    scenes.freeze_at((SCENE.hide(SCENE.means[:, 0] < 0),), [CAMERA])
    scenes.freeze_at((SCENE,), [CAMERA])
    assert len(frozen_scenes) == 2
