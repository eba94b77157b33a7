"""Plane-sweep Ψ on differently exposed photographs: one scene of normalized exposure."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter import GSCompleter, View, load_renderer
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.reconstructors.plane_sweep import PlaneSweep, gaussians
from gscompleter.reconstructors.plane_sweep.fusion import DepthLayer, estimate_gains
from gscompleter.reconstructors.plane_sweep.rig import build_rig
from scenes import Room, camera_at, view_of

SIZE = 64
EXPOSURES = torch.tensor([[1.2, 1.2, 1.2], [0.8, 0.8, 0.8], [1.0, 1.1, 0.9], [0.9, 1, 1.12]])
"""Exposures of four photographs; the last two differ in white balance, too."""
PLACES = (-0.4, -0.2, 0.2, 0.4)
"""Camera positions."""
GAINS = EXPOSURES / EXPOSURES.log().mean(dim=0).exp()
"""Exposures relative to their mean."""


def even_views(size: int = SIZE) -> list[View]:
    """Return views of the cameras in one exposure."""
    return [view_of(Room(), camera_at(x, size=size)) for x in PLACES]


def photographs(size: int = SIZE) -> list[View]:
    """Return the same views with individual exposures, clipped at white."""
    return [
        replace(view, image=(view.image * exposure).clamp(0, 1))
        for view, exposure in zip(even_views(size), EXPOSURES, strict=True)
    ]


def found_gains(views: list[View]) -> np.ndarray:
    """Gains that perfect stereo gives."""
    rig = build_rig(views)
    inverses = [np.float32(rig.unit) / view.depth.numpy() for view in views]
    layers = [DepthLayer(i, d, np.ones_like(d)) for i, d in zip(rig.images, inverses, strict=True)]
    return estimate_gains(layers, rig.transforms)


def at_best_gain(image: torch.Tensor, truth: torch.Tensor) -> float:
    """Compute the PSNR in dB after the best single gain for all pixels and channels."""
    return psnr(image * (image * truth).sum() / image.square().sum(), truth)


@pytest.fixture(scope="module")
def made():
    return PlaneSweep()(photographs())


@pytest.fixture(scope="module")
def uneven():
    """Reconstruction of the same photographs without exposure correction."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gaussians, "estimate_gains", lambda layers, _: np.ones((len(layers), 3)))
        return PlaneSweep()(photographs())


def test_gains_are_told_by_what_photographs_share():
    np.testing.assert_allclose(found_gains(photographs()), GAINS, rtol=0.01)


def test_photographs_that_are_exposed_alike_stay_as_they_are():
    assert (found_gains(even_views()) == 1).all()
    hardly = [
        replace(v, image=v.image * g) for v, g in zip(even_views(), (1, 0.9, 1, 0.8), strict=True)
    ]
    assert (found_gains(hardly) == 1).all()


def test_photographs_that_share_nothing_are_not_compared():
    there = [view_of(Room(), camera_at(x, size=SIZE)) for x in (0.0, 0.2)]
    back = [view_of(Room(), camera_at(x, yaw=180.0, size=SIZE)) for x in (0.0, 0.2)]
    back = [replace(view, image=view.image * 0.8) for view in back]
    assert (found_gains([*there, *back]) == 1).all()
    back[1] = replace(back[1], image=back[1].image * 0.6)
    gains = found_gains([*there, *back])
    np.testing.assert_allclose(gains[:2], 1.0, rtol=1e-6)
    np.testing.assert_allclose(gains[2:, 0], [0.6**-0.5, 0.6**0.5], rtol=0.02)


def test_a_channel_that_is_black_tells_nothing_and_disturbs_no_other():
    yellow = [replace(v, image=v.image * torch.tensor([1.0, 1.0, 0.0])) for v in photographs()]
    gains = found_gains(yellow)
    assert np.abs(np.log(gains[:, 2])).max() <= np.abs(np.log(gains[:, :2])).max()
    np.testing.assert_allclose(gains[:, :2], GAINS[:, :2], rtol=0.01)


def test_gains_are_found_through_stereo(made):
    np.testing.assert_allclose(made.exposure_gains, GAINS, rtol=0.01)


def test_the_scene_has_one_exposure_and_shows_places_between_better(made, uneven):
    renderer, ratios = load_renderer("cpu"), []
    for x in (-0.3, 0.0, 0.3):
        truth = view_of(Room(), camera_at(x, size=SIZE))
        even, mixed = (renderer.render(m.gaussians, truth.camera).image for m in (made, uneven))
        assert at_best_gain(even, truth.image) > at_best_gain(mixed, truth.image) + 0.5
        ratios.append((even * truth.image).sum((0, 1)) / even.square().sum((0, 1)))
    # Each channel has the same error of brightness at all positions. What was clipped at white
    # remains, as colours by direction keep it near the photograph that shows it.
    assert (torch.stack(ratios).amax(0) / torch.stack(ratios).amin(0)).max() < 1.02


def test_each_photograph_is_what_is_drawn_times_its_gain(made):
    renderer = load_renderer("cpu")
    for view, gain in zip(photographs(), made.exposure_gains, strict=True):
        image = renderer.render(made.gaussians, view.camera).image
        assert psnr(gain * image, view.image) > 26
        assert psnr(image, view.normalize_exposure(gain).image) > 26


def test_two_photographs_keep_their_exposures():
    views = photographs(size=32)[:2]
    assert PlaneSweep()(views).exposure_gains is None


def test_a_completion_goes_on_with_photographs_in_the_exposure_of_the_scene(made):
    begun = GSCompleter(reconstructor=lambda views: made).begin(photographs())
    mean = EXPOSURES.log().mean(dim=0).exp()
    for view, given, even in zip(begun.views, photographs(), even_views(), strict=True):
        truth = (even.image * mean).clamp(0, 1)
        assert psnr(view.image, truth) > max(26, psnr(given.image, truth) + 2)
