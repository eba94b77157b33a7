"""MVSplat and DepthSplat: equal to the authors' code, and a reconstructor like any other."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from feed_forward_fixtures import STORED, Case, Pass, extra, published_shapes, with_rule_v1
from gscompleter import GSCompleter, InputError
from gscompleter.models.feed_forward import (
    VARIANTS,
    DepthSplat,
    DepthSplatConfig,
    FeedForward,
    MVSplat,
    MVSplatConfig,
)
from gscompleter.models.feed_forward.cameras import Cameras, find_nearest_views
from gscompleter.models.feed_forward.cost_volume import compute_cost_volume, compute_sampling_grid
from gscompleter.models.feed_forward.depth_predictor import DepthConfig, sample_candidates
from gscompleter.models.feed_forward.gaussian_adapter import place_in_world
from gscompleter.models.feed_forward.inputs import Crop, compute_central_crops, create_batch
from gscompleter.models.feed_forward.spherical_harmonics import (
    compute_wigner_matrices,
    evaluate_harmonics,
)
from gscompleter.numerics.geometry import pad_camera, project, quats_to_rotations
from gscompleter.types import View
from parity import assert_close, assert_within, relative_error
from scenes import Room, camera_at, view_of

ARCHITECTURES = {
    "small-s1-u4-l4": "small-re10k-256x256",
    "base-s2-u2-l4": "base-re10k-256x256",
    "base-s2-u4-l8": "base-re10k-256x448",
    "small-s1-u8-l8": "small-re10kdl3dv-448x768",
    "large-s2-u2-l4": "large-re10k-256x256",
}
"""Names of the fixtures, and a published variant with the same weights."""
NETWORKS = ("mvsplat", "small-s1-u4-l4")
MVSPLAT_IN_SHORT = ["mvsplat", pytest.param(NETWORKS[1], marks=pytest.mark.slow)]
"""Networks of tests of what both share."""


@cache
def network(name: str) -> MVSplat | DepthSplat:
    """Return the shared network with the fixtures' weights; copy it with `update` to modify it."""
    if name == "mvsplat":
        return with_rule_v1(MVSplat(), "mvsplat")
    return with_rule_v1(DepthSplat(VARIANTS[ARCHITECTURES[name]]), "depthsplat")


def changed(name: str, config: MVSplatConfig | DepthSplatConfig | None = None, **biases: float):
    """Copy the network with another configuration and constant values for some biases."""
    same = deepcopy(network(name))
    if config is not None:
        weights = same.state_dict()
        same = type(same)(config)
        same.load_state_dict(weights)
    for key, value in biases.items():
        same.get_parameter(key.replace("__", ".") + ".bias").data.fill_(value)
    return same


def check(path: Path, name: str) -> None:
    """Compare intermediate and final values with those of the authors' code."""
    case = Case.load(path)
    run = Pass.through(network(name), case.images, case.cameras)
    between = run.of_mvsplat() if name == "mvsplat" else run.of_depthsplat()
    assert_within(case.output_errors(run.predicted))
    errors = case.intermediate_errors(between)
    assert len(errors) >= 9
    assert_within(errors)


# The authors' code


@pytest.mark.parametrize("case", ["v2_64x64", "v3_64x96"])
def test_mvsplat_equals_the_authors_code(case):
    check(STORED / "mvsplat" / f"{case}.npz", "mvsplat")


@pytest.mark.parametrize(
    "name", ["small-s1-u4-l4", pytest.param("base-s2-u2-l4", marks=pytest.mark.slow)]
)
def test_depthsplat_equals_the_authors_code(name):
    check(STORED / "depthsplat" / f"{name}_v2_64x64.npz", name)


@pytest.mark.parametrize("case", ["v4_64x64", pytest.param("v2_256x256", marks=pytest.mark.slow)])
def test_mvsplat_equals_the_authors_code_with_more_views_and_pixels(shared, case):
    check(shared / "fixtures" / "mvsplat" / f"{case}.npz", "mvsplat")


