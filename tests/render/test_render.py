"""The renderers agree with each other and with what can be worked out by hand."""

import sys
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import avg_pool2d

import stand_in_gsplat
from gscompleter import Gaussians, InputError, Render, load_renderer, merge
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.numerics.geometry import (
    compute_z_depths,
    move_to_depths,
    pad_camera,
    sample_image,
    shrink_camera,
)
from gscompleter.numerics.kernels import composite
from gscompleter.render import cpu, device
from gscompleter.render.cpu import CpuRenderer
from gscompleter.render.gsplat import CudaRenderer
from gscompleter.render.protocols import JointOpacityRender
from gscompleter.render.redraw import RedrawnScene
from gscompleter.types import BLUR, make_observed, sh_from_rgb
from parity import assert_close
from render_scenes import (
    CAMERA,
    PARAMETERS,
    REFERENCE,
    SCENES,
    beside,
    compute_gradients,
    find_covered_pixels,
    in_dtype,
)
from scenes import Room, camera_at, gaussians_of, random_gaussians, scaled, view_of

CPU = load_renderer("cpu")
EVERYWHERE = torch.ones(48, 48, dtype=torch.bool)
DRAWN = ("image", "depth", "alpha")
ROUNDING = 1e-5
"""Largest difference of drawings and of gradients, of the largest value. At most 5.1e-6 was
measured, and 6.4e-6 with kernels compiled without fused multiplications."""


MODES = pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "antialiased"])


def assert_same_render(ours: Render, truth: Render) -> None:
    """Compare every pixel, but the depth only where alpha is not negligible."""
    covered = truth.alpha > 0.01
    assert_close(ours.image, truth.image, "image", ROUNDING)
    assert_close(ours.alpha, truth.alpha, "alpha", ROUNDING)
    assert_close(ours.depth * covered, truth.depth * covered, "depth", ROUNDING)


def assert_same_gradients(
    ours: dict[str, torch.Tensor], truth: dict[str, torch.Tensor], bound: float = ROUNDING
) -> None:
    """Compare the gradients of every Gaussian; none of them is rounding noise alone."""
    for name, expected in truth.items():
        rows = expected.flatten(1) if expected.dim() > 1 else expected[:, None]
        assert (rows.abs().amax(dim=1) > 1e-3).float().mean() > 0.2, name
        assert_close(ours[name], expected, f"gradient of {name}", bound)


@pytest.mark.parametrize("name", SCENES)
def test_cpu_and_reference_draw_the_same(name):
    ours = CPU.render(SCENES[name], CAMERA)
    truth = REFERENCE.render(in_dtype(SCENES[name], torch.float64), CAMERA)
    assert_same_render(ours, truth)
    assert truth.alpha.max() > 0.5


@pytest.mark.parametrize("name", SCENES)
def test_cpu_and_reference_have_the_same_gradients(name):
    covered = find_covered_pixels(name)
    truth = compute_gradients(REFERENCE, in_dtype(SCENES[name], torch.float64), covered)
    assert_same_gradients(compute_gradients(CPU, SCENES[name], covered), truth)


def one(mean, opacity=0.8, scale=0.05, colour=(1.0, 0.5, 0.25)) -> Gaussians:
    """Make a round Gaussian."""
    return make_observed(
        torch.tensor([mean]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), scale),
        torch.tensor([opacity]),
        sh_from_rgb(torch.tensor([colour])),
    )


@pytest.mark.parametrize("renderer", [CPU, REFERENCE], ids=["cpu", "reference"])
def test_one_gaussian_on_a_pixel_centre_by_hand(renderer):
    camera = camera_at(size=33, focal=1.0)  # the axis runs through the centre of pixel (16, 16)
    render = renderer.render(one((0.0, 0.0, 2.0)), camera)
    assert render.alpha[16, 16] == pytest.approx(0.8, abs=1e-5)
    assert render.depth[16, 16] == pytest.approx(2.0, abs=1e-5)
    assert render.image[16, 16].tolist() == pytest.approx([0.8, 0.4, 0.2], abs=1e-5)
    # One pixel to the right: variance (33 * 0.05 / 2)^2 + 0.3 px^2.
    variance = (33 * 0.05 / 2) ** 2 + 0.3
    expected = 0.8 * torch.exp(torch.tensor(-0.5 / variance))
    assert render.alpha[16, 17] == pytest.approx(expected.item(), abs=1e-5)


