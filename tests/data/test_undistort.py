"""Lens distortion: OpenCV's models, our pixel centres, and no empty pixel afterwards."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from gscompleter.data.cameras import (
    Distortion,
    Pinhole,
    compute_undistortion_map,
    distort,
    find_distortion_defect,
    undistort_pinhole,
)
from gscompleter.data.colmap import CAMERA_MODELS, build_intrinsics

PINHOLE = Pinhole(fl_x=130.0, fl_y=127.5, cx=81.5, cy=59.0, width=160, height=120)

LENSES = {
    "phone": Distortion(radial=(0.058, -0.08), tangential=(-0.001, 0.0002)),
    "barrel": Distortion(radial=(-0.3, 0.1, -0.01), tangential=(0.001, 0.002)),
    "pincushion": Distortion(radial=(0.3,)),
    "rational": Distortion(radial=(0.3, -0.1, 0.03), denominator=(0.2, -0.05, 0.01)),
    "prism": Distortion(radial=(-0.1,), prism=(0.004, -0.005)),
    "fisheye": Distortion("equidistant", radial=(0.05, -0.01, 0.002, -0.001)),
    "equidistant": Distortion("equidistant"),
}


def opencv_matrix(pinhole: Pinhole) -> np.ndarray:
    """Return its intrinsics with the centre of the top-left pixel at (0, 0)."""
    return np.array(
        [[pinhole.fl_x, 0, pinhole.cx - 0.5], [0, pinhole.fl_y, pinhole.cy - 0.5], [0, 0, 1]]
    )


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_the_map_is_that_of_opencv_half_a_pixel_apart(lens):
    new = undistort_pinhole(PINHOLE, lens)
    k1, k2, k3, k4 = (*lens.radial, 0.0, 0.0, 0.0, 0.0)[:4]
    if lens.projection == "equidistant":
        rectify, coefficients = cv2.fisheye.initUndistortRectifyMap, np.array([k1, k2, k3, k4])
    else:
        (s1, s3), below = lens.prism, (*lens.denominator, 0.0, 0.0, 0.0)[:3]
        numbers = [k1, k2, *lens.tangential, k3, *below, s1, 0.0, s3, 0.0]
        rectify, coefficients = cv2.initUndistortRectifyMap, np.array(numbers)
    x, y = rectify(
        opencv_matrix(PINHOLE),
        coefficients,
        np.eye(3),
        opencv_matrix(new),
        (PINHOLE.width, PINHOLE.height),
        cv2.CV_32FC1,
    )
    assert np.allclose(
        compute_undistortion_map(PINHOLE, lens, new), np.stack([x, y], -1), atol=1e-4
    )


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_every_pixel_comes_from_the_photograph_and_little_of_it_is_lost(lens):
    new = undistort_pinhole(PINHOLE, lens)
    source = compute_undistortion_map(PINHOLE, lens, new)
    low, high = source.min(axis=(0, 1)), source.max(axis=(0, 1))
    size = np.array([PINHOLE.width, PINHOLE.height])
    assert (low >= -0.001).all()
    assert (high <= size - 0.999).all()
    # One more step of the zoom (half a percent of the image) would leave it.
    margins = np.concatenate([low, size - 1 - high])
    assert margins.min() < 0.005 * PINHOLE.width


def test_the_radius_grows_by_the_polynomial_of_the_first_coefficient():
    bent = distort(np.array([[0.5, 0.0], [0.0, -1.0]]), Distortion(radial=(0.1,)))
    assert np.allclose(bent, [[0.5 * 1.025, 0.0], [0.0, -1.1]])


def test_an_equidistant_fisheye_maps_angles_to_radii():
    bent = distort(np.array([[1.0, 0.0], [0.0, 0.0]]), Distortion("equidistant"))
    assert np.allclose(bent, [[np.pi / 4, 0.0], [0.0, 0.0]])


def test_without_distortion_nothing_changes():
    assert undistort_pinhole(PINHOLE, Distortion()) is PINHOLE


def test_a_field_of_view_of_zero_bends_nothing():
    """COLMAP's model FOV with an angle of 0 is a lens without distortion."""
    lens = Distortion("field-of-view", (0.0,))
    points = np.array([[0.0, 0.0], [0.3, -0.2]])
    assert np.array_equal(distort(points, lens), points)
    assert undistort_pinhole(PINHOLE, lens) is not None


def test_the_principal_point_stays_and_pixels_keep_their_shape():
    new = undistort_pinhole(PINHOLE, LENSES["pincushion"])
    assert (new.cx, new.cy, new.width, new.height) == (81.5, 59.0, 160, 120)
    assert new.fl_x / new.fl_y == pytest.approx(130.0 / 127.5)
    assert new.fl_x > PINHOLE.fl_x


