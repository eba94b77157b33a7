"""Photographs that a given scene does not reproduce are what it is recoloured to."""

from dataclasses import replace

import pytest
import torch

from gscompleter import GSCompleter, load_renderer
from gscompleter.config import CompleterConfig
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.numerics.geometry import is_inside, project
from gscompleter.parts import NOT_INVENTED
from gscompleter.render.cache import SceneRenderer
from gscompleter.stages.new_photos import find_new_photos
from gscompleter.types import Gaussians, View, merge, sh_from_rgb
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 64
RENDERER = load_renderer("cpu")
PHOTOS = [view_of(Room(), camera_at(x, size=SIZE), k) for k, x in enumerate((-0.3, 0.0, 0.3))]
ASIDE = view_of(Room(), camera_at(0.5, yaw=50, size=SIZE), 3)


def make_wrong_scene() -> Gaussians:
    """Make the room as three photographs show it, with wrong colours where they do not look."""
    surfaces = merge([gaussians_of(PHOTOS[0]), gaussians_of(PHOTOS[2])])
    beside = gaussians_of(ASIDE)
    seen = [is_inside(*project(beside.means, view.camera), view.camera) for view in PHOTOS]
    beside = beside[~torch.stack(seen).any(dim=0)]
    random = torch.rand(len(beside), 3, generator=torch.Generator().manual_seed(0))
    return merge([surfaces, replace(beside, sh=sh_from_rgb(random))])


SCENE = make_wrong_scene()
PHOTOS = [replace(v, image=RENDERER.render(SCENE, v.camera).image.clamp(0, 1)) for v in PHOTOS]
"""The photographs that the scene was trained on: it reproduces them."""


def find(views: list[View], config: CompleterConfig) -> list[int]:
    return find_new_photos(config, (SCENE,), views, SceneRenderer(RENDERER))


def test_only_a_photograph_that_the_scene_does_not_reproduce_is_new():
    assert find([*PHOTOS, ASIDE], CompleterConfig.splat()) == [3]
    assert find(PHOTOS, CompleterConfig.splat()) == []


def test_another_exposure_is_reproduced():
    darker = replace(PHOTOS[1], image=0.7 * PHOTOS[1].image)
    assert find([PHOTOS[0], darker, PHOTOS[2]], CompleterConfig.splat()) == []


def test_with_full_trust_none_is_new():
    assert find([*PHOTOS, ASIDE], CompleterConfig()) == []


@pytest.mark.parametrize("exposure", [1.0, 0.8])
def test_the_scene_is_recoloured_to_a_new_photograph_and_no_other_gets_worse(exposure):
    new = replace(ASIDE, image=exposure * ASIDE.image)
    done = GSCompleter().begin(PHOTOS[:2], SCENE, [PHOTOS[2], new])
    assert done.num_new_photos == 1
    before, after = (RENDERER.render(scene, ASIDE.camera).image for scene in (SCENE, done.scene))
    assert psnr(after, ASIDE.image) > psnr(before, ASIDE.image) + 3
    for view in PHOTOS:
        assert psnr(RENDERER.render(done.scene, view.camera).image, view.image) > 45
    assert set(done.scene.generated.unique().tolist()) == {0, NOT_INVENTED}
    assert done.next_target_id == 1
    assert torch.equal(done.context.sh, SCENE.sh)