@pytest.mark.parametrize(
    "case",
    [
        "small-s1-u4-l4_v3_64x96",
        pytest.param("small-s1-u4-l4_v5_64x64", marks=pytest.mark.slow),
        pytest.param("small-s1-u8-l8_v2_64x96", marks=pytest.mark.slow),
        # Two scales are compared above, and eight layers in the line before.
        pytest.param("base-s2-u4-l8_v2_64x96", marks=pytest.mark.slow),
        pytest.param("small-s1-u4-l4_v2_256x256", marks=pytest.mark.slow),
    ],
)
def test_depthsplat_equals_the_authors_code_with_more_views_and_pixels(shared, case):
    check(shared / "fixtures" / "depthsplat" / f"{case}.npz", case.split("_")[0])


@pytest.mark.parametrize("path", extra("mvsplat"), ids=lambda path: path.stem)
def test_mvsplat_equals_the_authors_code_in_more_cases(path):
    check(path, "mvsplat")


@pytest.mark.parametrize("path", extra("depthsplat"), ids=lambda path: path.stem)
def test_depthsplat_equals_the_authors_code_in_more_cases(path):
    check(path, path.stem.split("_")[0])


def test_weights_of_mvsplat_are_named_and_shaped_as_published():
    with torch.device("meta"):
        weights = MVSplat().state_dict()
    assert {key: tuple(x.shape) for key, x in weights.items()} == published_shapes(
        "mvsplat", "keys"
    )


@pytest.mark.parametrize("variant", VARIANTS)
def test_weights_of_depthsplat_are_named_and_shaped_as_published(variant):
    config = VARIANTS[variant]
    (name,) = (a for a, v in ARCHITECTURES.items() if VARIANTS[v].depth == config.depth)
    with torch.device("meta"):
        weights = DepthSplat(config).state_dict()
    expected = published_shapes("depthsplat", f"keys-{name}")
    assert {key: tuple(x.shape) for key, x in weights.items()} == expected


@pytest.mark.parametrize("name", MVSPLAT_IN_SHORT)
def test_weights_can_be_assigned_to_a_network_that_was_built_without_any(name):
    given = network(name)
    with torch.device("meta"):
        empty = type(given)(given.config)
    empty.load_state_dict(given.state_dict(), strict=True, assign=True)
    case = Case.load(STORED / ("mvsplat" if name == "mvsplat" else "depthsplat") / fixture(name))
    with torch.no_grad():
        ours, theirs = (net(case.images, case.cameras) for net in (empty, given))
    assert torch.equal(ours.means, theirs.means)


def fixture(name: str) -> str:
    return "v2_64x64.npz" if name == "mvsplat" else f"{name}_v2_64x64.npz"


# Spherical harmonics


def random_rotations(count: int) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return quats_to_rotations(torch.randn(count, 4, generator=generator, dtype=torch.float64))


@pytest.mark.parametrize("degree", range(5))
def test_harmonics_turn_with_the_matrices_of_e3nn(degree):
    case = Case.load(STORED / "sh" / "wigner.npz")
    ours = compute_wigner_matrices(degree, case.tensor("R"))
    assert_close(ours, case.tensor(f"D{degree}"), f"D{degree}")


@pytest.mark.parametrize("degree", range(1, 5))
def test_a_turned_harmonic_is_the_harmonic_of_the_turned_direction(degree):
    rotations, directions = random_rotations(3), random_rotations(3)[:, 0]
    turned = evaluate_harmonics(degree, (rotations @ directions[..., None])[..., 0])
    matrices = compute_wigner_matrices(degree, rotations)
    ours = (matrices @ evaluate_harmonics(degree, directions)[..., None])[..., 0]
    assert torch.allclose(ours, turned, atol=1e-12)


def test_harmonics_of_degree_one_have_their_pole_along_y():
    directions = random_rotations(2)[:, 0]
    assert torch.allclose(
        evaluate_harmonics(1, directions), 0.4886025119029199 * directions, atol=1e-12
    )


