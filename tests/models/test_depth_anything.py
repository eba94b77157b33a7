"""Depth Anything 3: equal to the authors' code, and a reconstructor like any other."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from depth_anything_fixtures import (
    FIXTURES,
    OFFICIAL,
    STAND_INS,
    errors_in,
    gaussian_errors,
    images_and_poses,
    network_for,
    shapes_in,
)
from feed_forward_fixtures import Case, extra
from gscompleter import GSCompleter, InputError
from gscompleter.config import CompleterConfig, HoleConfig
from gscompleter.models import depth_anything
from gscompleter.models.depth_anything import (
    VARIANTS,
    AnyViewDepth,
    AnyViewGaussians,
    DepthAnything,
    DepthAnythingConfig,
    Inference,
    MetricDepthAnything,
    MetricDepthConfig,
    MetricViewDepth,
    NestedConfig,
    NestedDepthAnything,
    ResizeConfig,
)
from gscompleter.models.depth_anything.alignment import fit_center_similarity, fit_robust_similarity
from gscompleter.models.depth_anything.config import VitConfig
from gscompleter.models.depth_anything.harmonics import rotate_3dgs_sh
from gscompleter.models.depth_anything.images import normalize_colors
from gscompleter.models.depth_anything.inputs import Window, create_any_view_batch, crop_to_patches
from gscompleter.models.depth_anything.metric import MetricDepth
from gscompleter.models.depth_anything.network import Prediction
from gscompleter.models.depth_anything.normalisation import (
    compute_authors_units,
    compute_scene_units,
    normalize_poses,
)
from gscompleter.models.depth_anything.poses import (
    Poses,
    decode_poses,
    encode_poses,
    invert_rigid,
)
from gscompleter.models.depth_anything.reconstructor import move_to_given_frame
from gscompleter.models.feed_forward.build import create_depth_anything, wrap_network
from gscompleter.numerics.geometry import (
    axis_angle_to_matrix,
    project,
    quats_to_rotations,
    unproject,
)
from gscompleter.reconstructors import load_reconstructor
from gscompleter.reconstructors.from_depth import FromDepth
from gscompleter.render.spherical_harmonics import evaluate_sh_basis
from gscompleter.types import View
from parity import assert_within, relative_error
from scenes import Room, camera_at, view_of

BOUND = 5e-5
"""Largest difference from the authors' code, of the array's largest value."""
ROTATIONS = 1e-4
"""Likewise of quaternions, which were made from matrices."""
LONG = ("gs-giantlike_pose_v2_70x98", "gs-giantlike_pose_v3_42x56", "small_nopose_v1_518x518")
"""Cases of large networks or images."""


# The authors' code


def cases(folder: list[Path]) -> list[object]:
    """List the fixture files of a network."""
    paths = [path for path in folder if path.stem.split("_")[0] in STAND_INS]
    return [pytest.param(path, id=path.stem) for path in paths]


def check(path: Path) -> None:
    """Compare all stored intermediate and final arrays."""
    errors = errors_in(path)
    rotations = {name: error for name, error in errors.items() if name.endswith("rotations")}
    assert_within({name: e for name, e in errors.items() if name not in rotations}, BOUND)
    stored = [name for name in Case.load(path).values if name.startswith(("out_", "mid_"))]
    # Rays are what cameras tell, which are always given.
    left_out = ("pose_scale", "align_raised", "world", "mid_stride", "mid_ray", "_aux")
    missing = [
        name
        for name in stored
        if not any(known.startswith(name) for known in errors)
        and not any(t in name for t in left_out)
    ]
    assert missing == []
    if rotations:
        assert_within(rotations, ROTATIONS)


def test_a_network_with_gaussians_equals_the_authors_code():
    check(FIXTURES / "gs-tiny_pose_v3clamp_42x56.npz")


@pytest.mark.parametrize(
    "name",
    [
        "small_pose_v2_70x98",
        "small_pose_b2v2_56x84",
        "small_nopose_v2_56x70",
        "small_nopose_v5_42x56",
        "metric-tiny_v1_56x84",
        pytest.param("nested-tiny_v2_56x84", marks=pytest.mark.slow),
        "gs-tiny_pose_v2_56x84",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in (
                "small_pose_v3_70x98",
                "small_nopose_v3_70x98",
                "metric-tiny_v2_70x98",
                "gs-tiny_pose_v3_70x98",
                "gs-tiny_nopose_v2_56x70",
                *LONG,
            )
        ),
    ],
)
def test_every_network_equals_the_authors_code(shared, name):
    check(shared / "fixtures" / "da3" / f"{name}.npz")


@pytest.mark.parametrize("path", cases(extra("da3")))
def test_every_network_equals_the_authors_code_in_more_cases(path):
    check(path)


@pytest.mark.parametrize("name", ["da3-small", "da3-giant"])
def test_weights_are_named_and_shaped_as_published(name):
    check_names(FIXTURES / f"keys-{name}.json")


def test_weights_of_all_networks_are_named_and_shaped_as_published(shared):
    lists = sorted((shared / "fixtures" / "da3").glob("keys-*.json"))
    assert len(lists) == 8
    for path in lists:
        check_names(path)


@pytest.mark.parametrize("path", extra("da3", "keys-*.json"), ids=lambda path: path.stem)
def test_weights_are_named_and_shaped_as_in_more_lists(path):
    check_names(path)


def check_names(path: Path) -> None:
    name = path.stem.removeprefix("keys-")
    with torch.device("meta"):
        network = create_depth_anything(
            VARIANTS[OFFICIAL[name]] if name in OFFICIAL else STAND_INS[name]
        )
    ours = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    assert ours == shapes_in(path)


@pytest.mark.parametrize("path", [FIXTURES / "align.npz", *extra("da3", "align*.npz")])
def test_cameras_are_normalised_and_aligned_as_by_the_authors(path):
    case = Case.load(path)
    counts = [int(name.rsplit("_", 1)[1]) for name in case.values if name.startswith("in_c2w")]
    assert counts
    for count in counts:
        given = Poses(case.tensor(f"in_c2w_{count}")[None], torch.eye(3).repeat(1, count, 1, 1))
        normalized = normalize_poses(given, compute_authors_units(given.centers))
        expected = case.tensor(f"out_ext_norm_{count}")
        assert relative_error(invert_rigid(normalized.c2w)[0], expected) < BOUND
        w2c = case.tensor(f"in_pred_w2c_{count}").double()
        found = (-w2c[:, :, :3].transpose(1, 2) @ w2c[:, :, 3:])[..., 0].numpy()
        if f"out_align_s_{count}" not in case.values:
            continue
        ours = fit_robust_similarity(given.centers[0].double().numpy(), found)
        for name, value in (("r", ours.rotation), ("t", ours.shift), ("s", ours.scale)):
            theirs = case.tensor(f"out_align_{name}_{count}")
            assert relative_error(torch.as_tensor(value, dtype=torch.float64), theirs) < BOUND, name
        scale = fit_center_similarity(found, normalized.centers[0].double().numpy()).scale
        assert scale == pytest.approx(float(case.values[f"out_pose_scale_{count}"]), rel=BOUND)


def check_world(path: Path) -> None:
    """Compare the Gaussians after the transform to the given cameras."""
    case = Case.load(path)
    images, poses = images_and_poses(case)
    given = Poses(case.tensor("in_c2w"), case.tensor("in_intrinsics_px"))
    with torch.no_grad():
        predicted = network_for(path.stem.split("_")[0])(images, poses)
    errors = gaussian_errors(move_to_given_frame(predicted, given), case, "out_world_")
    rotations = errors.pop("out_world_rotations")
    assert rotations < ROTATIONS
    assert len(errors) >= 2
    assert_within(errors, BOUND)


def test_gaussians_are_brought_to_the_given_cameras():
    check_world(FIXTURES / "gs-tiny_pose_v3clamp_42x56.npz")


def test_gaussians_of_two_views_are_brought_to_the_given_cameras(shared):
    check_world(shared / "fixtures" / "da3" / "gs-tiny_pose_v2_56x84.npz")


@pytest.mark.parametrize("path", [p for p in extra("da3") if p.stem.startswith("gs-")])
def test_gaussians_are_brought_to_the_given_cameras_in_more_cases(path):
    if "out_world_means" not in Case.load(path).values:
        pytest.skip("no poses were given")
    check_world(path)


def check_images(path: Path) -> None:
    """Compare sizes, intrinsics, and pixels up to the rounding of another OpenCV."""
    case = Case.load(path)
    numbers = [name.rsplit("_", 1)[1] for name in case.values if name.startswith("in_image")]
    assert numbers
    for number in numbers:
        bound, fit = str(case.values[f"in_method_{number}"]).split("_bound_")
        side, fit = {"upper": "longer", "lower": "shorter"}[bound], {"resize": "resized"}.get(fit)
        sizing = ResizeConfig(int(case.values[f"in_res_{number}"]), side, fit or "cropped")
        image, expected = case.values[f"in_image_{number}"], case.values[f"out_image_{number}"]
        seen, window = crop_to_patches(image, sizing)
        assert seen.shape == expected.shape
        apart = np.abs(seen.astype(int) - expected)
        assert apart.max() <= 1
        assert (apart > 0).mean() < 0.02
        h, w = image.shape[:2]
        camera = replace(camera_at(), K=case.tensor(f"in_K_{number}"), width=w, height=h)
        assert (
            relative_error(window.compute_intrinsics(camera), case.tensor(f"out_K_{number}"))
            < BOUND
        )
        if f"out_tensor_{number}" in case.values:
            tensor = normalize_colors(torch.from_numpy(expected[None].copy()))[..., ::3, ::3]
            assert relative_error(tensor, case.tensor(f"out_tensor_{number}")) < BOUND


def test_photographs_are_resized_as_by_the_authors(shared):
    check_images(shared / "fixtures" / "da3" / "preprocess.npz")


@pytest.mark.parametrize("path", extra("da3", "preprocess*.npz"), ids=lambda path: path.stem)
def test_photographs_are_resized_as_by_the_authors_in_more_cases(path):
    check_images(path)


# Cameras


def turned_cameras(count: int = 3) -> Poses:
    generator = torch.Generator().manual_seed(0)
    c2w = torch.eye(4).repeat(1, count, 1, 1)
    c2w[0, :, :3, :3] = quats_to_rotations(torch.randn(count, 4, generator=generator))
    c2w[0, :, :3, 3] = torch.randn(count, 3, generator=generator)
    K = torch.tensor([[50.0, 0.0, 42.0], [0.0, 60.0, 28.0], [0.0, 0.0, 1.0]])
    return Poses(c2w, K.repeat(1, count, 1, 1))


def test_nine_numbers_tell_a_camera():
    poses = turned_cameras()
    again = decode_poses(encode_poses(poses, (56, 84)), (56, 84))
    assert relative_error(again.c2w, poses.c2w) < 1e-5
    assert relative_error(again.K, poses.K) < 1e-5


@pytest.mark.parametrize("count", [2, 3, 5])
def test_the_network_is_told_the_same_in_any_unit(count):
    poses = turned_cameras(count)
    moved = poses.c2w.clone()
    moved[..., :3, 3] *= 1e-4
    small = replace(poses, c2w=moved)
    ours = [normalize_poses(p, compute_scene_units(p.centers)).c2w for p in (poses, small)]
    assert relative_error(ours[1], ours[0]) < 1e-5
    assert (
        torch.equal(ours[0][:, 0], torch.eye(4)[None])
        or ours[0][:, 0].sub(torch.eye(4)).abs().max() < 1e-6
    )
    theirs = [normalize_poses(p, compute_authors_units(p.centers)).c2w for p in (poses, small)]
    assert relative_error(theirs[1], theirs[0]) > 0.1


def test_the_unit_of_many_cameras_is_the_authors():
    centers = turned_cameras(5).centers
    assert torch.equal(compute_scene_units(centers), compute_authors_units(centers))


def test_cameras_in_one_place_are_refused():
    views = [view_of(Room(), camera_at(size=28))] * 2
    with pytest.raises(InputError, match="2 cameras stand in one place"):
        AnyViewDepth(knowing(views))(views)


def test_the_scale_of_cameras_on_one_line_is_told():
    line = np.arange(4.0)[:, None] * np.array([1.0, 2.0, -1.0])
    for count in (2, 4):
        found = fit_center_similarity(line[:count], 3 * line[:count] + 1)
        assert found.scale == pytest.approx(3)


def test_a_minority_of_wrong_cameras_is_left_out():
    given = np.random.default_rng(0).normal(size=(12, 3))
    found = 2 * given
    found[:2] += 5
    assert fit_robust_similarity(given, found).scale == pytest.approx(2)
    assert abs(fit_center_similarity(given, found).scale - 2) > 0.05


def test_harmonics_turn_with_what_they_colour():
    generator = torch.Generator().manual_seed(0)
    sh = torch.randn(1, 1, 1, 1, 9, 3, generator=generator)
    turn = quats_to_rotations(torch.randn(4, generator=generator))
    directions = torch.nn.functional.normalize(torch.randn(20, 3, generator=generator), dim=-1)
    turned = rotate_3dgs_sh(sh, turn[None, None])[0, 0, 0, 0]
    before = evaluate_sh_basis(directions, 9) @ sh[0, 0, 0, 0]
    assert relative_error(evaluate_sh_basis(directions @ turn.T, 9) @ turned, before) < 1e-5


# Ψ

TINY = DepthAnythingConfig(VitConfig(64, 1, 4, (0, 1, 2, 3), 1), 32, (16, 16, 16, 16))
TINY_GAUSSIANS = replace(TINY, has_gaussian_head=True)
TINY_METRIC = MetricDepthConfig(VitConfig(64, 1, 4, (0, 1, 2, 3), None), 32, (16, 16, 16, 16))
SIZE = 56
QUICK = Inference(ResizeConfig(SIZE))


class Knowing(DepthAnything):
    """A network that returns the true depth in a unit and axes of its own."""

    def __init__(self, depth: Tensor, raw: Tensor | None = None) -> None:
        super().__init__(TINY)
        self.depth, self.raw = depth, raw

    def forward(self, images: Tensor, poses: Poses | None = None) -> Prediction:
        factor = 7.0
        turn = axis_angle_to_matrix(torch.tensor([0.0, 0.6, 0.8]), 0.3)
        c2w = poses.c2w.clone()
        if self.raw is None:
            c2w[..., :3, :] = turn @ c2w[..., :3, :]
        c2w[..., :3, 3] *= factor
        unit = (poses.centers[0, 1] - poses.centers[0, 0]).norm()
        depth = factor * unit * self.depth[None]
        predicted = Poses(c2w, poses.K)
        return Prediction(depth, 1 + self.depth[None], predicted, self.raw)


def photographs(unit: float = 1.0, size: int = SIZE) -> list[View]:
    """Render two views of a room by rotated cameras, scaled to a scene unit."""
    cameras = [camera_at(x, yaw=yaw, size=size) for x, yaw in ((-0.3, 20), (0.1, -5))]
    views = [view_of(Room(), camera, i) for i, camera in enumerate(cameras)]
    return [scaled(view, unit) for view in views]


def scaled(view: View, unit: float) -> View:
    """Convert the view to a scene of another unit."""
    camera = view.camera
    c2w = camera.c2w.clone()
    c2w[:3, 3] *= unit
    near, far = camera.near * unit, camera.far * unit
    return replace(
        view, camera=replace(camera, c2w=c2w, near=near, far=far), depth=unit * view.depth
    )


def knowing(views: list[View]) -> Knowing:
    """Create the true network, with lengths in baselines."""
    baseline = (views[1].camera.center - views[0].camera.center).norm().clamp_min(1e-9)
    return Knowing(torch.stack([view.depth for view in views]) / baseline)


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_depths_are_brought_to_the_unit_of_the_cameras(unit):
    views = photographs(unit)
    for found, view in zip(AnyViewDepth(knowing(views), QUICK)(views), views, strict=True):
        assert found.valid.all()
        assert relative_error(found.depth, view.depth) < 1e-4
        assert 0 < found.confidence.min() < found.confidence.max() < 1


def test_gaussians_of_true_depth_draw_the_photographs():
    views = photographs()
    psi = FromDepth(model=AnyViewDepth(knowing(views), QUICK))
    found = psi(views)
    assert len(found.gaussians) == 2 * SIZE * SIZE
    for view in views:
        image = psi.renderer.render(found.gaussians, view.camera).image
        error = (image - view.image).square().mean()
        assert error < 0.1 * view.image.var()
    _, z = project(found.gaussians.means, views[0].camera)
    own = found.view_index == 0
    assert relative_error(z[own], views[0].depth.flatten()) < 1e-4
    assert torch.equal(found.pixel_index[own], torch.arange(SIZE * SIZE))


def test_three_views_keep_each_surface_once():
    cameras = [camera_at(x, size=SIZE) for x in (-0.2, 0.0, 0.2)]
    views = [view_of(Room(), camera, i) for i, camera in enumerate(cameras)]
    found = FromDepth(model=AnyViewDepth(knowing(views), QUICK))(views)
    assert SIZE * SIZE < len(found.gaussians) < 2 * SIZE * SIZE


def test_only_wanted_gaussians_are_lifted():
    views = photographs()
    psi = FromDepth(model=AnyViewDepth(knowing(views), QUICK))
    wanted = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    wanted[10:20, 5:9] = True
    found = psi.lift(views, wanted)
    assert torch.equal(found.pixel_index, wanted.flatten().nonzero()[:, 0])
    points = unproject(views[0].depth, views[0].camera)[wanted]
    assert relative_error(found.gaussians.means, points) < 1e-4


def test_gaussians_of_the_head_stand_where_the_given_cameras_see_them():
    """The depth of this network is the length of the ray, as the head expects it."""
    views = photographs(unit=50.0)
    network = knowing(views)
    lengths = torch.stack([v.camera.z_rays().norm(dim=-1) for v in views])
    network.depth = network.depth * lengths
    network.raw = torch.zeros(1, 2, SIZE, SIZE, 38)
    found = AnyViewGaussians(network, QUICK)(views)
    points = torch.cat([unproject(v.depth, v.camera).reshape(-1, 3) for v in views])
    assert relative_error(found.gaussians.means, points) < 1e-4
    for known, view in zip(found.depths, views, strict=True):
        assert relative_error(known.depth, view.depth) < 1e-4
        assert known.valid.all()
    assert torch.equal(found.pixel_index, torch.arange(SIZE * SIZE).repeat(2))
    pixel = points.sub(views[0].camera.center).norm(dim=-1) / views[0].camera.K[0, 0]
    ratio = found.gaussians.scales[: SIZE * SIZE, 0] / pixel[: SIZE * SIZE]
    assert torch.allclose(ratio, torch.tensor(3.0), rtol=1e-3)  # 15 tenths, both ways


class KnowingMetric(MetricDepthAnything):
    """A metric network that returns the true depth, and sky in the first rows."""

    def __init__(self, metres: Tensor, focal: float) -> None:
        super().__init__(TINY_METRIC)
        self.metres = metres * 300 / focal

    def forward(self, images: Tensor) -> MetricDepth:
        sky = torch.zeros_like(self.metres)
        sky[:, :4] = 1
        return MetricDepth(self.metres[None], sky[None])


def test_metres_are_brought_to_the_unit_that_shared_features_tell():
    size = 168
    views = photographs(unit=3.7, size=size)
    metres = torch.stack([view.depth for view in views]) / 3.7
    network = KnowingMetric(metres, float(views[0].camera.K[0, 0]))
    for found, view in zip(
        MetricViewDepth(network, Inference(ResizeConfig(size)))(views), views, strict=True
    ):
        ratio = found.depth[4:] / view.depth[4:]
        assert torch.allclose(ratio, torch.ones(()), rtol=0.05)
        assert not found.valid[:4].any()
        assert found.valid[4:].all()
        assert (found.depth[:4] > view.depth[4:].quantile(0.95)).all()


def test_photographs_without_features_tell_no_metre():
    views = [replace(view, image=torch.full_like(view.image, 0.5)) for view in photographs()]
    network = KnowingMetric(torch.stack([view.depth for view in views]), 50.0)
    with pytest.raises(InputError, match="share 0 features .* needs 12"):
        MetricViewDepth(network, QUICK)(views)


def test_maps_of_a_resized_window_are_read_where_their_pixels_lie():
    """The inverse depth of a plane is linear in the pixel, so that nothing is lost."""
    camera = replace(camera_at(size=60), height=40)
    window = Window(top=3, left=5, height=70, width=80, scale_x=1.5, scale_y=2.0)

    def plane(x: Tensor, y: Tensor) -> Tensor:
        return 1 / (0.2 + 0.001 * x + 0.003 * y)

    x, y = torch.arange(80) + 0.5 + 5, torch.arange(70) + 0.5 + 3
    depth = plane(x / 1.5, y[:, None] / 2.0)
    found = window.resample_depth_map(depth, torch.full_like(depth, 0.8), camera)
    assert found.depth.shape == (40, 60)
    u, v = torch.arange(60) + 0.5, torch.arange(40) + 0.5
    inside = (u * 1.5 >= 5) & (u * 1.5 <= 85) & (v[:, None] * 2 >= 3) & (v[:, None] * 2 <= 73)
    assert torch.equal(found.valid, inside)
    well = inside & (u * 1.5 > 6) & (u * 1.5 < 84) & (v[:, None] * 2 > 4) & (v[:, None] * 2 < 72)
    assert relative_error(found.depth[well], plane(u, v[:, None])[well]) < 1e-5
    assert (found.confidence[~inside] == 0).all()


def test_depth_of_the_sky_does_not_reach_the_surface_before_it():
    """A network sees no surface in the sky, and its depth there is any number."""
    camera = camera_at(0.0, size=32)
    window = Window(top=0, left=0, height=16, width=16, scale_x=0.5, scale_y=0.5)
    depth = torch.full((16, 16), 5.0)
    depth[:6] = 0.01
    found = window.resample_depth_map(depth, (depth == 5).float(), camera)
    assert found.valid[12:].all()
    assert not found.valid[:12].any()
    assert torch.allclose(found.depth[12:], torch.tensor(5.0))


def test_depth_of_0_beside_a_surface_does_not_reach_it():
    camera = camera_at(0.0, size=32)
    window = Window(top=0, left=0, height=32, width=32, scale_x=1.0, scale_y=1.0)
    depth = torch.full((32, 32), 5.0)
    depth[:, 16:] = 0.0
    found = window.resample_depth_map(depth, (depth == 5).float(), camera)
    assert found.valid[:, :16].all()
    assert torch.allclose(found.depth[:, :16], torch.tensor(5.0))


def test_each_pixel_of_the_window_belongs_to_the_pixel_it_lies_in():
    views = photographs(size=40)
    (image,) = create_any_view_batch(views[:1], ResizeConfig(56), 1).windows
    numbers = image.compute_pixel_indices(views[0].camera).view(56, 56)
    assert numbers[0, 0] == 0
    assert numbers[55, 55] == 40 * 40 - 1
    assert numbers[28, 14] == 20 * 40 + 10


@cache
def random(config: DepthAnythingConfig | MetricDepthConfig | NestedConfig):
    torch.manual_seed(0)
    return create_depth_anything(config).eval().requires_grad_(False)


def psi_of(config: DepthAnythingConfig | NestedConfig) -> FromDepth | AnyViewGaussians:
    if isinstance(config, DepthAnythingConfig) and not config.has_gaussian_head:
        return FromDepth(model=AnyViewDepth(random(config), QUICK))
    return AnyViewGaussians(random(config), QUICK)


@pytest.mark.parametrize(
    "config",
    [TINY, TINY_GAUSSIANS, NestedConfig(TINY_GAUSSIANS, TINY_METRIC)],
    ids=["depth", "gaussians", "nested"],
)
def test_smoke_a_completion_runs_with_random_weights(config):
    """Random weights: this only checks that all stages accept the output."""
    views = [view_of(Room(), camera_at(x, size=48), i) for i, x in enumerate((-0.3, 0.1))]
    anywhere = CompleterConfig(holes=HoleConfig(min_covered=0.0))
    completion = GSCompleter(psi_of(config), config=anywhere)(
        views, camera_at(0.7, yaw=12, size=48)
    )
    (result,) = completion.targets
    assert result.reference is not None
    assert completion.scene.means.isfinite().all()
    assert torch.equal(completion.scene.means[: len(completion.context)], completion.context.means)


def test_the_same_views_give_the_same_bytes():
    views = photographs()
    first, second = (psi_of(TINY)(views).gaussians for _ in range(2))
    assert torch.equal(first.means, second.means)
    assert torch.equal(first.opacities, second.opacities)


@pytest.mark.parametrize("config", [TINY_GAUSSIANS, TINY_METRIC], ids=["gaussians", "metric"])
def test_heads_and_geometry_stay_exact_where_the_transformer_runs_in_lower_precision(config):
    """On a CPU, where this can be tried."""
    batch = create_any_view_batch(photographs(), QUICK.sizing, 2)
    poses = normalize_poses(batch.poses, compute_scene_units(batch.poses.centers))
    given = (batch.images,) if config is TINY_METRIC else (batch.images, poses)
    found = []
    for lower in (False, True):
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=lower):
            found.append(random(config)(*given))
    for name in ("depth", "sky" if config is TINY_METRIC else "raw"):
        exact, lower = (getattr(each, name) for each in found)
        assert lower.dtype == torch.float32
        assert not torch.equal(lower, exact)
        assert relative_error(lower, exact) < 0.1


def test_each_kind_of_network_becomes_its_own_reconstructor():
    assert isinstance(wrap_network(random(TINY)).model, AnyViewDepth)
    assert isinstance(wrap_network(random(TINY_METRIC)).model, MetricViewDepth)
    assert isinstance(wrap_network(random(TINY_GAUSSIANS)), AnyViewGaussians)
    nested = random(NestedConfig(TINY_GAUSSIANS, TINY_METRIC))
    assert isinstance(nested, NestedDepthAnything)
    assert isinstance(wrap_network(nested), AnyViewGaussians)


def test_wrong_views_and_precisions_are_refused_with_a_sentence():
    with pytest.raises(InputError, match="1 view was given, and the model matches at least 2"):
        AnyViewDepth(random(TINY), QUICK)(photographs()[:1])
    with pytest.raises(InputError, match="cpu and torch.bfloat16 needs a GPU"):
        wrap_network(random(TINY), torch.bfloat16)


def test_a_file_as_published_fills_the_network(tmp_path, monkeypatch):
    safetensors = pytest.importorskip("safetensors.torch", reason="needs gscompleter[models]")
    monkeypatch.setattr(depth_anything, "VARIANTS", {"da3-base": TINY})
    path = tmp_path / "model.safetensors"
    state = {f"model.{name}": value for name, value in random(TINY).state_dict().items()}
    safetensors.save_file(state, path)
    loaded = load_reconstructor("da3-base", path)
    for name, value in loaded.model.network.state_dict().items():
        assert torch.equal(value, state[f"model.{name}"])
