"""The renderer of a Mac's GPU: its twin in PyTorch draws here what our renderers draw."""

import importlib.util
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import avg_pool2d

from fake_gsplat import find_package
from gscompleter import CompleterConfig, GSCompleter, InputError, load_renderer
from gscompleter.config import GapConfig
from gscompleter.numerics.geometry import pad_camera, sample_image, shrink_camera
from gscompleter.render.metal import MetalRenderer, explain_missing_metal
from parity import assert_close
from render_scenes import (
    CAMERA,
    REFERENCE,
    SCENES,
    beside,
    compute_gradients,
    find_covered_pixels,
    in_dtype,
)
from scenes import Room, camera_at, gaussians_of, view_of

WHEEL = "metal_gauss-0.2.1-py3-none-any.whl"
ROUNDING = 1e-5
"""Largest difference, of the largest value. At most 4.2e-6 was measured."""
# In the room all Gaussians of a wall have one depth, and which of them covers the other is open.
UNORDERED = "room"
ORDERED = [name for name in SCENES if UNORDERED not in name]


@pytest.fixture
def twin(monkeypatch) -> MetalRenderer:
    """Return the adapter on the CPU, with the twin in place of the kernels."""
    place = find_package("metal_gauss", WHEEL)
    if place is None:
        pytest.skip(f"needs {WHEEL} in .whl: pip download --no-deps metal-gauss -d .whl")
    monkeypatch.syspath_prepend(str(place))
    return MetalRenderer("torch_ref", "cpu")


@pytest.mark.parametrize("name", ORDERED)
def test_the_twin_draws_what_the_reference_draws(twin, name):
    drawn = twin.render(SCENES[name], CAMERA)
    truth = REFERENCE.render(in_dtype(SCENES[name], torch.float64), CAMERA)
    covered = truth.alpha > 0.01
    assert covered.any()
    assert_close(drawn.image, truth.image, "image", ROUNDING)
    assert_close(drawn.alpha, truth.alpha, "alpha", ROUNDING)
    assert_close(drawn.depth * covered, truth.depth * covered, "depth", ROUNDING)


@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "antialiased"])
def test_the_twin_draws_in_a_padded_image_what_the_image_shows_that_it_pads(twin, antialiased):
    scene = replace(beside(CAMERA), is_antialiased=antialiased)
    pair = pad_camera(CAMERA, 0.25)
    truth = REFERENCE.render(in_dtype(scene, torch.float64), CAMERA)
    leaf = scene.opacities.clone().requires_grad_()
    drawn = twin.render(replace(scene, opacities=leaf), pair.padded)
    assert_close(pair.crop(drawn.image), truth.image, "image", ROUNDING)
    assert_close(pair.crop(drawn.alpha), truth.alpha, "alpha", ROUNDING)
    (gradient,) = torch.autograd.grad(drawn.alpha.sum(), leaf)
    assert gradient.isfinite().all()
    assert (gradient > 0).float().mean() > 0.5


@pytest.mark.parametrize("name", ORDERED)
def test_the_twin_has_the_gradients_of_the_reference(twin, name):
    covered = find_covered_pixels(name)
    truth = compute_gradients(REFERENCE, in_dtype(SCENES[name], torch.float64), covered)
    found = compute_gradients(twin, SCENES[name], covered)
    for parameter, expected in truth.items():
        assert_close(found[parameter], expected, f"gradient of {parameter}", ROUNDING)


def test_the_twin_averages_the_large_image_that_a_small_one_samples(twin):
    large = camera_at(size=64)
    photograph = view_of(Room(), large)
    scene = gaussians_of(photograph)
    small = sample_image(shrink_camera(large, 16), large)
    drawn = twin.render(scene, small)
    truth = avg_pool2d(twin.render(scene, large).image.permute(2, 0, 1), 4).permute(1, 2, 0)
    assert drawn.image.shape == (16, 16, 3)
    assert_close(drawn.image, truth, "image", ROUNDING)
    at_true = drawn.depth / avg_pool2d(photograph.depth[None], 4)[0] - 1
    # Discs of a coarse photograph bring depths nearer by 2 %.
    assert at_true.abs().median() < 0.03


def test_nothing_is_black(twin):
    nothing = gaussians_of(view_of(Room(), camera_at(size=8)))[:0]
    drawn = twin.render(nothing, CAMERA)
    assert drawn.image.shape == (CAMERA.height, CAMERA.width, 3)
    assert not drawn.alpha.any()


# The tests above compare its images and gradients.
@pytest.mark.slow
def test_a_given_scene_is_completed_with_it(twin):
    views = [view_of(Room(), camera_at(x, size=24), i) for i, x in enumerate((-0.3, 0.1))]
    target = camera_at(0.5, yaw=10, size=24)
    scene = gaussians_of(views[0])
    # The twin takes a second for an image that the kernels draw in a thousandth.
    config = CompleterConfig()
    config = replace(
        config,
        guards=("contribution",),
        add_observed=False,
        margin=0.0,
        registration=replace(config.registration, iterations=2),
        refine=replace(config.refine, color_rounds=1, iterations=2),
        gaps=GapConfig(displacement=0.0),
    )
    ours = GSCompleter(config=config)(views, target, scene)
    done = GSCompleter(renderer=twin, config=config)(views, target, scene)
    assert len(done.added) > 20
    # Both fill the same hole; which Gaussians of a wall cover others differs.
    assert len(done.added) == pytest.approx(len(ours.added), rel=0.2)
    hole = ours.targets[0].hole_mask
    assert (done.targets[0].hole_mask != hole).float().mean() < 0.02
    assert done.targets[0].after.alpha[hole].mean() > 0.5


@pytest.mark.skipif(torch.backends.mps.is_available(), reason="there is a GPU of a Mac")
def test_without_a_mac_it_is_refused():
    assert explain_missing_metal() == "torch sees no GPU of a Mac"
    with pytest.raises(InputError, match="mps cannot draw: torch sees no GPU of a Mac"):
        load_renderer("metal")


def test_without_the_package_it_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert "gscompleter[metal]" in explain_missing_metal("cpu")