# Cost volumes


def camera_pair(near: float = 1.0, far: float = 100.0) -> Cameras:
    """Create two parallel cameras, 0.4 apart."""
    c2w = torch.eye(4).repeat(1, 2, 1, 1)
    c2w[0, 1, 0, 3] = 0.4
    K = torch.tensor([[0.9, 0.0, 0.5], [0.0, 0.9, 0.5], [0.0, 0.0, 1.0]])
    return Cameras(c2w, K.repeat(1, 2, 1, 1), torch.full((1, 2), near), torch.full((1, 2), far))


def test_a_point_that_is_not_in_front_of_the_source_is_projected_from_a_thousandth():
    """Pixel (1, 0) at depth 2 is (2, 0, 2), and (2, 0, -3) in the source: x = 2 / 0.001."""
    transform = torch.eye(4)
    transform[2, 3] = -5
    grid = compute_sampling_grid(torch.eye(3), transform, torch.full((1, 2, 3), 2.0))
    assert grid[0, 0, 1].tolist() == pytest.approx([1999.0, -1.0], rel=1e-5)


def test_a_point_is_compared_with_the_pixel_where_the_source_sees_it():
    """At depth 3.6 a baseline of 0.4 moves the pixels of an 8 pixel wide map by 0.8."""
    K = camera_pair().scale_intrinsics(8, 8)[0, 0]
    transform = camera_pair().compute_sources_from_views(torch.tensor([[[1], [0]]]))[0, 0, 0]
    grid = compute_sampling_grid(K, transform, torch.full((1, 8, 8), 3.6))
    columns = (grid[0, 2, :, 0] + 1) / 2 * 7
    assert torch.allclose(columns, torch.arange(8) - 0.8, atol=1e-5)


def test_the_size_of_the_chunks_changes_nothing():
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(2, 32, 8, 8, generator=generator)
    candidates = torch.linspace(0.01, 1, 20)[None, :, None, None].expand(2, -1, 1, 1)
    sources = torch.tensor([[[1], [0]]])
    whole = compute_cost_volume(features, camera_pair(), sources, candidates, 20)
    assert whole.abs().max() > 0.1
    for size in (1, 7):
        parts = compute_cost_volume(features, camera_pair(), sources, candidates, size)
        assert_close(parts, whole, "costs")


@pytest.mark.parametrize("name", MVSPLAT_IN_SHORT)
def test_the_size_of_the_chunks_does_not_change_the_gaussians(name):
    config = network(name).config
    if isinstance(config, MVSplatConfig):
        other = replace(config, depth_chunk=128)
    else:
        other = replace(config, depth=replace(config.depth, depth_chunk=128))
    images = stereo_images()
    with torch.no_grad():
        ours = network(name)(images, camera_pair())
        whole = changed(name, other)(images, camera_pair())
    assert_close(ours.means, whole.means, "means")


def test_finer_candidates_lie_around_the_coarse_estimate():
    low, high = torch.full((1, 1, 1, 1), 0.01), torch.full((1, 1, 1, 1), 2.0)
    coarse = torch.tensor([1.0, 0.05, 1.95]).view(1, 1, 1, 3)
    interval = torch.full((1, 1, 1, 1), 0.01)
    candidates = sample_candidates(coarse, interval, 32, low, high)[0, :, 0]
    assert candidates[:, 0].tolist() == pytest.approx([0.84 + 0.01 * i for i in range(32)])
    # The end that would lie beyond a limit is moved there; the others close up evenly.
    assert candidates[:, 1].tolist() == pytest.approx([0.01 + i * 0.19 / 31 for i in range(32)])
    assert candidates[:, 2].tolist() == pytest.approx([1.79 + i * 0.21 / 31 for i in range(32)])


