"""What a GPU is asked to do, on a CUDA device that is none: see `support/fake_cuda.py`.

No tensors of two devices meet, gsplat is given float32 alone, nothing reads memory that its kernels
leave unset, and no stage makes the host wait more often than it has to. What commands do there is
in `test_commands_on_a_device.py`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from fake_cuda import CUDA, Counts, FakeCudaTensor, get_device
from fake_gsplat import WHEEL, fake_gsplat, find_gsplat
from gscompleter import CompleterConfig, GSCompleter, load_renderer
from gscompleter.apps.inputs.memory import estimate_gpu_memory
from gscompleter.config import GapConfig
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.numerics.geometry import pad_camera, project
from gscompleter.reconstructors import PartReconstructor, load_reconstructor
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from gscompleter.reconstructors.plane_sweep.depth_devices import DEPTH_DEVICES, CpuDepth
from gscompleter.reconstructors.plane_sweep.gaussians import DISC_BYTES
from gscompleter.render.device import Devices, choose_devices
from gscompleter.render.gsplat import TILE_SIZE, CudaRenderer, drop_colors
from gscompleter.render.protocols import OpacityRender
from gscompleter.render.redraw import RedrawnScene
from gscompleter.system.timing import STAGES
from gscompleter.types import DepthMap, Gaussians, View, merge
from parity import assert_close
from render_scenes import CAMERA, REFERENCE, SCENES, beside, compute_gradients, in_dtype
from scenes import Room, camera_at, gaussians_of, view_of

pytestmark = [
    pytest.mark.skipif(
        find_gsplat() is None,
        reason=f"needs {WHEEL} in .whl: pip download --no-deps gsplat==1.5.3 -d .whl",
    ),
    pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU"),
]

CONFIGS = {
    "default": replace(CompleterConfig(), gaps=GapConfig(displacement=0.0)),
    "with gaps": CompleterConfig(),
    "paper": CompleterConfig.paper(),
}
SIZE = 24
"""Sides of the photographs in pixels. The counts hardly depend on them."""
MOST_WAITS = {
    # A plan waits twice: for the number of intersections, and for what its tiles show.
    "default": {"context": 139, "generate": 40, "lift": 37, "register": 14, "integrate": 37},
    # Closing thin gaps asks all guards once more for each of five cameras, and here `psnr` in
    # several rounds.
    "with gaps": {"context": 139, "generate": 40, "lift": 37, "register": 14, "integrate": 340},
    "paper": {"context": 78, "generate": 44, "lift": 53, "register": 55, "integrate": 10},
}
"""Waits of the host in each stage of a completion of two photographs (docs/performance.md)."""


MOST_BYTES = {"default": 710, "with gaps": 950, "paper": 650}
"""Bytes that the device holds at most at once, for each Gaussian of the completed scene."""
BYTES_SHOWN = 4 * 3 + 8
"""Bytes of the colour of a Gaussian and of its row in the scene."""
BYTES_OF_A_PART = 4 * 3
"""Bytes of the one colour that stands for those of a part of a scene."""


@pytest.fixture
def device() -> Iterator[Counts]:
    with fake_gsplat() as counts:
        yield counts


def make_views(places: tuple[float, ...] = (-0.3, 0.1)) -> list[View]:
    return [view_of(Room(), camera_at(x, size=SIZE), i) for i, x in enumerate(places)]


def test_tensors_of_two_devices_do_not_meet(device):
    there = torch.ones(2, 3).to("cuda")
    assert there.device == CUDA
    assert torch.zeros(2, device=there.device).is_cuda
    assert there[:1].new_tensor([1.0, 2.0]).is_cuda
    # A single number may be of the host; several, or a position to copy it to, may not.
    assert (there * torch.tensor(2.0)).tolist() == [[2.0] * 3] * 2
    for mix in (
        lambda: there + torch.ones(2, 3),
        lambda: torch.ones(2, 3) @ there.T,
        lambda: torch.cat([there[0], torch.ones(3)]),
        lambda: torch.stack([there.mean(), torch.tensor(1.0)]),
        lambda: torch.ones(2)[there[0].long()],
    ):
        with pytest.raises(RuntimeError, match="same device"):
            mix()
    with pytest.raises(RuntimeError, match="generator"):
        torch.rand(3, device="cuda", generator=torch.Generator())
    for read in (there.numpy, lambda: np.asarray(there)):
        with pytest.raises(TypeError, match="numpy"):
            read()


def test_gradients_cross_between_devices(device):
    here = torch.ones(3, requires_grad=True)
    loss = (here.to("cuda") ** 2).cpu().sum()
    (gradient,) = torch.autograd.grad(loss, here)
    assert gradient.device.type == "cpu"
    assert gradient.tolist() == [2.0] * 3


def test_waits_are_counted_where_the_host_reads_or_copies(device):
    values = torch.arange(4.0).to("cuda")
    assert device.waits.total() == 1
    values[values > 2] = 0.0  # one number for all of them needs no positions
    assert torch.where(values > 0, values, 1.0).sum().is_cuda
    assert device.waits.total() == 1
    for wait in (
        lambda: values.sum().item(),
        lambda: values[values > 0],
        lambda: values.nonzero(),
        lambda: values.cpu(),
        lambda: values.tolist(),
        lambda: values.new_tensor([1.0, 2.0]),
        lambda: torch.linalg.inv(torch.eye(2, device="cuda")),
        lambda: bool(values.any()),
    ):
        before = device.waits.total()
        wait()
        assert device.waits.total() == before + 1


@pytest.mark.parametrize("name", ["strange-harmonics", "antialiased-random"])
def test_gsplat_draws_what_the_reference_draws(device, name):
    scene, exact = SCENES[name], in_dtype(SCENES[name], torch.float64)
    drawn = CudaRenderer().render(scene.to("cuda"), CAMERA.to("cuda"))
    truth = REFERENCE.render(exact, CAMERA)
    for part in ("image", "alpha"):
        assert_close(getattr(drawn, part).cpu(), getattr(truth, part), part, 1e-5)
    covered = truth.alpha > 0.05
    assert_close(drawn.depth.cpu() * covered, truth.depth * covered, "depth", 1e-5)
    ours = compute_gradients(
        CudaRenderer(), scene.to("cuda"), covered.to("cuda"), CAMERA.to("cuda")
    )
    for parameter, expected in compute_gradients(REFERENCE, exact, covered).items():
        assert_close(ours[parameter].cpu(), expected, f"gradient of {parameter}", 1e-4)


@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "antialiased"])
def test_gsplat_draws_in_a_padded_image_what_the_image_shows_that_it_pads(device, antialiased):
    scene = replace(beside(CAMERA), is_antialiased=antialiased)
    exact = in_dtype(scene, torch.float64)
    pair = pad_camera(CAMERA, 0.25)
    there = pair.padded.to("cuda")
    drawn = CudaRenderer().render(scene.to("cuda"), there)
    alone = CudaRenderer().render(scene.to("cuda"), CAMERA.to("cuda"))
    assert_close(pair.crop(drawn.alpha).cpu(), alone.alpha.cpu(), "alpha", 1e-5)
    assert_close(pair.crop(drawn.image).cpu(), alone.image.cpu(), "image", 1e-5)
    truth = REFERENCE.render(exact, pair.padded)
    assert_close(drawn.alpha.cpu(), truth.alpha, "alpha", 1e-5)
    covered = truth.alpha > 0.05
    ours = compute_gradients(CudaRenderer(), scene.to("cuda"), covered.to("cuda"), there)
    for parameter, expected in compute_gradients(REFERENCE, exact, covered, pair.padded).items():
        assert_close(ours[parameter].cpu(), expected, f"gradient of {parameter}", 1e-4)


def test_a_padded_image_and_another_are_drawn_at_once(device):
    scene = beside(CAMERA).to("cuda")
    camera, other = pad_camera(CAMERA, 0.25).padded.to("cuda"), CAMERA.to("cuda")
    first, second = CudaRenderer().render_together(scene, [camera, other])
    for render, alone in ((first, camera), (second, other)):
        assert torch.equal(render.alpha, CudaRenderer().render(scene, alone).alpha)


def test_what_kernels_leave_unset_is_nan_and_is_not_read(device):
    scene = SCENES["strange"].to("cuda")
    binned = CudaRenderer().bin_gaussians(scene, CAMERA.to("cuda"))
    shown = CudaRenderer().find_visible(scene, CAMERA.to("cuda")).cpu()
    assert 0 < shown.sum() < len(shown)
    assert torch.equal(binned.means2d[0].cpu().isfinite().all(dim=-1), shown)
    weights = binned.backproject(torch.zeros_like(scene.means), torch.ones(48, 48, 3).to("cuda"))
    assert torch.equal((weights.cpu() > 0).all(dim=-1) & ~shown, torch.zeros_like(shown))
    assert weights.cpu().isfinite().all()


def test_the_compiled_module_is_given_float32_alone(device):
    from gsplat import rasterize_to_pixels

    scene = in_dtype(SCENES["harmonics"], torch.float64).to("cuda")
    render = CudaRenderer().render(scene, CAMERA.to("cuda"))
    assert render.image.dtype == torch.float32
    # What the cast at the boundary prevents:
    binned = CudaRenderer().bin_gaussians(scene, CAMERA.to("cuda"))
    with pytest.raises(RuntimeError, match="Float but found torch.float64"):
        rasterize_to_pixels(
            binned.means2d,
            binned.conics,
            scene.means[None],
            binned.opacities,
            CAMERA.width,
            CAMERA.height,
            TILE_SIZE,
            binned.tile_offsets,
            binned.rows,
        )


@pytest.mark.parametrize("name", ["harmonics", "antialiased-strange"])
def test_two_cameras_are_drawn_with_one_wait(device, name):
    """Images of two sizes, of which the second shows new Gaussians alone."""
    context, new = SCENES[name][::2].to("cuda"), SCENES[name][1::2].to("cuda")
    other = camera_at(0.2, yaw=5, size=40).to("cuda")
    frozen = CudaRenderer().freeze(context, CAMERA.to("cuda"))
    assert len(frozen.rows) > 0
    means = new.means.requires_grad_()
    before = device.waits.total()
    together = frozen.composite_beside(new, other)
    assert device.waits.total() == before + 1
    alone = frozen.composite(new), CudaRenderer().render(new, other)
    gradients = []
    for here, there in (together, alone):
        assert here.image.shape == (48, 48, 3)
        assert there.alpha.shape == (40, 40)
        loss = here.image.square().sum() + there.image.square().sum() + there.alpha.sum()
        gradients.append(torch.autograd.grad(loss, means)[0].cpu())
    for ours, truth in zip(together, alone, strict=True):
        assert_close(ours.image.cpu(), truth.image.cpu(), "image", 1e-5)
        assert_close(ours.depth.cpu(), truth.depth.cpu(), "depth", 1e-5)
    assert_close(*gradients, "gradient", 1e-4)


def test_a_frozen_view_holds_which_gaussians_its_camera_sees_and_their_colors(device):
    """A view of a large scene is what most of the memory of a GPU goes to."""
    seen = SCENES["harmonics"]
    beside = replace(seen, means=seen.means + torch.tensor([9.0, 0, 0]))
    context, camera = merge([seen, beside]).to("cuda"), CAMERA.to("cuda")
    renderer, memory = CudaRenderer(), get_device().memory
    renderer.freeze(context, camera)  # what a camera computes once is there from here on
    before = memory.alive
    view = renderer.freeze(context, camera)
    assert 0 < view.num_seen <= len(seen)
    assert memory.alive - before == BYTES_SHOWN * view.num_seen + BYTES_OF_A_PART
    view = view.extend(context)
    assert memory.alive - before == BYTES_SHOWN * view.num_seen + 2 * BYTES_OF_A_PART


def make_corner(scene: Gaussians) -> Gaussians:
    """Take the Gaussians that a corner of the image shows, turned so that they look new."""
    pixels, z = project(scene.means, CAMERA)
    chosen = (z > 0) & (pixels < TILE_SIZE - 6).all(dim=-1)
    assert chosen.sum() > 3
    corner = scene[chosen]
    return replace(corner, sh=-corner.sh, means=corner.means - torch.tensor([0, 0, 0.05]))


@pytest.mark.parametrize("name", ["harmonics", "antialiased-harmonics"])
def test_what_varies_is_drawn_in_the_tiles_that_show_it(device, name):
    """Elsewhere the frozen view is drawn once; images and gradients are those of all tiles."""
    scene, new = SCENES[name].to("cuda"), make_corner(SCENES[name]).to("cuda")
    camera = CAMERA.to("cuda")
    frozen = CudaRenderer().freeze(scene, camera)
    selection = frozen.select_tiles(drop_colors(new))
    assert 0 < selection.pixels.sum() < selection.pixels.numel() / 2
    assert 0 < len(selection.context) < frozen.num_seen
    assert len(selection.binned.rows) < len(frozen.bins.rows)
    plain = RedrawnScene(CudaRenderer(), scene, camera)
    check_gradients_alike(frozen.vary_opacities(new), plain.vary_opacities(new), new.opacities)
    fading = replace(new, opacities=new.opacities.clone())
    fading.opacities[::2] = 0
    check_gradients_alike(
        frozen.vary_opacities(fading, is_fading=True),
        plain.vary_opacities(fading),
        fading.opacities,
    )
    colors = torch.full_like(new.means, 0.3)
    photograph = torch.ones(CAMERA.height, CAMERA.width, 3, device="cuda")
    for ours, truth in zip(
        frozen.vary_colors(new)(colors, photograph),
        plain.vary_colors(new)(colors, photograph),
        strict=True,
    ):
        assert_close(ours.cpu(), truth.cpu(), "sums", 1e-4)


def check_gradients_alike(ours: OpacityRender, plain: OpacityRender, opacities: Tensor) -> None:
    """Check that two plans draw the same, and have the same gradients."""
    found = []
    for plan in (ours, plain):
        variable = opacities.detach().clone().requires_grad_()
        render = plan(variable)
        weight = torch.linspace(0, 1, render.image.numel()).view(render.image.shape).to("cuda")
        loss = (render.image * weight).sum() + render.alpha.sum()
        (gradient,) = torch.autograd.grad(loss, variable)
        found.append((render.image, render.alpha, render.depth * (render.alpha > 0.05), gradient))
    for one, other in zip(*found, strict=True):
        assert_close(one.detach().cpu(), other.detach().cpu(), "plan", 1e-4)


def test_a_plan_holds_what_its_tiles_show(device):
    scene = SCENES["harmonics"].to("cuda")
    new, memory = make_corner(SCENES["harmonics"]).to("cuda"), get_device().memory
    frozen = CudaRenderer().freeze(scene, CAMERA.to("cuda"))
    assert frozen.render.image.is_cuda
    assert frozen.num_seen > 100
    before = memory.alive
    plan = frozen.vary_opacities(new)
    # What was gathered to make it is there for the next step of this view, and no longer.
    assert len(frozen.renderer.freeze(scene[:1], CAMERA.to("cuda")).scene) == 1
    held = memory.alive - before
    assert plan(new.opacities).image.is_cuda
    selection = frozen.select_tiles(drop_colors(new))
    shown = selection.binned.depths.numel()
    assert held < 60 * shown + 4 * len(selection.binned.rows) + 2 * selection.pixels.numel()


def test_bins_of_one_view_at_a_time_are_held(device):
    scene = SCENES["harmonics"].to("cuda")
    memory = get_device().memory
    renderer = CudaRenderer()
    cameras = [camera_at(0.02 * i, size=48).to("cuda") for i in range(4)]
    views = [renderer.freeze(scene, camera) for camera in cameras]
    image = torch.ones(48, 48, 3, device="cuda")
    alive = []
    for view in views:
        view.backproject(image)
        alive.append(memory.alive)
    assert max(alive) < 1.1 * min(alive)
    waits = device.waits.total()
    views[-1].backproject(image)
    assert device.waits.total() == waits
    before = memory.alive
    del view, views
    assert before - memory.alive > 100 * len(scene)


def test_bytes_of_a_storage_count_until_its_last_tensor_is_gone(device):
    memory = get_device().memory
    values = torch.ones(100, device="cuda")
    part = values[:10]
    assert memory.alive == 400
    del values
    assert memory.alive == 400
    del part
    assert memory.alive == 0
    assert memory.peaks.total() == 400


def test_auto_chooses_a_gpu_that_draws(device):
    assert choose_devices("auto") == Devices("cuda", "cuda")


@pytest.mark.parametrize(
    "name", ["default", *(pytest.param(n, marks=pytest.mark.slow) for n in ("with gaps", "paper"))]
)
def test_a_completion_stays_on_the_device_and_waits_no_more_than_it_has_to(device, name):
    views = make_views()
    target = camera_at(0.5, yaw=10, size=SIZE)
    complete = GSCompleter(renderer=load_renderer("cuda"), config=CONFIGS[name])
    there = [view.to("cuda") for view in views]
    target_there = target.to("cuda")
    done = complete(there, target_there)
    assert isinstance(done.scene.means, FakeCudaTensor)
    assert done.scene.means.cpu().isfinite().all()
    plain = replace(complete, renderer=load_renderer("cpu"))(views, target)
    assert len(done.added) == len(plain.added) > 100
    # Rounding grows in the optimisation, so that only what hardly moves is compared.
    difference = (done.added.means.cpu() - plain.added.means).norm(dim=1)
    assert difference.median() < 0.01
    for stage in STAGES:
        found = device.count_waits(stage)
        assert found <= MOST_WAITS[name][stage], f"{stage}:\n{device.list_waits(stage)}"
    memory = get_device().memory
    stage, peak = memory.peaks.most_common(1)[0]
    assert peak <= MOST_BYTES[name] * len(done.scene), f"{stage}:\n{memory.largest[stage]}"


MOST_WAITS_OF_PLANE_SWEEP = {2: 66, 3: 152}
"""Waits of a reconstruction of so many photographs that the device matches and fits."""


@pytest.mark.parametrize("count", MOST_WAITS_OF_PLANE_SWEEP)
def test_plane_sweep_matches_and_fits_on_the_device(device, count):
    views = make_views((-0.3, 0.1, 0.2)[:count])
    there = [view.to("cuda") for view in views]
    before = device.waits.total()
    found = load_reconstructor("plane-sweep", device="cuda")(there)
    waits = device.waits.total() - before
    assert waits <= MOST_WAITS_OF_PLANE_SWEEP[count], device.list_waits("between stages")
    expected = PlaneSweep()(views)
    assert isinstance(found.gaussians.means, FakeCudaTensor)
    assert len(found.gaussians) == len(expected.gaussians) > 100
    assert torch.equal(found.pixel_index.cpu(), expected.pixel_index)
    for ours, truth in zip(found.depths, expected.depths, strict=True):
        assert_close(ours.depth.cpu(), truth.depth, "depth", 1e-4)
    # Rounding grows in the fits, so that only what they are for is compared.
    for view in views:
        scores = [
            psnr(
                load_renderer("cpu").render(part.gaussians.to("cpu"), view.camera).image, view.image
            )
            for part in (found, expected)
        ]
        assert abs(scores[0] - scores[1]) < 0.1
        assert scores[1] > 20


def test_discs_of_a_part_take_what_is_estimated(device, monkeypatch):
    monkeypatch.setitem(DEPTH_DEVICES, "cuda", lambda _: CpuDepth())
    views = [view.to("cuda") for view in make_views((-0.3, -0.1, 0.1, 0.3))]
    psi = load_reconstructor("plane-sweep", device="cuda")
    memory = get_device().memory
    before = memory.alive

    def choose_border(depths: Sequence[DepthMap]) -> list[Tensor]:
        masks = [torch.zeros_like(depth.valid) for depth in depths]
        for mask in masks:
            mask[:, :2] = True
        return masks

    assert isinstance(psi, PartReconstructor)
    assert len(psi.reconstruct_part(views, choose_border).gaussians) > 0
    peak = max(memory.peaks.values()) - before
    assert 0.75 < peak / (DISC_BYTES * len(views) * SIZE**2) < 1.15


def test_plane_sweep_stays_on_the_cpu_unless_the_device_is_chosen(device):
    there = [view.to("cuda") for view in make_views()]
    found = PlaneSweep()(there)
    assert isinstance(found.gaussians.means, FakeCudaTensor)
    here = [view.to("cpu") for view in there]
    matched = load_reconstructor("plane-sweep", device="cuda")(here)
    assert not isinstance(matched.gaussians.means, FakeCudaTensor)
    for name in ("means", "opacities", "sh"):
        ours, fitted = (getattr(part.gaussians, name).cpu() for part in (found, matched))
        assert_close(ours, fitted, name, 1e-3)


def test_a_synthesized_image_is_lifted_on_the_device(device):
    views = [view.to("cuda") for view in make_views()]
    mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    mask[:, :7] = True
    found = load_reconstructor("plane-sweep", device="cuda").lift(views, mask.to("cuda"))
    expected = PlaneSweep().lift([view.to("cpu") for view in views], mask)
    assert isinstance(found.gaussians.means, FakeCudaTensor)
    for name in ("means", "sh"):
        ours = getattr(found.gaussians, name).cpu()
        assert_close(ours, getattr(expected.gaussians, name), name, 1e-3)


# `test_commands_on_a_device.py` updates a splat.
@pytest.mark.slow
def test_a_given_splat_is_completed_with_photographs_that_check_it(device):
    views = [view.to("cuda") for view in make_views((-0.3, 0.1, 0.2))]
    scene = merge([gaussians_of(view.to("cpu")) for view in views[:2]]).to("cuda")
    complete = GSCompleter(renderer=load_renderer("cuda"))
    target = camera_at(0.5, yaw=10, size=SIZE).to("cuda")
    done = complete(views[:2], target, scene, check_views=views)
    assert isinstance(done.scene.means, FakeCudaTensor)
    assert len(done.added) > 30
    # What is added is not known when the memory is estimated, and is a third of this small scene.
    memory = get_device().memory
    estimate = estimate_gpu_memory(done.scene, [photo.view.camera for photo in done.photos])
    peak = max(memory.peaks.values())
    assert 0.7 * peak < estimate < 1.5 * peak
