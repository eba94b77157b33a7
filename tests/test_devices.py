"""Everything works where its tensors lie: nothing brings in a tensor of another device."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from elsewhere import DEVICE, Elsewhere, MixedError, There, without_autocast
from gscompleter import GSCompleter, load_reconstructor, load_renderer
from gscompleter.apps.live.difference import PageScene
from gscompleter.apps.live.session import Session, SessionStep, apply_step, save_camera
from gscompleter.config import CompleterConfig
from gscompleter.evaluation.baselines.optimization import OptimizationConfig, optimize
from gscompleter.evaluation.baselines.reggs import RegGSConfig, register_by_similarity
from gscompleter.evaluation.metrics.scores import Truth, score
from gscompleter.generators.agreement import compare_with_observed
from gscompleter.models.depth_anything import (
    AnyViewDepth,
    AnyViewGaussians,
    DepthAnything,
    DepthAnythingConfig,
    Inference,
    ResizeConfig,
)
from gscompleter.models.depth_anything.config import VitConfig
from gscompleter.models.diffusion.position_ids import compute_source_ids
from gscompleter.models.diffusion.source_depth import (
    compute_context_depth,
    convert_disparity,
    rescale_depth,
)
from gscompleter.models.feed_forward import (
    DepthSplat,
    FeedForward,
    MVSplat,
    VolSplat,
    VolSplatConfig,
)
from gscompleter.models.feed_forward.depth_predictor import DepthConfig
from gscompleter.models.feed_forward.depthsplat import VARIANTS
from gscompleter.reconstructors import Reconstructor, run_reconstructor
from gscompleter.reconstructors.from_depth import FromDepth
from gscompleter.stages.context import measure_depth_range
from gscompleter.stages.filter_holes import select_in_mask
from gscompleter.stages.lift import lift_pair
from gscompleter.system.tensor_checks import iterate_tensors
from gscompleter.types import Lift, Reconstruction, View
from scenes import Room, camera_at, gaussians_of, view_of

REFERENCE = load_renderer("reference")
SWEEP = load_reconstructor("plane-sweep")
SIZE = 20
VIEWS = [view_of(Room(), camera_at(x, size=SIZE), i) for i, x in enumerate((-0.3, 0.1))]
TARGET = camera_at(0.5, yaw=10, size=SIZE)


@pytest.fixture
def elsewhere(monkeypatch) -> Iterator[None]:
    without_autocast(monkeypatch)
    with Elsewhere():
        yield


@pytest.fixture
def views(elsewhere) -> list[View]:
    return [view.to(DEVICE) for view in VIEWS]


def check_there(value: object) -> None:
    """Check that a frozen value has tensors, all of them elsewhere."""
    found = dict(iterate_tensors(value, "it"))
    assert found
    assert [name for name, tensor in found.items() if not isinstance(tensor, There)] == []


def few_steps(config: CompleterConfig) -> CompleterConfig:
    """Reduce the stages to a few steps."""
    name = "registration" if config.registration_method == "ours" else "paper_registration"
    registration = replace(getattr(config, name), iterations=2)
    refine = replace(config.refine, iterations=2, color_rounds=1)
    recolor = replace(config.recolor, iterations=1)
    return replace(config, **{name: registration}, refine=refine, recolor=recolor)


# tests/test_fake_device.py has the same, where the wheel of gsplat is at hand.
@pytest.mark.slow
@pytest.mark.parametrize("config", [CompleterConfig(), CompleterConfig.paper()])
def test_a_completion_stays_on_the_device_of_its_views_and_is_that_of_the_cpu(views, config):
    complete = GSCompleter(renderer=REFERENCE, config=few_steps(config))
    done, plain = complete(views, TARGET.to(DEVICE)), complete(VIEWS, TARGET)
    check_there(done)
    assert len(done.added) > 0
    assert torch.equal(done.scene.means.cpu(), plain.scene.means)
    assert torch.equal(done.scene.opacities.cpu(), plain.scene.opacities)


@pytest.mark.slow
def test_a_session_in_the_browser_stays_on_the_device_of_its_views(views):
    config = few_steps(CompleterConfig.splat())
    completer = GSCompleter(renderer=REFERENCE, config=config)
    scene = gaussians_of(VIEWS[0]).to(views[0].image.device)
    begun = completer.begin(views, scene)
    session = Session(completer, (begun,), np.eye(4), np.zeros(3))
    page = PageScene(begun.context)
    pixels = np.zeros((SIZE, SIZE), dtype=np.uint8)
    pixels[6:14, 6:14] = 255
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    marks = file.getvalue()
    camera = save_camera(session, VIEWS[1].camera)
    for step in (
        SessionStep("remove", camera, marks),
        SessionStep("fill", camera, marks),
        SessionStep("remove", camera, box=(-0.6, 0.2, 2.1, 0.4, 1.47, 3.1)),
    ):
        session, _ = apply_step(session, step)
        chunks = page.describe(session.latest)["chunks"]
        check_there(session.latest.scene)
    assert len(session.steps) == 3
    assert [chunk["name"] for chunk in chunks][:2] == ["observed", "added-1"]


@pytest.mark.slow
@pytest.mark.parametrize("ψ", ["mvsplat", "depthsplat", "volsplat"])
def test_networks_reconstruct_where_the_views_lie_and_run_where_they_lie_themselves(elsewhere, ψ):
    torch.manual_seed(0)
    depth = DepthConfig("vits", 1, 4, 4)
    network = {
        "mvsplat": MVSplat,
        "depthsplat": lambda: DepthSplat(VARIANTS["small-re10k-256x256"]),
        "volsplat": lambda: VolSplat(VolSplatConfig(depth, voxel_resolution=0.02)),
    }[ψ]().eval()
    pair = [view_of(Room(), camera_at(x, size=64), i) for i, x in enumerate((-0.3, 0.1))]
    network.requires_grad_(False)
    there = [view.to(DEVICE) for view in pair]
    check_there(run_reconstructor(FeedForward(network), there))
    moved = FeedForward(network.to(DEVICE))
    check_there(lift_pair(moved, *there))
    assert not any(
        isinstance(tensor, There)
        for _, tensor in iterate_tensors(run_reconstructor(moved, pair), "it")
    )


@pytest.mark.parametrize("gaussians", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_depth_anything_reconstructs_where_the_views_lie(elsewhere, gaussians):
    torch.manual_seed(0)
    vit = VitConfig(64, 1, 4, (0, 1, 2, 3), 1)
    network = DepthAnything(DepthAnythingConfig(vit, 32, (16,) * 4, gaussians)).eval()
    network.requires_grad_(False)
    pair = [view_of(Room(), camera_at(x, size=56), i) for i, x in enumerate((-0.3, 0.1))]
    there = [view.to(DEVICE) for view in pair]

    def psi() -> Reconstructor:
        inference = Inference(ResizeConfig(56))
        if gaussians:
            return AnyViewGaussians(network, inference)
        return FromDepth(model=AnyViewDepth(network, inference))

    check_there(run_reconstructor(psi(), there))
    network.to(DEVICE)
    check_there(lift_pair(psi(), *there))
    assert not any(
        isinstance(tensor, There)
        for _, tensor in iterate_tensors(run_reconstructor(psi(), pair), "it")
    )


def test_a_given_scene_tells_its_depth_range_anywhere(views):
    scene = gaussians_of(VIEWS[0]).to(DEVICE)
    near, far = measure_depth_range(scene, [view.camera for view in views], REFERENCE)
    assert 0 < near < far


@pytest.mark.slow
def test_baselines_fit_on_any_device(views):
    scene = gaussians_of(VIEWS[0]).to(DEVICE)
    steps = OptimizationConfig(iterations=3, density_rounds=1, gradient_threshold=0.0)
    fitted = optimize(scene, views, REFERENCE, config=steps)
    check_there(fitted)
    plain = optimize(gaussians_of(VIEWS[0]), VIEWS, REFERENCE, config=steps)
    assert torch.allclose(fitted.means.cpu(), plain.means)
    found = register_by_similarity(
        gaussians_of(VIEWS[1]).to(DEVICE),
        scene,
        views[1],
        REFERENCE,
        config=RegGSConfig(iterations=2, components=20),
    )
    check_there(found)


def test_scores_are_those_of_the_cpu(views):
    def scores(views: list[View], device: str | torch.device):
        scene, added = (gaussians_of(view).to(device) for view in VIEWS)
        target = view_of(Room(), TARGET).to(device)
        return score(scene, added, added, Truth(tuple(views), target, tuple(views)), REFERENCE)[0]

    assert scores(views, DEVICE) == scores(VIEWS, "cpu")


def test_what_diffusion_is_told_is_made_on_any_device(views):
    render = REFERENCE.render(gaussians_of(VIEWS[0]).to(DEVICE), views[0].camera)
    depth = compute_context_depth(views[0], render)
    guess = (2 / depth.clamp_min(0.1)).detach()
    check_there((depth, rescale_depth(guess, render), convert_disparity(guess, render)))
    check_there(compute_source_ids(depth, views[0].camera, TARGET.to(DEVICE), (8, 8), (8, 8)))
    known = render.alpha > 0.5
    check_there(compare_with_observed(views[0].image, views[1].image, known))


@pytest.mark.parametrize(
    "name",
    [
        "gaussians",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("view_index", "pixel_index", "depths")),
    ],
)
def test_a_model_that_leaves_a_tensor_on_the_cpu_is_named_with_it(views, name):
    def careless(given: list[View]) -> Reconstruction:
        whole = SWEEP(given)
        part = getattr(whole, name)
        left = (
            tuple(replace(d, valid=d.valid.cpu()) for d in part)
            if name == "depths"
            else (part.to("cpu"))
        )
        return replace(whole, **{name: left})

    for stage in (lambda: run_reconstructor(careless, views), lambda: lift_pair(careless, *views)):
        # Parts of one value are compared where it is made, and its device with that of the views.
        sentence = r"have to be on one device, and its \w+ is on .* on cpu|is on cpu while others"
        with pytest.raises(
            ValueError, match=f"returned the reconstruction.{name}.* on cpu|{sentence}"
        ):
            stage()


def test_a_mixture_of_devices_is_an_error_as_on_a_gpu(views):
    found = lift_pair(SWEEP, views[0], views[1])
    mask = torch.ones(SIZE, SIZE, dtype=torch.bool, device=DEVICE)
    assert isinstance(found, Lift)
    with pytest.raises(MixedError):
        select_in_mask(found.gaussians, found.pixel_index.cpu(), mask, views[0].camera)
    there = views[0].image
    for mixed in (
        lambda: there + VIEWS[0].image,
        lambda: VIEWS[0].image * there.mean(),
        lambda: torch.stack([there.mean(), torch.tensor(1.0)]),
        lambda: torch.rand(3, device=DEVICE, generator=torch.Generator()),
    ):
        with pytest.raises(MixedError):
            mixed()
    with pytest.raises(RuntimeError, match="numpy"):
        there.numpy()
    assert isinstance(there + torch.tensor(1.0), There)
    assert there.new_tensor([1.0, 2.0]).tolist() == [1.0, 2.0]