@pytest.mark.parametrize("scale", [1e3, 1e17, 9e17])
@pytest.mark.parametrize("mean", [(0.0, 0.0, 2.0), (4.0, -4.0, 2.0)], ids=["before", "beside"])
def test_a_gaussian_of_any_size_that_a_scene_may_have_is_drawn(scale, mean):
    """The largest splats are wider than whole numbers of 64 bits count pixels.

    In the reference, whose covariances are squares in float32, they overflow.
    """
    huge = one(mean, scale=scale)
    huge = replace(huge, scales=huge.scales.requires_grad_())
    render = CPU.render(huge, CAMERA)
    assert torch.allclose(render.alpha, torch.full_like(render.alpha, 0.8), atol=1e-4)
    render.image.sum().backward()
    assert huge.scales.grad.isfinite().all()


@pytest.mark.parametrize("renderer", [CPU, REFERENCE], ids=["cpu", "reference"])
@pytest.mark.parametrize("scales", [(0.05, 0.05, 0.05), (0.05, 0.01, 0.3)], ids=["round", "thin"])
def test_one_antialiased_gaussian_by_hand(renderer, scales):
    """The low-pass widens a splat and lowers its opacity, so that its sum does not change."""
    camera = camera_at(size=33, focal=1.0)
    gaussian = replace(one((0.0, 0.0, 2.0)), scales=torch.tensor([scales]), is_antialiased=True)
    across, down = (33 * scale / 2 for scale in scales[:2])
    factor = across * down / ((across**2 + 0.3) * (down**2 + 0.3)) ** 0.5
    render = renderer.render(gaussian, camera)
    assert render.alpha[16, 16] == pytest.approx(0.8 * factor, rel=1e-5)
    assert render.depth[16, 16] == pytest.approx(2.0, abs=1e-5)
    assert render.alpha.sum() == pytest.approx(0.8 * 2 * torch.pi * across * down, rel=0.03)
    classic = renderer.render(replace(gaussian, is_antialiased=False), camera)
    assert classic.alpha[16, 16] == pytest.approx(0.8, rel=1e-5)


@pytest.mark.parametrize("renderer", [CPU, REFERENCE], ids=["cpu", "reference"])
def test_what_is_too_thin_to_be_seen_antialiased_has_no_gradient(renderer):
    """A Gaussian of no extent, and one so small that squares of its size underflow."""
    for scale in (0.0, 1e-25):
        thin = replace(one((0.0, 0.0, 2.0), scale=scale), is_antialiased=True)
        thin = replace(thin, scales=thin.scales.requires_grad_())
        render = renderer.render(merge([thin, SCENES["antialiased-random"]]), CAMERA)
        render.image.sum().backward()
        assert torch.equal(thin.scales.grad, torch.zeros(1, 3))


def test_the_mode_of_gaussians_is_kept_and_not_mixed():
    scene = SCENES["antialiased-harmonics"]
    for same in (scene[:5], scene[scene.opacities > 0.5], scene.to("cpu"), merge([scene, scene])):
        assert same.is_antialiased
    with pytest.raises(ValueError, match="cannot be merged"):
        merge([scene, SCENES["harmonics"]])


@pytest.mark.parametrize("renderer", [CPU, REFERENCE], ids=["cpu", "reference"])
def test_the_nearer_gaussian_covers_the_farther_whatever_their_order(renderer):
    camera = camera_at(size=33, focal=1.0)
    near, far = one((0.0, 0.0, 2.0), 0.75), one((0.0, 0.0, 4.0), 0.5, colour=(0.0, 1.0, 0.0))
    for scene in (merge([near, far]), merge([far, near])):
        render = renderer.render(scene, camera)
        assert render.alpha[16, 16] == pytest.approx(0.75 + 0.25 * 0.5, abs=1e-5)
        assert render.image[16, 16, 0] == pytest.approx(0.75, abs=1e-5)
        expected = (0.75 * 2 + 0.125 * 4) / 0.875
        assert render.depth[16, 16] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("renderer", [CPU, REFERENCE], ids=["cpu", "reference"])
def test_nothing_is_black(renderer):
    for scene in (random_gaussians(5)[:0], one((0.0, 0.0, -2.0))):
        render = renderer.render(scene, CAMERA)
        assert not render.image.any()
        assert not render.alpha.any()
        assert not render.depth.any()


