"""The steps of plane-sweep stereo after the sweep, each on geometry that is known."""

from dataclasses import replace

import cv2
import numba
import numpy as np
import pytest
import torch

from gscompleter.evaluation.metrics.image import psnr
from gscompleter.numerics.kernels import stereo, tgv
from gscompleter.numerics.kernels.parallel import run_calls
from gscompleter.reconstructors.features.matches import detect_features, match_features
from gscompleter.reconstructors.features.stereo_image import (
    StereoImage,
    compute_source_from_reference,
    make_stereo_images,
)
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from gscompleter.reconstructors.plane_sweep.fit import OPACITY_STEPS, fit_opacities
from gscompleter.reconstructors.plane_sweep.rig import compute_epipolar_distances, rotate_to_matches
from gscompleter.reconstructors.plane_sweep.surfaces import fit_surfaces
from gscompleter.reconstructors.plane_sweep.sweep import (
    compute_confidence,
    find_hidden_pixels,
    remove_speckles,
)
from gscompleter.render.cpu import CpuFrozenScene
from gscompleter.render.loading import load_renderer
from gscompleter.types import View, merge
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 128


def pair(baseline: float = 0.4) -> list[View]:
    return [view_of(Room(), camera_at(x, size=SIZE)) for x in (-baseline / 2, baseline / 2)]


def pitched(view: View, degrees: float) -> View:
    """Return the photograph with a pose rotated about the camera's horizontal axis."""
    angle = np.deg2rad(degrees)
    turn = torch.eye(4)
    turn[1, 1] = turn[2, 2] = float(np.cos(angle))
    turn[1, 2], turn[2, 1] = -float(np.sin(angle)), float(np.sin(angle))
    return replace(view, camera=replace(view.camera, c2w=view.camera.c2w @ turn))


def median_error(views: list[View]) -> float:
    found, truth = PlaneSweep().estimate_depths(views)[0].depth, views[0].depth
    return ((found - truth).abs() / truth).median().item()


# Poses


def matched_pair(views: list[View]) -> tuple[StereoImage, StereoImage, np.ndarray, np.ndarray]:
    (left, right), _ = make_stereo_images(views)
    return left, right, *match_features(detect_features(left), detect_features(right))


def test_a_pose_that_misses_its_epipolar_lines_is_turned_back():
    left, right = pair()
    reference, source, pixels, matched = matched_pair([left, pitched(right, 0.6)])
    before, _ = compute_epipolar_distances(reference, source, pixels, matched)
    turned = rotate_to_matches(reference, source, pixels, matched)
    after, _ = compute_epipolar_distances(reference, turned, pixels, matched)
    assert np.median(np.abs(before)) > 1
    assert np.median(np.abs(after)) < 0.15
    assert np.array_equal(turned.center, source.center)
    assert median_error([left, pitched(right, 0.6)]) < 2 * median_error([left, right])


def test_a_right_pose_stays():
    reference, source, pixels, matched = matched_pair(pair())
    turned = rotate_to_matches(reference, source, pixels, matched)
    assert np.abs(turned.rotation - source.rotation).max() < 1e-3


def test_false_matches_do_not_turn_the_camera():
    reference, source, pixels, matched = matched_pair(pair())
    false = matched.copy()
    false[::3] += [3.0, 5.0]
    turned = rotate_to_matches(reference, source, pixels, false)
    assert np.abs(turned.rotation - source.rotation).max() < 2e-3


def test_few_matches_leave_the_pose():
    reference, source, pixels, matched = matched_pair(pair())
    for few in (0, 5):
        assert rotate_to_matches(reference, source, pixels[:few], matched[:few]) is source


# Confidence and occlusion


def test_speckles_are_not_trusted_and_surfaces_are():
    index = np.full((40, 40), 20.0, np.float32)
    index[5:8, 5:8] = 60
    agrees = np.ones((40, 40), bool)
    agrees[:, 30:] = False
    agrees[20, 35] = True
    solid = remove_speckles(index, agrees)
    assert not solid[5:8, 5:8].any()
    assert not solid[:, 31:].any()
    assert solid[:, :29].sum() == 40 * 29 - 9


def test_confidence_grows_with_the_margin():
    index, agrees = np.full((10, 10), 3.0, np.float32), np.ones((10, 10), bool)
    margin = np.linspace(0, 80, 100, dtype=np.float32).reshape(10, 10)
    confidence = compute_confidence(index, margin, agrees)
    assert (np.diff(confidence.ravel()) >= 0).all()
    assert confidence.min() == 0
    assert confidence.max() == 1