POINTS = np.array([[0.3, -0.2], [0.7, 0.5], [-0.01, 0.4]])
REFERENCE = {
    "SIMPLE_PINHOLE": ([130, 81.5, 59], [[120.5, 33.0], [172.5, 124.0], [80.2, 111.0]]),
    "PINHOLE": ([130, 127.5, 81.5, 59], [[120.5, 33.5], [172.5, 122.75], [80.2, 110.0]]),
    "SIMPLE_RADIAL": (
        [130, 81.5, 59, -0.08],
        [[120.0944, 33.2704], [167.1128, 120.152], [80.21665, 110.33398]],
    ),
    "RADIAL": (
        [130, 81.5, 59, -0.08, 0.02],
        [[120.10758, 33.26161], [168.10943, 120.86388], [80.21598, 110.36064]],
    ),
    "OPENCV": (
        [130, 127.5, 81.5, 59, 0.058, -0.08, -0.001, 0.002],
        [[120.83753, 33.28483], [172.77539, 122.71379], [80.23331, 110.30574]],
    ),
    "OPENCV_FISHEYE": (
        [130, 127.5, 81.5, 59, 0.05, -0.01, 0.002, -0.001],
        [[119.14957, 34.38298], [158.36977, 112.85108], [80.25469, 107.85463]],
    ),
    "FULL_OPENCV": (
        [130, 127.5, 81.5, 59, 0.3, -0.1, 0.001, 0.002, 0.03, 0.2, -0.05, 0.01],
        [[121.02907, 33.19274], [177.46609, 126.18856], [80.22196, 110.79195]],
    ),
    "FOV": (
        [130, 127.5, 81.5, 59, 0.9],
        [[121.78502, 32.6598], [163.00251, 116.09654], [80.16838, 111.24039]],
    ),
    "SIMPLE_RADIAL_FISHEYE": (
        [130, 81.5, 59, 0.04],
        [[119.10999, 33.92667], [158.16747, 113.76248], [80.25622, 108.75101]],
    ),
    "RADIAL_FISHEYE": (
        [130, 81.5, 59, 0.04, -0.01],
        [[119.10462, 33.93025], [157.97606, 113.62576], [80.25648, 108.74063]],
    ),
    "THIN_PRISM_FISHEYE": (
        [130, 127.5, 81.5, 59, 0.05, -0.01, 0.001, 0.002, 0.003, -0.001, 0.004, -0.005],
        [[119.27177, 34.30307], [159.00891, 112.76567], [80.36678, 107.81597]],
    ),
    "SIMPLE_DIVISION": (
        [130, 81.5, 59, -0.1],
        [[120.00577, 33.32949], [166.60957, 119.79255], [80.22017, 110.19312]],
    ),
    "DIVISION": (
        [130, 127.5, 81.5, 59, 0.08],
        [[120.91426, 33.22914], [178.63851, 127.05033], [80.18291, 110.6705]],
    ),
    "SIMPLE_FISHEYE": (
        [130, 81.5, 59],
        [[118.9307, 34.0462], [156.65041, 112.67886], [80.26339, 108.46438]],
    ),
    "FISHEYE": (
        [130, 127.5, 81.5, 59],
        [[118.9307, 34.52608], [156.65041, 111.64658], [80.26339, 107.51314]],
    ),
    "EUCM": (
        [130, 127.5, 81.5, 59, 0.6, 1.1],
        [[118.94718, 34.51531], [156.82434, 111.76842], [80.26272, 107.53946]],
    ),
}
"""Parameters of COLMAP's models, and where pycolmap 4.2.1 projects POINTS with them."""


@pytest.mark.parametrize("name", REFERENCE)
def test_every_lens_of_colmap_bends_as_colmap_says(name):
    parameters, expected = REFERENCE[name]
    intrinsics = build_intrinsics(
        CAMERA_MODELS[name], (160, 120), list(map(float, parameters)), "the camera"
    )
    pinhole = intrinsics.compute_pinhole(160, 120)
    bent = distort(POINTS, intrinsics.distortion)
    pixels = bent * [pinhole.fl_x, pinhole.fl_y] + [pinhole.cx, pinhole.cy]
    assert np.allclose(pixels, expected, atol=1e-4)


def test_all_models_that_are_read_have_a_reference():
    assert set(REFERENCE) == set(CAMERA_MODELS)


@pytest.mark.parametrize("name", REFERENCE)
def test_every_lens_of_colmap_is_removed(name):
    parameters, _ = REFERENCE[name]
    intrinsics = build_intrinsics(
        CAMERA_MODELS[name], (160, 120), list(map(float, parameters)), "the camera"
    )
    new = undistort_pinhole(intrinsics.compute_pinhole(160, 120), intrinsics.distortion)
    assert new is not None
    source = compute_undistortion_map(
        intrinsics.compute_pinhole(160, 120), intrinsics.distortion, new
    )
    assert (source > -0.002).all()
    assert (source < [159.002, 119.002]).all()


@pytest.mark.parametrize(
    "lens",
    [
        Distortion("division", shape=(1e4,)),
        Distortion("unified", shape=(1.0, -1e4)),
        Distortion(radial=(-1e4, 1e4, -1e4)),
    ],
    ids=str,
)
def test_a_lens_that_shows_nothing_has_no_pinhole_camera(lens):
    assert undistort_pinhole(PINHOLE, lens) is None
    assert "fold the image" in find_distortion_defect(PINHOLE, lens)


@pytest.mark.parametrize("center", [{"cx": -20.0}, {"cy": 140.0}])
def test_a_crop_beside_the_principal_point_is_not_said_to_be_folded(center):
    """As a tile of a large photograph is."""
    crop = replace(PINHOLE, **center)
    assert "principal point lies outside" in find_distortion_defect(crop, LENSES["pincushion"])
    assert find_distortion_defect(crop, Distortion()) is None