@pytest.mark.parametrize("size", [(1, 1), (17, 31), (64, 16), (5, 200)])
def test_any_image_size_is_drawn(size):
    height, width = size
    focal = 0.6 * max(size)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    camera = replace(CAMERA, K=K, width=width, height=height)
    scene = SCENES["random"]
    ours = CPU.render(scene, camera)
    assert ours.image.shape == (height, width, 3)
    assert_same_render(ours, REFERENCE.render(in_dtype(scene, torch.float64), camera))


def context_and_new(antialiased: bool = False) -> tuple[Gaussians, Gaussians]:
    return tuple(
        replace(part, is_antialiased=antialiased)
        for part in (SCENES["random"], random_gaussians(200, seed=5))
    )


@MODES
@pytest.mark.parametrize("renderer", [CPU, REFERENCE], ids=["cpu", "reference"])
def test_a_composite_is_the_render_of_both_together(renderer, antialiased):
    context, new = context_and_new(antialiased)
    whole = renderer.render(merge([context, new]), CAMERA)
    parts = renderer.freeze(context, CAMERA).composite(new)
    assert_same_render(parts, whole)


def test_what_is_frozen_alone_is_its_own_render():
    context, _ = context_and_new()
    frozen, alone = CPU.freeze(context, CAMERA).render, CPU.render(context, CAMERA)
    assert_same_render(frozen, alone)


@MODES
@pytest.mark.parametrize("renderer", [CPU, REFERENCE], ids=["cpu", "reference"])
def test_an_extended_view_is_the_frozen_view_of_both(renderer, antialiased):
    context, new = context_and_new(antialiased)
    last = replace(random_gaussians(50, seed=6), is_antialiased=antialiased)
    extended = renderer.freeze(context, CAMERA).extend(new)
    frozen = renderer.freeze(merge([context, new]), CAMERA)
    for ours, truth in (
        (extended.render, frozen.render),
        (extended.composite(last), frozen.composite(last)),
        (
            extended.vary_opacities(last)(last.opacities),
            frozen.vary_opacities(last)(last.opacities),
        ),
        (extended.extend(last).render, frozen.extend(last).render),
    ):
        for name in DRAWN:
            assert torch.equal(getattr(ours, name), getattr(truth, name)), name


@MODES
@pytest.mark.parametrize("block", [7, 1000])
@pytest.mark.parametrize("renderer", [CPU, REFERENCE], ids=["cpu", "reference"])
def test_what_hides_gaussians_shows_as_much_of_them_as_the_whole_scene(
    renderer, block, antialiased, monkeypatch
):
    monkeypatch.setattr(cpu, "OCCLUDER_BLOCK", block)
    context, new = context_and_new(antialiased)
    few = new[:3]
    values = torch.cat([torch.zeros(len(context)), torch.ones(len(few))])
    whole = renderer.freeze(context, CAMERA).extend(few)
    expected = whole.splat(values)
    assert 0 < (expected > 0.01).float().mean() < 0.9
    hiding = renderer.freeze(few, CAMERA).freeze_occluders(context)
    assert torch.equal(hiding.extend(few).splat(values), expected)
    if renderer is CPU:
        assert len(hiding.layer.entries) < 0.7 * len(whole.layer.entries)
    nowhere = renderer.freeze(few[:0], CAMERA).freeze_occluders(context).extend(few[:0])
    assert not nowhere.splat(values[: len(context)]).any()


@MODES
@pytest.mark.parametrize("renderer", [CPU, REFERENCE], ids=["cpu", "reference"])
def test_a_repainted_view_is_the_frozen_view_in_new_colours(renderer, antialiased):
    context, new = context_and_new(antialiased)
    rows = torch.arange(len(context) - 1, 0, -3)  # in any order
    painted = replace(context[rows], sh=context.sh[rows].flip(0))
    repainted = renderer.freeze(context, CAMERA).repaint(rows, painted)
    frozen = renderer.freeze(
        replace(context, sh=context.sh.index_copy(0, rows, painted.sh)), CAMERA
    )
    assert not torch.equal(frozen.render.image, renderer.freeze(context, CAMERA).render.image)
    for ours, truth in (
        (repainted.render, frozen.render),
        (repainted.composite(new), frozen.composite(new)),
        (repainted.extend(new).render, frozen.extend(new).render),
    ):
        for name in DRAWN:
            assert torch.equal(getattr(ours, name), getattr(truth, name)), name
    image = frozen.render.image
    assert torch.equal(repainted.backproject(image), frozen.backproject(image))