def test_the_nearest_views_are_the_closest_others():
    c2w = torch.eye(4).repeat(1, 5, 1, 1)
    c2w[0, :, 0, 3] = torch.tensor([0.0, 1.0, 3.0, 3.5, 10.0])
    cameras = Cameras(c2w, torch.eye(3).repeat(1, 5, 1, 1), torch.ones(1, 5), torch.ones(1, 5) * 2)
    expected = [[1, 2], [0, 2], [3, 1], [2, 1], [3, 2]]
    assert find_nearest_views(cameras, 2)[0].tolist() == expected


def test_no_view_is_its_own_source_among_others_at_its_position():
    """As of a panorama, whose images share a centre."""
    c2w = torch.eye(4).repeat(1, 6, 1, 1)
    c2w[0, 3:, 0, 3] = 1
    ones = torch.ones(1, 6)
    sources = find_nearest_views(Cameras(c2w, c2w[..., :3, :3], ones, ones), 2)[0].tolist()
    assert [sorted(row) for row in sources] == [[1, 2], [0, 2], [0, 1], [4, 5], [3, 5], [3, 4]]


def test_the_nearest_views_are_found_far_from_the_origin():
    c2w = torch.eye(4).repeat(1, 30, 1, 1)
    c2w[0, :, :3, 3] = torch.tensor([8000.0, 8000.0, 0.0])
    c2w[0, :, 0, 3] += torch.arange(30) ** 2 / 64
    ones = torch.ones(1, 30)
    cameras = Cameras(c2w, torch.eye(3).repeat(1, 30, 1, 1), ones, 2 * ones)
    assert find_nearest_views(cameras, 1)[0, :, 0].tolist() == [1, *range(29)]


# Networks


def stereo_images(seed: int = 0) -> Tensor:
    return torch.rand(1, 2, 3, 64, 64, generator=torch.Generator().manual_seed(seed))


DEPTH_BIAS = {
    "mvsplat": "depth_predictor__to_disparity__2",
    "small-s1-u4-l4": "depth_predictor__upsampler__scratch__output_conv__4",
}


@pytest.mark.parametrize("name", MVSPLAT_IN_SHORT)
def test_depth_stays_within_the_range_of_each_view(name):
    cameras = ranged_pair()
    for bias, limits in ((1e3, cameras.near), (-1e3, cameras.far)):
        with torch.no_grad():
            depth = changed(name, **{DEPTH_BIAS[name]: bias})(stereo_images(), cameras).depth
        assert torch.allclose(depth, limits[..., None, None].expand_as(depth), rtol=1e-6)


def silent(*layers: torch.nn.Module) -> None:
    """Set weights and biases of layers to 0."""
    for layer in layers:
        for weight in layer.parameters():
            torch.nn.init.zeros_(weight)


def ranged_pair() -> Cameras:
    """Create two views with different depth ranges."""
    near, far = torch.tensor([[1.0, 2.0]]), torch.tensor([[50.0, 80.0]])
    return replace(camera_pair(), near=near, far=far)


def test_undecided_mvsplat_takes_the_middle_of_each_views_inverse_range():
    undecided = changed("mvsplat")
    predictor = undecided.depth_predictor
    silent(predictor.depth_head_lowres[2], predictor.to_disparity[2])
    cameras = ranged_pair()
    with torch.no_grad():
        disparity = 1 / undecided(stereo_images(), cameras).depth
    middle = (1 / cameras.near + 1 / cameras.far) / 2
    assert torch.allclose(disparity, middle[..., None, None].expand_as(disparity), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["small-s1-u4-l4", "base-s2-u2-l4"])
def test_undecided_depthsplat_takes_the_middle_of_each_views_inverse_range(name):
    """At a second scale, 32 candidates reach from 16 intervals below to 15 above the first."""
    undecided = changed(name)
    predictor = undecided.depth_predictor
    silent(*(head[2] for head in predictor.depth_head), predictor.upsampler.scratch.output_conv[4])
    cameras = ranged_pair()
    with torch.no_grad():
        disparity = 1 / undecided(stereo_images(), cameras).depth
    middle = (1 / cameras.near + 1 / cameras.far) / 2
    if len(predictor.depth_head) == 2:
        interval = (1 / cameras.near - 1 / cameras.far) / 127 / 2
        middle = middle - interval / 2
    assert torch.allclose(disparity, middle[..., None, None].expand_as(disparity), rtol=1e-5)


