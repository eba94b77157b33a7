"""Matches that were kept back, and the photographs whose places they contradict."""

import math

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")

import pycolmap

from gscompleter.data.sfm.kept_matches import (
    KEPT_BACK,
    NumberedMatches,
    drop_wrong_places,
    keep_back_tracks,
    measure_model,
    rate_places,
)

SIDE = 256
FOCAL = 250.0
CENTRES = np.array([[0.0, 0, 0], [1, 0.1, 0], [2, -0.2, 0.1], [3, 0.3, 0], [4, 0, -0.2]])
"""Positions of five cameras that look along z."""


def make_model(centres: np.ndarray, distortion: float = 0.05) -> pycolmap.Reconstruction:
    """Make a model with cameras at these places, numbered from 1."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL",
        width=SIDE,
        height=SIDE,
        params=[FOCAL, SIDE / 2, SIDE / 2, distortion],
        camera_id=1,
    )
    model.add_camera_with_trivial_rig(camera)
    for number, centre in enumerate(centres, start=1):
        image = pycolmap.Image(name=f"{number}.png", camera_id=1, image_id=number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), -centre)
        model.add_image_with_trivial_frame(image, pose)
    return model


def observe(distortion: float = 0.05) -> tuple[dict[int, np.ndarray], NumberedMatches]:
    """Return the pixels of 60 points in cameras at `CENTRES`, and matches of all pairs."""
    generator = np.random.default_rng(0)
    points = generator.uniform([-1, -2, 6], [5, 2, 14], (60, 3))
    model = make_model(CENTRES, distortion)
    keypoints = {}
    for number, centre in enumerate(CENTRES, start=1):
        pixels = model.cameras[1].img_from_cam(points - centre)
        keypoints[number] = pixels + generator.normal(scale=0.3, size=pixels.shape)
    rows = np.repeat(np.arange(60)[:, None], 2, axis=1)
    numbers = list(keypoints)
    pairs = [(i, j) for i in numbers for j in numbers if i < j]
    return keypoints, dict.fromkeys(pairs, rows)


def test_right_places_are_confirmed():
    keypoints, kept = observe()
    model = make_model(CENTRES)
    checked = drop_wrong_places(model, kept, keypoints)
    assert checked.dropped == []
    assert checked.distance < 0.5
    assert model.num_reg_images() == 5


@pytest.mark.parametrize("wrong", [1, 3, 5])
def test_a_photograph_in_a_wrong_place_goes_and_the_others_stay(wrong):
    keypoints, kept = observe()
    centres = CENTRES.copy()
    centres[wrong - 1] += [0.2, 1.0, 0.5]
    model = make_model(centres)
    assert drop_wrong_places(model, kept, keypoints).dropped == [wrong]
    assert sorted(model.reg_image_ids()) == [n for n in range(1, 6) if n != wrong]


def test_a_feature_that_the_lens_cannot_show_costs_no_photograph():
    """A strong barrel distortion fitted to a wide lens folds before the corner of the image."""
    keypoints, kept = observe(distortion=-0.6)
    keypoints[3][0] = [0, 0]
    model = make_model(CENTRES, distortion=-0.6)
    assert np.isnan(model.cameras[1].cam_from_img(keypoints[3][:1])).all()
    assert np.isinf(measure_model(model, kept, keypoints)[1, 3][0])
    checked = drop_wrong_places(model, kept, keypoints)
    assert checked.dropped == []
    assert checked.distance < 0.5


def test_one_photograph_alone_does_not_confirm_a_place():
    # Along the line between both the epipolar lines are the same.
    keypoints, kept = observe()
    centres = CENTRES.copy()
    centres[4] = centres[3] + 3 * (CENTRES[4] - CENTRES[3])
    model = make_model(centres)
    distances = measure_model(model, {(4, 5): kept[4, 5]}, keypoints)
    assert np.median(distances[4, 5]) < 0.5
    assert rate_places(distances, [4, 5]) == {4: math.inf, 5: math.inf}
    assert drop_wrong_places(model, kept, keypoints).dropped == [5]


def test_a_model_that_nothing_confirms_is_empty_in_the_end():
    keypoints, _ = observe()
    checked = drop_wrong_places(make_model(CENTRES), {}, keypoints)
    assert sorted(checked.dropped) == [1, 2, 3, 4, 5]
    assert checked.distance == math.inf


def test_whole_tracks_are_kept_back(tmp_path):
    count = 500
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", FOCAL, SIDE, SIDE)
        camera.camera_id = database.write_camera(camera)
        numbers = []
        for name in ("a.png", "b.png", "c.png"):
            image = pycolmap.Image(name=name, camera_id=camera.camera_id)
            numbers.append(int(database.write_image(image)))
            pixels = np.random.default_rng(0).uniform(0, SIDE, (count, 2)).astype(np.float32)
            database.write_keypoints(numbers[-1], pixels)
        rows = np.repeat(np.arange(count, dtype=np.uint32)[:, None], 2, axis=1)
        for i, j in ((0, 1), (1, 2), (0, 2)):
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = rows
            database.write_two_view_geometry(numbers[i], numbers[j], geometry)
        kept = keep_back_tracks(database, numbers)
        left = database.read_two_view_geometry(numbers[0], numbers[1]).inlier_matches
    first, second, third = (set(one[:, 0].tolist()) for one in kept.values())
    assert first == second == third
    assert len(first) == pytest.approx(count / KEPT_BACK, rel=0.2)
    assert first.isdisjoint(left[:, 0].tolist())
    assert len(first) + len(left) == count