def test_a_frozen_view_keeps_no_splat_that_no_tile_draws():
    wall = gaussians_of(view_of(Room(), camera_at(size=64)))
    hidden = replace(wall, means=2 * wall.means, scales=2 * wall.scales)
    opaque = merge([wall, wall, wall, hidden])
    frozen = CPU.freeze(opaque, CAMERA)
    assert len(frozen.layer.splats) < 0.8 * len(opaque)
    assert set(frozen.layer.entries) == set(range(len(frozen.layer.splats)))
    assert_same_render(frozen.render, CPU.render(opaque, CAMERA))


def test_tiles_find_their_splats_in_the_order_in_which_they_name_them():
    context, _ = context_and_new()
    frozen = CPU.freeze(context[torch.randperm(len(context))], CAMERA)
    seen = dict.fromkeys(frozen.layer.entries.tolist())
    assert list(seen) == list(range(len(frozen.layer.splats)))


def test_only_tiles_that_something_new_touches_are_drawn(monkeypatch):
    """The new Gaussian touches one of the nine tiles, forward and backward."""
    drawn = count_tiles(monkeypatch)
    frozen = CpuRenderer(threads=1).freeze(SCENES["random"], CAMERA)
    assert drawn.pop() == 9
    new = replace(random_gaussians(1), means=torch.tensor([[0.0, 0.0, 1.0]]))
    new = replace(new, scales=torch.full((1, 3), 0.02), opacities=torch.ones(1))
    found = opacity_gradient(frozen.vary_opacities(new), new.opacities)[1]
    assert drawn == [1, 1]
    assert found.abs() > 0
    assert frozen.extend(replace(new, means=-new.means)).frame is frozen.frame
    assert drawn == [1, 1]


def count_tiles(monkeypatch) -> list[int]:
    """Record how many tiles each call of the two compositing kernels visits.

    A single thread makes one call per render.
    """
    drawn: list[int] = []

    def counting(kernel):
        def counted(begin, end, *arguments):
            drawn.append(end - begin)
            return kernel(begin, end, *arguments)

        return counted

    for name in ("composite", "composite_backward"):
        monkeypatch.setattr(composite, name, counting(getattr(composite, name)))
    return drawn


def opacity_gradient(function, opacities: torch.Tensor) -> tuple[Render, torch.Tensor]:
    variable = opacities.clone().requires_grad_()
    render = function(variable)
    target = torch.linspace(0, 1, render.image.numel()).view_as(render.image)
    loss = (render.image - target).square().sum() + render.depth.sum() + render.alpha.sum()
    return render, torch.autograd.grad(loss, variable)[0]


@MODES
@pytest.mark.parametrize("renderer", [CPU, REFERENCE], ids=["cpu", "reference"])
def test_a_plan_is_the_composite_with_other_opacities(renderer, antialiased):
    context, new = context_and_new(antialiased)
    frozen = renderer.freeze(context, CAMERA)
    plan = frozen.vary_opacities(new)
    for opacities in (new.opacities, 1 - new.opacities):
        planned, grad = opacity_gradient(plan, opacities)
        truth, expected = opacity_gradient(
            lambda values: frozen.composite(replace(new, opacities=values)), opacities
        )
        assert_same_render(planned, truth)
        assert_same_gradients({"opacities": grad}, {"opacities": expected})


@MODES
@pytest.mark.parametrize("renderer", [CPU, REFERENCE], ids=["cpu", "reference"])
def test_a_plan_of_what_fades_is_any_other_plan_at_lower_opacities(renderer, antialiased):
    context, new = context_and_new(antialiased)
    frozen = renderer.freeze(context, CAMERA)
    hidden = new.hide(torch.arange(len(new)) % 3 == 0)
    plan, usual = frozen.vary_opacities(hidden, is_fading=True), frozen.vary_opacities(hidden)
    for opacities in (hidden.opacities, 0.3 * hidden.opacities):
        faded, grad = opacity_gradient(plan, opacities)
        truth, expected = opacity_gradient(usual, opacities)
        assert_same_render(faded, truth)
        # A usual plan has gradients of transparent ones, too.
        assert torch.equal(grad[hidden.opacities > 0], expected[hidden.opacities > 0])