def test_no_gaussian_of_depthsplat_grows_beyond_the_limit():
    config = replace(VARIANTS["small-re10k-256x256"], gaussian_scale_max=0.1)
    with torch.no_grad():
        scales = changed("small-s1-u4-l4", config, gaussian_head__2=100.0)(
            stereo_images(), camera_pair()
        ).scales
    assert (scales == 0.1).all()


def test_quats_and_scales_stand_for_the_camera_covariance_turned_into_the_world():
    """`R_c2w (R S S R^T) R_c2w^T` with R of a raw xyzw quaternion, as SciPy has it."""
    generator = torch.Generator().manual_seed(0)
    raw = torch.randn(1, 2, 4, 5, 4, generator=generator)
    scales = torch.rand(1, 2, 4, 5, 3, generator=generator)
    cameras = camera_pair()
    cameras.c2w[0, :, :3, :3] = random_rotations(2).float()
    ones = torch.ones(1, 2, 4, 5)
    gaussians = place_in_world(scales, ones, raw, scales, ones, scales[..., None, :], cameras)

    c2w = cameras.c2w[:, :, None, None, :3, :3].double()
    own = torch.from_numpy(Rotation.from_quat(raw.reshape(-1, 4)).as_matrix()).view(
        1, 2, 4, 5, 3, 3
    )
    spread = own * scales[..., None, :]
    expected = c2w @ spread @ spread.transpose(-1, -2) @ c2w.transpose(-1, -2)
    axes = quats_to_rotations(gaussians.quats) * gaussians.scales[..., None, :]
    assert_close(axes @ axes.transpose(-1, -2), expected, "covariances")


@pytest.mark.parametrize("name", MVSPLAT_IN_SHORT)
def test_scenes_of_a_batch_do_not_know_of_each_other(name):
    images = torch.cat([stereo_images(1), stereo_images(2)])
    first, second = camera_pair(), camera_pair(near=2.0, far=30.0)
    second.c2w[0, 1, 1, 3] = 0.2
    fields = ("c2w", "K", "near", "far")
    both = Cameras(*(torch.cat([getattr(first, f), getattr(second, f)]) for f in fields))
    with torch.no_grad():
        together = network(name)(images, both)
        alone = [network(name)(images[i : i + 1], c) for i, c in enumerate((first, second))]
    for field in ("depth", "means", "quats", "scales", "opacities", "sh"):
        expected = torch.cat([getattr(one, field) for one in alone])
        assert_close(getattr(together, field), expected, field)


@pytest.mark.parametrize("name", MVSPLAT_IN_SHORT)
def test_gaussians_move_with_the_cameras(name):
    """Only the frame changes: the network is invariant to a common motion of the cameras."""
    here = camera_pair()
    turned = random_rotations(1)[0].float()
    move = torch.eye(4)
    move[:3, :3], move[:3, 3] = turned, torch.tensor([3.0, -2.0, 1.0])
    with torch.no_grad():
        before = network(name)(stereo_images(), here)
        after = network(name)(stereo_images(), replace(here, c2w=move @ here.c2w))
    assert relative_error(after.means, before.means @ turned.T + move[:3, 3]) < 1e-3
    assert relative_error(after.scales, before.scales) < 1e-3
    rotations = turned @ quats_to_rotations(before.quats)
    assert (quats_to_rotations(after.quats) - rotations).abs().quantile(0.99) < 1e-2


