"""The frame of an input splat: as given, as normalised by a trainer, or found by the images."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gscompleter.data.formats import open_photographs
from gscompleter.render.loading import load_renderer
from gscompleter.splats.alignment.estimate import AlignmentData, align_splat, estimate_alignment
from gscompleter.splats.alignment.fit import score_splat
from gscompleter.splats.alignment.similarity import (
    fit_pose_similarity,
    get_camera_pose,
    get_scale,
    make_similarity,
    transform_camera,
    transform_pose,
    transform_view,
)
from gscompleter.splats.alignment.trainer_frames import (
    InputSplat,
    compute_trainer_frames,
    normalize_gsplat_cameras,
    normalize_nerfstudio,
    normalize_opensplat,
)
from gscompleter.splats.ply import load_ply
from gscompleter.splats.transform import transform_gaussians
from gscompleter.types import merge
from scenes import Room, camera_at, gaussians_of, random_gaussians, view_of

RENDERER = load_renderer("cpu")
PLACES = ((-0.6, 0.0, 0.0, 6.0), (0.0, -0.3, 0.2, 0.0), (0.6, 0.1, 0.0, -6.0), (0.2, 0.3, 0.4, 0))
ARBITRARY = make_similarity(
    0.3, Rotation.from_rotvec([0.9, -1.7, 0.4]).as_matrix(), np.array([5.0, 3.0, -2.0])
)


@pytest.fixture(scope="module")
def views():
    """Photographs of a room, large enough for features."""
    cameras = [camera_at(x, y, z, yaw, size=192) for x, y, z, yaw in PLACES]
    return [view_of(Room(), camera, i) for i, camera in enumerate(cameras)]


@pytest.fixture(scope="module")
def splat(views):
    """Return the room as two of the photographs show it."""
    return merge([gaussians_of(view) for view in (views[0], views[2])])


def poses_of(views):
    return np.stack([get_camera_pose(view.camera) for view in views])


def points_of(splat):
    return splat.means[::50].double().numpy()


def find(views, splat, transform=None, **more):
    if transform is not None:
        splat = transform_gaussians(splat, torch.from_numpy(transform).float())
    return estimate_alignment(AlignmentData(splat, views, RENDERER), poses_of(views), **more)


def assert_takes_to(found, truth, tolerance):
    """Compare two transforms of the photographs' frame, to `tolerance` of the scene's unit."""
    assert np.abs(np.linalg.inv(truth) @ found - np.eye(4)).max() < tolerance


def test_a_splat_in_the_frame_of_its_photographs_stays_as_given(views, splat):
    found = find(views, splat)
    assert found.method == "given"
    assert np.array_equal(found.transform, np.eye(4))


@pytest.mark.parametrize(
    "trainer",
    [
        normalize_gsplat_cameras,
        pytest.param(normalize_opensplat, marks=pytest.mark.slow),
        pytest.param(lambda poses: normalize_nerfstudio(poses, np.eye(3)), marks=pytest.mark.slow),
    ],
)
def test_what_trainers_do_is_computed_from_the_cameras(views, splat, trainer):
    truth = trainer(poses_of(views))
    found = find(views, splat, truth)
    assert found.method == "normalised"
    assert np.allclose(found.transform, truth)


def test_principal_axes_of_the_points_are_found_whatever_their_signs(views, splat):
    poses, points = poses_of(views), points_of(splat)
    *_, truth = compute_trainer_frames(poses, points)
    found = find(views, splat, truth, points=points)
    assert found.method == "normalised"
    assert_takes_to(found.transform, truth, 1e-6)


def test_the_file_that_nerfstudio_leaves_is_taken(views, splat):
    found = find(views, splat, ARBITRARY, trainer_frames=[("dataparser", ARBITRARY)])
    assert found.method == "dataparser"
    assert np.array_equal(found.transform, ARBITRARY)


def test_a_moderate_mismatch_is_noticed_and_mended(views, splat):
    larger = np.diag([1.2, 1.2, 1.2, 1.0])
    found = find(views, splat, larger)
    assert found.method == "similarity"
    assert found.fit.psnr > found.given_fit.psnr + 2
    assert_takes_to(found.transform, larger, 0.03)


@pytest.mark.slow
def test_any_similarity_is_found_by_the_images(views, splat):
    found = find(views, splat, ARBITRARY, points=points_of(splat))
    assert found.method == "similarity"
    assert_takes_to(found.transform, ARBITRARY, 0.03)


@pytest.mark.slow
def test_a_splat_of_another_scene_matches_nowhere(views):
    assert not find(views, random_gaussians(300)).fit.is_match


@pytest.mark.filterwarnings("error")
def test_a_splat_that_is_one_point_matches_nowhere(views):
    scene = random_gaussians(300)
    assert not find(views, replace(scene, means=torch.zeros_like(scene.means))).fit.is_match


def test_a_photograph_in_another_exposure_fits_as_well(views, splat):
    darker = [replace(view, image=0.7 * view.image + 0.1) for view in views]
    plain, even = (score_splat(splat, some, RENDERER) for some in (views, darker))
    assert plain.is_match
    assert even.margin == pytest.approx(plain.margin, abs=0.2)


def test_depth_planes_of_photographs_say_nothing_of_a_splat_in_another_unit(views, splat):
    enlarge = torch.from_numpy(make_similarity(1000.0, np.eye(3), np.zeros(3))).float()
    large = transform_gaussians(splat, enlarge)
    bare = [replace(view, camera=replace(view.camera, near=None, far=None)) for view in views]
    assert views[0].camera.far is not None
    assert score_splat(large, views, RENDERER) == score_splat(large, bare, RENDERER)


def test_opensplat_centres_the_cameras_within_one():
    poses = np.stack([make_similarity(1.0, np.eye(3), np.array([x, 4.0, 0.0])) for x in (1.0, 3.0)])
    expected = [[1, 0, 0, -2], [0, 1, 0, -4], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert np.allclose(normalize_opensplat(poses), expected)


def test_nerfstudio_turns_up_to_z(views):
    transform = normalize_nerfstudio(poses_of(views), np.eye(3))
    up = transform[:3, :3] @ [0.0, -1.0, 0.0]
    assert np.allclose(up / get_scale(transform), [0, 0, 1])


def test_one_wrong_pose_among_four_moves_a_similarity_by_nothing(views):
    before = poses_of(views)
    after = np.stack([transform_pose(pose, ARBITRARY) for pose in before])
    assert_takes_to(fit_pose_similarity(list(before), list(after)), ARBITRARY, 1e-6)
    after[3] = transform_pose(after[3], make_similarity(1.0, np.diag([1.0, -1, -1]), np.ones(3)))
    assert_takes_to(fit_pose_similarity(list(before), list(after)), ARBITRARY, 1e-6)


def test_a_moved_camera_sees_the_moved_splat_as_before(views, splat):
    scene = transform_gaussians(splat, torch.from_numpy(ARBITRARY).float())
    before = RENDERER.render(splat, views[0].camera)
    after = RENDERER.render(scene, transform_camera(views[0].camera, ARBITRARY))
    assert (before.image - after.image).abs().mean() < 1e-2  # equal depths change order
    assert torch.allclose(before.depth * 0.3, after.depth, rtol=1e-2, atol=1e-2)
    view = transform_view(views[0], ARBITRARY)
    assert view.camera.near == pytest.approx(0.3 * views[0].camera.near)
    assert torch.equal(view.depth, views[0].depth * get_scale(ARBITRARY))


def test_the_identity_changes_no_bit(views):
    assert transform_view(views[0], np.eye(4)) is views[0]


@pytest.mark.parametrize("name", ["splat.ply", "splat_normalised.ply"])
def test_a_real_splat_is_found_in_both_of_its_frames(shared, name):
    fox = shared / "splats" / "fox"
    if not fox.is_dir():
        pytest.skip(f"needs the splat of another trainer, and there is no folder {fox}")
    splat = InputSplat(fox / name, load_ply(fox / name), np.zeros(3), fox)
    found = align_splat(splat, open_photographs(fox), (0, 3), RENDERER)
    truth = np.eye(4)
    if name != "splat.ply":
        truth = np.array(json.loads((fox / "colmap_to_normalised.json").read_text())["matrix"])
    assert found.fit.psnr > 35
    assert np.abs(found.transform - truth).max() < 1e-5
    assert found.method == ("given" if name == "splat.ply" else "cameras")