@MODES
def test_several_gradients_at_once_are_those_of_each_function_alone(antialiased):
    context, new = context_and_new(antialiased)
    plan = CPU.freeze(context, CAMERA).vary_opacities(new)
    assert isinstance(plan, JointOpacityRender)
    for opacities in (new.opacities, torch.where(new.opacities > 0.5, 0.0, new.opacities)):
        render, backpropagate = plan.begin(opacities)
        images = torch.randn(5, *render.image.shape, generator=torch.Generator().manual_seed(0))
        for image, gradient in zip(images, backpropagate(images), strict=True):
            variable = opacities.clone().requires_grad_()
            drawn = plan(variable)
            assert torch.equal(drawn.image, render.image)
            # With depth and alpha, gradients are those of the kernel for all outputs.
            loss = (drawn.image * image).sum() + 0 * drawn.depth.sum() + 0 * drawn.alpha.sum()
            (expected,) = torch.autograd.grad(loss, variable)
            assert gradient.any()
            assert torch.equal(gradient, expected)


@MODES
def test_a_plan_of_depths_is_the_composite_at_these_depths(antialiased):
    context, new = context_and_new(antialiased)
    frozen = CPU.freeze(context, CAMERA)
    before = compute_z_depths(new.means, CAMERA)
    for ratio in (torch.ones(len(new)), torch.linspace(0.5, 2.0, len(new))):
        depths = before * ratio
        truth, expected = depth_gradient(
            lambda values: frozen.composite(move_to_depths(new, CAMERA, values)), depths
        )
        planned, grad = depth_gradient(frozen.vary_depths(new), depths)
        assert_same_render(planned, truth)
        assert_close(grad, expected, "gradient of depths")
    before_the_lens = frozen.vary_depths(new)(1e-3 * before)
    assert torch.equal(before_the_lens.image, frozen.render.image)


@MODES
def test_a_plan_of_colours_tells_what_the_composite_in_these_colours_lacks(antialiased):
    context, new = context_and_new(antialiased)
    plans = [r.freeze(context, CAMERA).vary_colors(new) for r in (CPU, REFERENCE)]
    generator = torch.Generator().manual_seed(0)
    photograph = torch.rand(48, 48, 3, generator=generator)
    for _ in range(2):
        colours = torch.rand(len(new), 3, generator=generator) - 0.2
        (sums, weights), (true_sums, true_weights) = (p(colours, photograph) for p in plans)
        assert_close(sums, true_sums, "what is missing")
        assert_close(weights, true_weights, "weights")
        assert true_weights.max() > 1


def depth_gradient(function, depths: torch.Tensor):
    variable = depths.clone().requires_grad_()
    render = function(variable)
    weight = torch.linspace(0, 1, render.depth.numel()).view_as(render.depth)
    covered = render.alpha > 0.05
    return render, torch.autograd.grad((render.depth * weight * covered).sum(), variable)[0]


@MODES
def test_composites_have_the_gradients_of_the_render_of_both(antialiased):
    context, new = context_and_new(antialiased)

    class Composites:
        def render(self, gaussians, camera):
            return CPU.freeze(context, camera).composite(gaussians)

    class Together:
        def render(self, gaussians, camera):
            return CPU.render(merge([context, gaussians]), camera)

    covered = CPU.render(merge([context, new]), CAMERA).alpha > 0.05
    composites = compute_gradients(Composites(), new, covered)
    assert_same_gradients(composites, compute_gradients(Together(), new, covered))


PADDED = pad_camera(CAMERA, 0.25)
BESIDE = beside(CAMERA)


def crop_render(render: Render) -> Render:
    return Render(*(PADDED.crop(getattr(render, name)) for name in DRAWN))