# A CPU takes minutes for some convolutions of bfloat16.
@pytest.mark.slow
@pytest.mark.parametrize("name", ["mvsplat", NETWORKS[1]])
def test_geometry_stays_exact_where_the_network_runs_in_lower_precision(name):
    """On a CPU, where this can be tried: each Gaussian lies on the ray of its own pixel."""
    cameras = camera_pair()
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        predicted = network(name)(stereo_images()[..., :32, :32], cameras)
    for field in ("depth", "means", "quats", "scales", "opacities", "sh"):
        assert getattr(predicted, field).dtype == torch.float32
        assert getattr(predicted, field).isfinite().all()
    offset = predicted.means - cameras.c2w[:, :, None, None, :3, 3]
    along = offset.norm(dim=-1) if name == "mvsplat" else offset[..., 2]
    assert torch.allclose(along, predicted.depth, rtol=1e-5)


# Ψ


def off_centre(x: float, height: int, width: int, **known: float | None) -> View:
    """Create a view with an off-centre principal point, not divisible into patches."""
    camera = camera_at(x, y=0.1 * x, yaw=5 * x, size=width)
    K = torch.tensor([[70.0, 0.0, 0.47 * width], [0.0, 66.0, 0.56 * height], [0.0, 0.0, 1.0]])
    return view_of(Room(), replace(camera, K=K, height=height, **known))