def test_an_unknown_gap_takes_the_farther_side():
    values = np.full((40, 30), 5.0, np.float32)
    values[:, 20:] = 1.0
    known = np.ones((40, 30), bool)
    known[:, 12:20] = False
    filled = stereo.fill_background(values, known)
    assert (filled[10:30, 12:20] == 1).all()
    assert np.array_equal(filled[known], values[known])
    assert np.array_equal(stereo.fill_background(values, np.zeros_like(known)), values)


def test_what_only_one_view_sees_past_an_object_is_found_occluded():
    """The pillar in the room hides a strip of the back wall from the right camera."""
    views = pair()
    (left, right), unit = make_stereo_images(views)
    inverse = [(unit / view.depth).float().numpy() for view in views]
    right_from_left = compute_source_from_reference(left, right)
    left_from_right = compute_source_from_reference(right, left)
    visible, ratio = stereo.reproject(*inverse, right_from_left, left_from_right)
    rows, columns = np.nonzero(visible > 1.5)
    some = stereo.reproject_pixels(rows, columns, *inverse, right_from_left, left_from_right)
    assert len(rows) > 50
    assert np.array_equal(some, [visible[rows, columns], ratio[rows, columns]])
    hidden = find_hidden_pixels(inverse[0], [(inverse[1], right_from_left, left_from_right)])
    assert hidden.sum() > 50
    assert not hidden[(visible >= 0) & (visible < 1.5)].any()
    assert not hidden[visible < 0].any()


# Surfaces


def slanted(h: int = 48, w: int = 64) -> np.ndarray:
    rows, columns = np.mgrid[:h, :w]
    return (10 + 0.15 * columns - 0.1 * rows).astype(np.float32)


def blank(heights: np.ndarray) -> np.ndarray:
    return np.full((*heights.shape, 3), 0.5, np.float32)


def test_planes_go_on_where_nothing_was_measured():
    truth = slanted()
    known = np.zeros(truth.shape, np.float32)
    known[:, :40] = 1
    found = fit_surfaces(np.where(known > 0, truth, 99.0).astype(np.float32), known, blank(truth))
    assert np.abs(found - truth)[:, :40].max() < 0.2
    assert np.abs(found - truth)[:, 40:].max() < 0.5


def test_false_measurements_are_outvoted():
    truth, random = slanted(), np.random.default_rng(0)
    false = random.random(truth.shape) < 0.2
    measured = np.where(false, random.uniform(0, 40, truth.shape), truth).astype(np.float32)
    found = fit_surfaces(measured, np.ones_like(truth), blank(truth))
    assert np.abs(found - truth).mean() < 0.15


def test_steps_stand_at_the_edges_of_the_image():
    """The border of an object lies in a gap of the measurements, and the image shows where."""
    truth = np.where(np.arange(64) < 30, 20.0, 5.0)[None].repeat(48, 0).astype(np.float32)
    known = np.ones_like(truth)
    known[:, 24:40] = 0
    image = np.where(truth[..., None] > 10, 0.9, 0.2).astype(np.float32).repeat(3, -1)
    found = fit_surfaces(np.where(known > 0, truth, 0).astype(np.float32), known, image)
    assert (found[:, :29] > 17).all()
    assert (found[:, 31:] < 8).all()


def test_without_any_measurement_nothing_is_made_up():
    measured = slanted()
    found = fit_surfaces(measured, np.zeros_like(measured), blank(measured))
    assert np.array_equal(found, measured)