@MODES
@pytest.mark.parametrize("renderer", [CPU, REFERENCE], ids=["cpu", "reference"])
def test_a_padded_image_shows_what_the_image_does_that_it_pads(renderer, antialiased):
    scene = replace(BESIDE, is_antialiased=antialiased)
    truth = renderer.render(scene, CAMERA)
    assert_same_render(crop_render(renderer.render(scene, PADDED.padded)), truth)
    # The scene tells the two ways to clamp apart.
    other = renderer.render(scene, replace(PADDED.padded, padding=(0, 0)))
    assert (PADDED.crop(other.alpha) - truth.alpha).abs().max() > 0.1

    # So do frozen scenes, with which additions are optimised.
    context, new = scene[::2], scene[1::2]
    frozen = renderer.freeze(context, PADDED.padded)
    both = renderer.render(merge([context, new]), CAMERA)
    depths = compute_z_depths(new.means, CAMERA)
    assert_same_render(crop_render(frozen.extend(new).render), both)
    assert_same_render(crop_render(frozen.composite(new)), both)
    assert_same_render(crop_render(frozen.vary_opacities(new)(new.opacities)), both)
    assert_same_render(crop_render(frozen.vary_depths(new)(depths)), both)


@MODES
def test_cpu_and_reference_draw_a_padded_image_alike_with_the_same_gradients(antialiased):
    scene = replace(BESIDE, is_antialiased=antialiased)
    exact = in_dtype(scene, torch.float64)
    camera = PADDED.padded
    truth = REFERENCE.render(exact, camera)
    assert_same_render(CPU.render(scene, camera), truth)
    covered = truth.alpha > 0.05
    assert_same_gradients(
        compute_gradients(CPU, scene, covered, camera),
        compute_gradients(REFERENCE, exact, covered, camera),
    )


@pytest.mark.parametrize("unit", [0.001, 1000.0])
@pytest.mark.parametrize("renderer", [CPU, REFERENCE], ids=["cpu", "reference"])
def test_the_unit_of_the_scene_changes_no_image(renderer, unit):
    scene = SCENES["harmonics"]
    ours = renderer.render(scene, camera_at(size=32))
    theirs = renderer.render(scaled(scene, unit), camera_at(size=32, unit=unit))
    assert_same_render(replace(theirs, depth=theirs.depth / unit), ours)


def test_the_same_input_gives_the_same_bytes_on_any_number_of_threads():
    scene = SCENES["harmonics"]
    covered = find_covered_pixels("harmonics")
    results = []
    for threads in (1, 2, 1):
        renderer = CpuRenderer(threads=threads)
        render = renderer.render(scene, CAMERA)
        results.append(
            [render.image, render.depth, *compute_gradients(renderer, scene, covered).values()]
        )
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_threads_of_torch_are_left_alone():
    before = torch.get_num_threads()
    CPU.render(SCENES["random"], CAMERA)
    assert torch.get_num_threads() == before


def test_an_unknown_renderer_is_refused():
    with pytest.raises(InputError, match="no renderer 'opengl'"):
        load_renderer("opengl")


@pytest.fixture
def cuda(monkeypatch) -> CudaRenderer:
    """Return the renderer for GPUs, with a stand-in for gsplat that runs on the CPU."""
    monkeypatch.setitem(sys.modules, "gsplat", stand_in_gsplat.module())
    monkeypatch.setattr(device, "explain_missing_renderer", lambda: None)
    return load_renderer("cuda")


def check_frozen(view, plain, new: Gaussians, bound: float) -> None:
    """Compare the renders of two frozen scenes, and their gradients in `new`."""

    def composited(frozen):
        return lambda leaves: frozen.composite(replace(new, **leaves))

    leaves = {name: getattr(new, name) for name in PARAMETERS}
    pairs = [(composited(view), composited(plain), leaves)]
    plans = view.vary_opacities(new), plain.vary_opacities(new)
    for opacities in (new.opacities, 1 - new.opacities):
        ours, theirs = ((lambda ls, p=plan: p(ls["opacities"])) for plan in plans)
        pairs.append((ours, theirs, {"opacities": opacities}))
    for ours, theirs, values in pairs:
        found, expected = render_and_gradients(ours, values), render_and_gradients(theirs, values)
        for name, truth in expected.items():
            assert (found[name] - truth).norm() <= bound * (truth.norm() + 1e-3), name


