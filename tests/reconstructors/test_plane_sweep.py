"""Ψ without weights: depth is right where views overlap, in any unit, for any number of views."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from skimage.data import stereo_motorcycle

from gscompleter import InputError, View
from gscompleter.data.demo_scene import (
    BASELINE_M,
    FOCAL_PX,
    PRINCIPAL_POINT_DX_PX,
    get_motorcycle_cameras,
)
from gscompleter.numerics.geometry import project
from gscompleter.reconstructors.features.depth_range import estimate_depth_range, get_depth_range
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from gscompleter.reconstructors.plane_sweep.gaussians import (
    DISC_SIGMA,
    MAX_DISC_STRETCH,
    MAX_PLANE_STRETCH,
    compute_normals,
    make_discs,
)
from gscompleter.render.loading import load_renderer
from gscompleter.types import DepthMap
from scenes import Room, camera_at, view_of

SIZE = 96


def room_views(*cameras, unit: float = 1.0) -> list[View]:
    return [view_of(Room(unit=unit), camera) for camera in cameras]


def side_by_side(unit: float = 1.0) -> list[View]:
    return room_views(*(camera_at(x, size=SIZE, unit=unit) for x in (-0.2, 0.2)), unit=unit)


def share_within(depth: torch.Tensor, truth: torch.Tensor, tolerance: float, where=None) -> float:
    error = (depth - truth).abs() / truth
    return (error[where] if where is not None else error).lt(tolerance).float().mean().item()


def test_depth_of_a_room_is_found():
    views = side_by_side()
    for view, found in zip(views, PlaneSweep()(views).depths, strict=True):
        assert share_within(found.depth, view.depth, 0.05) > 0.8
        assert share_within(found.depth, view.depth, 0.03, found.valid) > 0.85
        assert found.valid.float().mean() > 0.6


def test_every_pixel_has_one_gaussian_that_projects_to_its_centre():
    views = side_by_side()
    found = PlaneSweep()(views)
    for index, view in enumerate(views):
        own = found.view_index == index
        assert torch.equal(found.pixel_index[own].sort().values, torch.arange(SIZE * SIZE))
        pixels, _ = project(found.gaussians.means[own], view.camera)
        expected_x = found.pixel_index[own] % SIZE + 0.5
        expected_y = found.pixel_index[own] // SIZE + 0.5
        assert (pixels[:, 0] - expected_x).abs().max() < 0.01
        assert (pixels[:, 1] - expected_y).abs().max() < 0.01


def test_gaussians_are_as_large_as_asked_for_in_pixels():
    view = side_by_side()[0]
    depth = DepthMap(view.depth, torch.ones_like(view.depth, dtype=torch.bool))
    small, large = (PlaneSweep(disc_sigma=s).splat(view, depth) for s in (0.5, 1.0))
    assert torch.allclose(large.scales, 2 * small.scales)
    pixel = view.depth.flatten() / view.camera.K[0, 0]
    assert torch.allclose(large.scales[:, 0], pixel)


@pytest.mark.parametrize(
    ("stretch", "is_whole"), [(MAX_DISC_STRETCH, False), (MAX_PLANE_STRETCH, True)]
)
def test_a_road_is_whole_from_nearer_by(stretch, is_whole):
    """Its rows stand 8 to 24 times as far apart as its pixels are wide, 13 to 40 units away."""
    camera = camera_at(size=96)
    rows = torch.arange(96)[:, None] + 0.5
    height = 1.65
    road = (rows > 51.0).expand(96, 96)
    depth = torch.where(road, height * camera.K[1, 1] / (rows - camera.K[1, 2]), 60.0)
    view = View(torch.full((96, 96, 3), 0.5), camera)
    normals = compute_normals(depth, view)
    discs = make_discs(view, depth, normals, DISC_SIGMA, stretch)[road.flatten()]
    # From a car 10 units on, the rows there are below its bonnet.
    nearer = load_renderer("cpu").render(discs, camera_at(z=10.0, size=96)).alpha
    assert (nearer[57:80, 30:66].min() > 0.8) == is_whole


def test_long_discs_are_for_planes_alone():
    camera = camera_at(size=96)
    rows = torch.arange(96)[:, None] + 0.5
    depth = torch.where(rows > 51.0, 1.65 * camera.K[1, 1] / (rows - camera.K[1, 2]), 60.0)
    noise = 1 + 0.3 * torch.rand(96, 96, generator=torch.Generator().manual_seed(0))
    view = View(torch.full((96, 96, 3), 0.5), camera)
    lengths = []
    for rough in (torch.ones_like(noise), noise):
        surface = depth * rough
        discs = make_discs(
            view, surface, compute_normals(surface, view), DISC_SIGMA, MAX_PLANE_STRETCH
        )
        stretch = discs.scales[:, 1] / discs.scales[:, 0]
        lengths.append(stretch.unflatten(0, (96, 96))[54:60, 4:-4].amax().item())
    assert lengths[0] == pytest.approx(MAX_PLANE_STRETCH, rel=0.01)
    assert lengths[1] < 1.001 * MAX_DISC_STRETCH


def test_moving_forward_gives_depth_too():
    views = room_views(camera_at(0.1, z=-0.5, size=SIZE), camera_at(0.0, z=0.1, size=SIZE))
    found = PlaneSweep()(views)
    assert share_within(found.depths[0].depth, views[0].depth, 0.1, found.depths[0].valid) > 0.7


def test_more_views_do_not_make_it_worse():
    two = side_by_side()
    three = [*two, *room_views(camera_at(0.0, 0.25, size=SIZE))]
    truth = two[0].depth
    share_of_two = share_within(PlaneSweep()(two).depths[0].depth, truth, 0.05)
    assert share_within(PlaneSweep()(three).depths[0].depth, truth, 0.05) > share_of_two - 0.03


def test_views_of_different_sizes_are_matched():
    small = room_views(camera_at(0.2, size=SIZE // 2))
    found = PlaneSweep()([side_by_side()[0], *small])
    assert found.depths[1].depth.shape == (SIZE // 2, SIZE // 2)
    assert share_within(found.depths[0].depth, side_by_side()[0].depth, 0.08) > 0.7


def test_another_exposure_leaves_the_depth():
    left, right = side_by_side()
    darker = replace(right, image=0.7 * right.image)
    found = PlaneSweep()([left, darker])
    assert share_within(found.depths[0].depth, left.depth, 0.05) > 0.8


@pytest.mark.parametrize("unit", [pytest.param(0.001, marks=pytest.mark.slow), 1000.0])
def test_the_unit_of_the_scene_scales_means_and_sizes(unit):
    ours, theirs = PlaneSweep()(side_by_side()), PlaneSweep()(side_by_side(unit))
    # A winner-takes-all decision may flip by rounding; one pixel in a thousand may move, and the
    # appearance of what stands before or behind it.
    for name in ("means", "scales"):
        a, b = getattr(theirs.gaussians, name) / unit, getattr(ours.gaussians, name)
        assert ((a - b).abs() > 1e-3 * b.abs().max()).float().mean() < 1e-3, name
    for name in ("sh", "opacities"):
        a, b = getattr(theirs.gaussians, name), getattr(ours.gaussians, name)
        assert (a - b).abs().gt(0.1).float().mean() < 1e-2, name


def test_the_same_views_give_the_same_bytes():
    a, b = PlaneSweep()(side_by_side()), PlaneSweep()(side_by_side())
    assert torch.equal(a.gaussians.means, b.gaussians.means)
    assert torch.equal(a.gaussians.scales, b.gaussians.scales)


@pytest.mark.parametrize("unit", [0.001, 1.0, 1000.0])
def test_the_estimated_range_encloses_what_the_views_see(unit):
    views = side_by_side(unit)
    near, far = estimate_depth_range(views)
    for view in views:
        assert near < view.depth.quantile(0.02)
        assert far > view.depth.quantile(0.98)
    assert near > 0.05 * unit
    assert far < 500 * unit


def test_along_a_path_the_range_is_told_by_those_that_see_the_same():
    hall = Room((((-3.0, -1.5, -1.0), (20.0, 1.5, 5.0)),))
    views = [view_of(hall, camera_at(x=2.0 * i, size=160)) for i in range(8)]
    views = [replace(v, camera=replace(v.camera, near=None, far=None)) for v in views]
    near, far = estimate_depth_range(views)
    assert 0.5 < near < min(view.depth.min() for view in views)
    assert 5.0 < far < 100


def test_without_texture_the_baseline_sets_the_range():
    flat = [replace(v, image=torch.full_like(v.image, 0.5)) for v in side_by_side()]
    near, far = estimate_depth_range(flat)
    assert 0 < near < far
    beyond = replace(flat[1], camera=camera_at(x=50.0))
    assert estimate_depth_range([*flat, beyond]) == pytest.approx((near, far), rel=1e-3)


def test_what_the_camera_knows_of_the_range_is_taken_and_the_rest_estimated():
    views = side_by_side()

    def known(near: float | None, far: float | None) -> list[View]:
        return [replace(v, camera=replace(v.camera, near=near, far=far)) for v in views]

    low, high = estimate_depth_range(views)
    assert get_depth_range(known(0.25, None)) == (0.25, high)
    assert get_depth_range(known(None, 90.0)) == (low, 90.0)
    assert get_depth_range(known(None, 90.0), lambda _: (0.125, 3.0)) == (0.125, 90.0)
    with pytest.raises(InputError, match="near must be positive and less than far"):
        get_depth_range(known(None, 90.0), lambda _: (99.0, 100.0))
    # Any of the cameras may know it, and all of what they know lies in it.
    first, *others = known(None, None)
    assert get_depth_range([first, *known(0.25, 90.0)[1:]]) == (0.25, 90.0)
    assert get_depth_range([*known(0.5, 90.0)[:1], *known(0.25, 80.0)[1:]]) == (0.25, 90.0)
    assert get_depth_range([first, *others]) == (low, high)


def test_too_few_views_no_baseline_and_an_empty_range_are_refused():
    left, right = side_by_side()
    with pytest.raises(InputError, match="at least two views"):
        PlaneSweep()([left])
    with pytest.raises(InputError, match="in one place"):
        PlaneSweep()([left, left])
    empty = [replace(v, camera=replace(v.camera, near=1e9, far=None)) for v in (left, right)]
    with pytest.raises(InputError, match="near must be positive and less than far"):
        PlaneSweep()(empty)


def test_the_motorcycle_at_a_quarter_of_its_size():
    """Real photographs with true disparity, which scikit-image carries."""
    left, right, disparity = stereo_motorcycle()
    images = [torch.from_numpy(i / 255).float()[::4, ::4] for i in (left, right)]
    height, width = images[0].shape[:2]
    scale = torch.tensor([[0.25], [0.25], [1.0]])
    cameras = [
        replace(c, K=c.K * scale, width=width, height=height, near=1.5, far=8.0)
        for c in get_motorcycle_cameras(741, 500)
    ]
    views = [View(i, c) for i, c in zip(images, cameras, strict=True)]
    found = PlaneSweep().estimate_depths(views)[0]
    disparity = disparity[::4, ::4]
    known = torch.from_numpy(np.isfinite(disparity))
    truth = torch.from_numpy(FOCAL_PX * BASELINE_M / (disparity + PRINCIPAL_POINT_DX_PX)).float()
    assert share_within(found.depth, truth, 0.05, known) > 0.8
    unsure = share_within(found.depth, truth, 0.05, known & (found.confidence == 0))
    halfway = (found.confidence > 0) & (found.confidence < 0.9)
    between = share_within(found.depth, truth, 0.05, known & halfway)
    sure = share_within(found.depth, truth, 0.05, known & (found.confidence >= 0.9))
    assert unsure < between < sure
    assert sure > 0.9


def test_depth_of_a_real_room(shared):
    from gscompleter import load_views

    views = load_views(shared / "data" / "open3d_rgbd", [0, 2], (256, 256), near=0.5, far=10.0)
    found = PlaneSweep()(views).depths[0].depth
    known = views[0].depth > 0
    assert share_within(found[known], views[0].depth[known], 0.05) > 0.7


def test_a_lift_agrees_with_a_reconstruction_of_the_same_pair():
    """Both measure at the full size, where half of it would be enough to match at all."""
    views = [view_of(Room(), camera_at(x, size=200)) for x in (-0.1, 0.1)]
    everywhere = torch.ones(200, 200, dtype=torch.bool)
    lifted, reconstructed = (
        depths[0]
        for depths in (PlaneSweep().lift(views, everywhere).depths, PlaneSweep()(views).depths)
    )
    both = (lifted.confidence > 0) & (reconstructed.confidence > 0)
    assert both.float().mean() > 0.5
    error = (lifted.depth / reconstructed.depth - 1).abs()[both]
    assert (error < 0.005).float().mean() > 0.9