@pytest.mark.parametrize(
    "iterations", [1, tgv.ITERATIONS_PER_PASS, 2 * tgv.ITERATIONS_PER_PASS + 3]
)
@pytest.mark.parametrize("threads", [2, 3])
def test_bands_of_rows_fit_the_surfaces_of_one(monkeypatch, threads, iterations):
    """To the bit, also at the seams, and with as many bands as threads."""
    rows, random, found, parts = (
        threads * tgv.MIN_BAND_ROWS + 7,
        np.random.default_rng(0),
        [],
        [],
    )
    shape = rows, 24
    data, weight, across, down = (random.random(shape, np.float32) * k for k in (9, 1, 3, 3))
    given = data, weight, across, down, np.float32(12), np.float32(0.15), iterations

    def counted(kernel, calls, threads):
        parts.append(len(calls))
        return run_calls(kernel, calls, threads)

    monkeypatch.setattr(tgv, "run_calls", counted)
    for count in (1, threads):
        heights, gradients = np.zeros(shape, np.float32), np.zeros((2, *shape), np.float32)
        tgv.fit(heights, gradients, *given, threads=count)
        found.append(np.concatenate([heights[None], gradients]))
    assert np.array_equal(*found)
    assert np.abs(found[0]).max() > 0
    assert parts == [threads, threads - 1] * -(-iterations // tgv.ITERATIONS_PER_PASS)


def test_stereo_does_not_depend_on_the_number_of_threads(monkeypatch):
    views, depths = [view_of(Room(), camera_at(x)) for x in (-0.2, 0.2)], []
    for threads in (1, 3):
        monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
        depths.append(PlaneSweep().estimate_depths(views)[0].depth)
    assert torch.equal(*depths)


def test_a_blank_wall_is_completed_as_a_plane():
    """A window without any texture in the middle of the back wall."""
    views = []
    for view in pair():
        seen = view.camera.center + view.depth[..., None] * view.camera.z_rays()
        wall = (
            (seen[..., 2] > 4.9) & (seen[..., 0] + 1.2).abs().lt(0.7) & seen[..., 1].abs().lt(0.7)
        )
        views.append(replace(view, image=torch.where(wall[..., None], 0.5, view.image)))
    found, truth = PlaneSweep().estimate_depths(views)[0].depth, views[0].depth
    blank_wall = (views[0].image == 0.5).all(dim=-1)
    assert blank_wall.sum() > 200
    error = ((found - truth).abs() / truth)[blank_wall]
    assert error.quantile(0.9) < 0.08


# Appearance


def with_floater(views: list[View]) -> torch.Tensor:
    """Gaussians of the room at their true depth, and a grey sheet before the left camera."""
    scene = merge([gaussians_of(view) for view in views])
    rays = views[0].camera.z_rays()[40:60, 40:60]
    sheet = gaussians_of(views[0], torch.full((SIZE, SIZE), 1.0))
    sheet = sheet[torch.arange(SIZE * SIZE).reshape(SIZE, SIZE)[40:60, 40:60].flatten()]
    assert len(sheet) == rays[..., 0].numel()
    return merge([scene, replace(sheet, sh=torch.zeros_like(sheet.sh))])


def test_what_photographs_object_to_fades_and_the_rest_stays():
    views, renderer = pair(), load_renderer("cpu")
    scene = with_floater(views)
    fitted, _ = fit_opacities(scene, views, renderer)
    assert fitted.opacities[-400:].mean() < 0.5
    for view in views:
        assert renderer.render(fitted, view.camera).alpha.mean() > 0.97
        assert psnr(renderer.render(fitted, view.camera).image, view.image) > 24
    for name in ("means", "scales", "quats", "sh"):
        assert torch.equal(getattr(fitted, name), getattr(scene, name))


def test_a_step_on_the_opacities_draws_one_photograph(monkeypatch):
    views, centers = pair(), []
    plan = CpuFrozenScene.vary_opacities

    def counted(view, new):
        render = plan(view, new)
        return lambda opacities: (
            centers.append(view.viewpoint.pinhole.center[0]) or render(opacities)
        )

    monkeypatch.setattr(CpuFrozenScene, "vary_opacities", counted)
    fit_opacities(merge([gaussians_of(view) for view in views]), views, load_renderer("cpu"))
    assert len(centers) == OPACITY_STEPS
    assert centers[::2] == [views[0].camera.center[0]] * (OPACITY_STEPS // 2)
    assert centers[1::2] == [views[1].camera.center[0]] * (OPACITY_STEPS // 2)


@pytest.mark.parametrize("x", [0.35, pytest.param(-0.35, marks=pytest.mark.slow)])
def test_an_unseen_view_profits_too(x):
    views, renderer = pair(), load_renderer("cpu")
    unseen = view_of(Room(), camera_at(x, size=SIZE))
    sweep = PlaneSweep()
    plain = merge(
        [sweep.splat(v, d) for v, d in zip(views, sweep.estimate_depths(views), strict=True)]
    )
    fitted = sweep(views).gaussians
    covered = renderer.render(plain, unseen.camera).alpha > 0.9
    scores = [
        psnr(
            renderer.render(gaussians, unseen.camera).image[covered][None],
            unseen.image[covered][None],
        )
        for gaussians in (plain, fitted)
    ]
    assert scores[1] > scores[0] + 0.3


def test_no_pinholes_when_the_camera_moves_on_by_a_baseline():
    """Thin pixels are part of a hole at least three pixels wide."""
    moved = camera_at(0.6, size=SIZE)
    render = load_renderer("cpu").render(PlaneSweep()(pair()).gaussians, moved)
    thin = (render.alpha < 0.5).numpy().astype(np.uint8)
    holes = cv2.morphologyEx(thin, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    assert holes.mean() > 0.05
    assert (thin - holes).mean() < 0.005