@pytest.mark.parametrize(("name", "coefficients"), [("mvsplat", 16), ("small-s1-u4-l4", 9)])
def test_gaussians_belong_to_pixels_of_the_whole_image(name, coefficients):
    """70 x 75 pixels are cropped to 64 x 64, three rows from the top and five columns in."""
    views = [off_centre(x, 70, 75) for x in (-0.2, 0.2)]
    result = FeedForward(network(name))(views)
    gaussians = result.gaussians
    assert len(gaussians) == 2 * 64 * 64
    assert gaussians.sh.shape[1:] == (coefficients, 3)
    assert (gaussians.generated == 0).all()
    inside = torch.zeros(70, 75, dtype=torch.bool)
    inside[3:67, 5:69] = True
    for i, (view, known) in enumerate(zip(views, result.depths, strict=True)):
        own = result.view_index == i
        numbers = result.pixel_index[own]
        assert torch.equal(numbers, inside.flatten().nonzero()[:, 0])
        assert torch.equal(known.valid, inside)
        assert (known.depth[~inside] == 0).all()
        pixels, z = project(gaussians.means[own], view.camera)
        assert torch.allclose(known.depth.flatten()[numbers], z, rtol=1e-5)
        centers = torch.stack([numbers % 75, numbers // 75], dim=-1) + 0.5
        assert (pixels - centers).abs().max() < 0.5 + 1e-3
        assert (pixels - centers).abs().max() > 0.1


def test_depth_of_mvsplat_is_a_distance_and_depth_of_depthsplat_is_z():
    views = [off_centre(x, 64, 64) for x in (-0.2, 0.2)]
    images, cameras, _ = create_batch(views, 16)
    for name in NETWORKS:
        with torch.no_grad():
            predicted = network(name)(images, cameras)
        distance = (predicted.means - cameras.c2w[:, :, None, None, :3, 3]).norm(dim=-1)
        z = FeedForward(network(name))(views).depths[1].depth
        expected = distance[0, 1] if name == "mvsplat" else z
        assert torch.allclose(predicted.depth[0, 1], expected, rtol=1e-5)
        assert not torch.allclose(distance[0, 1], z, rtol=1e-2)


def test_cameras_without_a_depth_range_take_that_of_the_model():
    known, unknown = off_centre(0, 64, 64), off_centre(0.2, 64, 64, near=None, far=None)
    _, cameras, _ = create_batch([known, unknown], 16, (1.0, 100.0))
    assert cameras.near.tolist() == [[0.5, 1.0]]
    assert cameras.far.tolist() == [[20.0, 100.0]]


def test_the_second_run_gives_the_same_and_its_result_can_be_optimised():
    views = [off_centre(x, 64, 64) for x in (-0.2, 0.2)]
    model = FeedForward(network("mvsplat"))
    first, second = model(views).gaussians, model(views).gaussians
    assert torch.equal(first.means, second.means)
    assert torch.equal(first.sh, second.sh)
    factor = torch.ones((), requires_grad=True)
    (first.means * factor).sum().backward()
    assert factor.grad is not None


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("number", [3, pytest.param(5, marks=pytest.mark.slow)])
def test_any_number_of_views_will_do(name, number):
    views = [off_centre(0.2 * i, 32, 48) for i in range(number)]
    result = FeedForward(network(name))(views)
    assert len(result.depths) == number
    assert len(result.gaussians) == number * 32 * 48
    assert result.gaussians.means.isfinite().all()


def test_crops_are_central_of_one_size_and_as_large_as_patches_allow():
    cameras = [replace(camera_at(), height=h, width=w) for h, w in ((270, 480), (300, 450))]
    assert compute_central_crops(cameras, 64) == [Crop(7, 16, 256, 448), Crop(22, 1, 256, 448)]


def test_of_a_wider_view_the_network_sees_what_it_sees_of_the_others():
    """Widening a camera keeps its rays, so the crop is the image as it was."""
    views = [off_centre(x, 64, 64) for x in (-0.2, 0.2)]
    window = pad_camera(views[0].camera, 0.25)
    camera, left, top = window.padded, window.left, window.top
    wide = view_of(Room(), camera)
    model = FeedForward(network("mvsplat"))
    narrow, mixed = model(views), model([wide, views[1]])
    assert relative_error(mixed.gaussians.means, narrow.gaussians.means) < 1e-3
    rows, columns = slice(top, top + 64), slice(left, left + 64)
    assert mixed.depths[0].valid[rows, columns].all()
    assert mixed.depths[0].valid.sum() == 64 * 64
    assert relative_error(mixed.depths[0].depth[rows, columns], narrow.depths[0].depth) < 1e-3


def test_wrong_views_are_refused_with_a_sentence():
    model = FeedForward(network("mvsplat"))
    view = off_centre(0, 64, 64)
    with pytest.raises(InputError, match="1 view was given, and the model matches at least 2"):
        model([view])
    with pytest.raises(InputError, match="15 x 64 pixels in common, .* needs at least 16 x 16"):
        model([view, off_centre(0, 15, 80)])
    with pytest.raises(InputError, match="cpu and torch.bfloat16 needs a GPU"):
        FeedForward(network("mvsplat"), torch.bfloat16)


def test_variants_need_the_patches_they_were_trained_with():
    patches = {name: config.patch for name, config in VARIANTS.items()}
    assert {name for name, patch in patches.items() if patch == 16} == {
        f"{size}-re10k-256x256" for size in ("small", "base", "large")
    }
    for config in VARIANTS.values():
        assert all(side % config.patch == 0 for side in config.image_size)
    assert DepthConfig("vitb", 2, 4, 8).patch == 64


@pytest.mark.parametrize("name", MVSPLAT_IN_SHORT)
def test_smoke_a_completion_runs_with_random_weights(name):
    """Random weights: this only checks that all stages accept the output."""
    views = [view_of(Room(), camera_at(x, size=64), i) for i, x in enumerate((-0.3, 0.1))]
    target = camera_at(0.7, yaw=12, size=64)
    completion = GSCompleter(reconstructor=FeedForward(network(name)))(views, target)
    assert len(completion.context) == 2 * 64 * 64
    assert set(completion.seconds) == {
        *("context", "generate", "lift", "register", "integrate", "total")
    }
    (result,) = completion.targets
    assert result.reference is not None
    assert result.reference.image.shape == (64, 64, 3)
    assert result.after.image.shape == (64, 64, 3)
    assert result.losses["register"]
    assert completion.scene.means.isfinite().all()
    assert torch.equal(completion.scene.means[: len(completion.context)], completion.context.means)