def render_and_gradients(draw, values: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Compute image, depth, alpha, and the gradient of a weighting of them in each of `values`."""
    variables = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
    render = draw(variables)
    weight = torch.linspace(0, 1, render.image.numel()).view_as(render.image).to(render.image)
    covered = (render.alpha.detach() > 0.05).to(render.image)
    loss = (render.image * weight).sum() + (render.alpha + render.depth * covered).sum()
    gradients = torch.autograd.grad(loss, list(variables.values()))
    drawn = {"image": render.image, "depth": render.depth * covered, "alpha": render.alpha}
    return {**drawn, **dict(zip(variables, gradients, strict=True))}


def check_sums(ours, truth, new: Gaussians, bound: float) -> None:
    """Compare what two frozen scenes show of each Gaussian, and what new ones lack."""
    camera = ours.camera
    generator = torch.Generator().manual_seed(0)
    layers = torch.rand((camera.height, camera.width, 3), generator=generator)
    values = torch.rand(ours.count, generator=generator)
    colors = torch.rand((len(new), 3), generator=generator) - 0.2
    layers, values, colors = (part.to(new.means.device) for part in (layers, values, colors))
    pairs = {
        "backprojection": (ours.backproject(layers), truth.backproject(layers)),
        "splat": (ours.splat(values), truth.splat(values)),
    }
    missing, weights = ours.vary_colors(new)(colors, layers)
    true_missing, true_weights = truth.vary_colors(new)(colors, layers)
    pairs |= {"missing": (missing, true_missing), "weights": (weights, true_weights)}
    for name, (found, expected) in pairs.items():
        assert expected.count_nonzero() > 0, name
        assert_close(found, expected, name, bound)


@pytest.mark.parametrize("name", ["harmonics", "strange", "antialiased-harmonics"])
def test_a_frozen_view_tells_what_it_shows_of_each_gaussian(name):
    context, new = SCENES[name][::2], SCENES[name][1::2]
    view = CPU.freeze(context, CAMERA).extend(new[:0]).extend(new)
    plain = REFERENCE.freeze(merge([context, new]), CAMERA)
    generator = torch.Generator().manual_seed(0)
    layers = torch.rand((CAMERA.height, CAMERA.width, 3), generator=generator)
    truth = plain.backproject(layers)
    assert_close(view.backproject(layers), truth, "backprojection")
    assert truth.count_nonzero() > 0
    values = torch.rand(len(truth), generator=generator)
    assert_close(view.splat(values), plain.splat(values), "splat")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["strange-harmonics", "antialiased-harmonics"])
def test_gsplat_is_called_so_that_frozen_views_draw_what_the_reference_does(name, cuda):
    beside = replace(SCENES[name], means=SCENES[name].means + torch.tensor([9.0, 0, 0]))
    context, new = merge([SCENES[name], beside]), random_gaussians(40, seed=5, sh_degree=1)
    new = replace(new, is_antialiased=context.is_antialiased)
    ours, truth = cuda.render(context, CAMERA), REFERENCE.render(context, CAMERA)
    assert_close(ours.depth, truth.depth, "depth", 1e-5)
    assert_close(ours.image, truth.image, "image", 1e-5)
    view = cuda.freeze(context, CAMERA)
    assert 0 < len(view.scene) < len(context)
    assert view.scene.sh.shape[1] == 1
    plain = REFERENCE.freeze(context, CAMERA)
    check_frozen(view, plain, new, 1e-4)
    check_sums(view, plain, new, 1e-4)
    rows = torch.arange(0, len(context), 3)
    painted = replace(context[rows], sh=-context.sh[rows])
    repainted = replace(context, sh=context.sh.index_copy(0, rows, painted.sh))
    plain = REFERENCE.freeze(repainted, CAMERA)
    check_frozen(view.repaint(rows, painted), plain, new, 1e-4)
    more = replace(random_gaussians(30, seed=6), is_antialiased=context.is_antialiased)
    extended = view.extend(new[:0]).extend(new)
    plain = REFERENCE.freeze(merge([context, new]), CAMERA)
    check_frozen(extended, plain, more, 1e-4)
    check_sums(extended, plain, more, 1e-4)


def test_gsplat_is_not_called_where_there_is_nothing(cuda):
    new = SCENES["random"][:20]
    nothing = cuda.freeze(new[:0], CAMERA)
    assert not cuda.render(new[:0], CAMERA).image.any()
    assert len(nothing.scene) == 0
    assert_close(nothing.composite(new).image, REFERENCE.render(new, CAMERA).image, "image", 1e-5)
    layers = torch.ones(CAMERA.height, CAMERA.width, 3)
    assert nothing.backproject(layers).shape == (0, 3)
    assert not nothing.splat(torch.ones(0)).any()
    missing, weights = nothing.vary_colors(new[:0])(torch.ones(0, 3), layers)
    assert (missing.shape, weights.shape) == ((0, 3), (0,))


def test_gsplat_takes_gaussians_of_float64(cuda):
    scene = SCENES["harmonics"][:30]
    ours = cuda.render(in_dtype(scene, torch.float64), CAMERA)
    assert_close(ours.image, cuda.render(scene, CAMERA).image, "image", 1e-5)


def test_a_camera_is_moved_and_inverted_once():
    camera = camera_at(0.3, yaw=20)
    assert camera.to("cpu") is camera
    assert camera.on_cpu is camera
    assert camera.viewmat is camera.viewmat
    assert_close(camera.viewmat @ camera.c2w, torch.eye(4), "inverse", 1e-6)


on_a_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU")


@pytest.mark.gpu
@on_a_gpu
@pytest.mark.parametrize("name", SCENES)
def test_cuda_and_reference_draw_the_same_with_the_same_gradients(name):
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    cuda, scene = load_renderer("cuda"), SCENES[name].to("cuda")
    ours, truth = cuda.render(scene, CAMERA.to("cuda")), REFERENCE.render(SCENES[name], CAMERA)
    # Gsplat decides otherwise which splats reach a pixel with less than 1/255.
    differs = (ours.image.cpu() - truth.image).abs() > 1e-3
    assert differs.float().mean() < 5e-3
    covered = find_covered_pixels(name)
    a = compute_gradients(cuda, scene, covered.to("cuda"), CAMERA.to("cuda"))
    b = compute_gradients(REFERENCE, SCENES[name], covered)
    for parameter in PARAMETERS:
        difference = a[parameter].cpu() - b[parameter]
        assert difference.norm() <= 2e-2 * b[parameter].norm(), parameter


@pytest.mark.gpu
@on_a_gpu
@pytest.mark.parametrize("name", SCENES)
def test_a_frozen_view_on_a_gpu_draws_what_drawing_everything_anew_does(name):
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    cuda, camera = load_renderer("cuda"), CAMERA.to("cuda")
    beside = replace(SCENES[name], means=SCENES[name].means + torch.tensor([9.0, 0, 0]))
    context = merge([SCENES[name], beside]).to("cuda")
    new = random_gaussians(200, seed=5, sh_degree=1).to("cuda")
    new = replace(new, is_antialiased=context.is_antialiased)
    view = cuda.freeze(context, camera)
    assert 0 < len(view.scene) < len(context) / 2 + 1
    plain = RedrawnScene(cuda, context, camera)
    check_frozen(view, plain, new, 1e-3)
    check_sums(view, plain, new, 1e-3)


def test_a_small_image_of_a_scene_is_a_sample_of_the_large_one():
    """Widened by a pixel of the small image, Gaussians in front cover what is beside and behind."""
    large = camera_at(size=96)
    photograph = view_of(Room(), large)
    scene = gaussians_of(photograph)
    shrunk = shrink_camera(large, 24)
    sampled = sample_image(shrunk, large)
    assert sampled.blur == pytest.approx(BLUR / 16)
    truth = avg_pool2d(photograph.image.permute(2, 0, 1), 4).permute(1, 2, 0)
    for renderer in (CPU, REFERENCE):
        plain = psnr(renderer.render(scene, shrunk).image, truth)
        assert psnr(renderer.render(scene, sampled).image, truth) > plain + 3
    ours = CPU.render(scene, sampled)
    assert_same_render(ours, REFERENCE.render(in_dtype(scene, torch.float64), sampled))
    # No image is larger than what it samples.
    assert sample_image(large, shrunk).blur == BLUR


@pytest.mark.parametrize("name", ["random", "antialiased-random"])
def test_gradients_follow_the_blur(name):
    camera = replace(CAMERA, blur=0.05)
    covered = find_covered_pixels(name)
    truth = compute_gradients(REFERENCE, in_dtype(SCENES[name], torch.float64), covered, camera)
    # Of narrower splats, gradients are steeper, and rounding counts more: 1.9e-5 was measured.
    assert_same_gradients(compute_gradients(CPU, SCENES[name], covered, camera), truth, 5e-5)
