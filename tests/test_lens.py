"""Lens distortion: OpenCV's models, our pixel centres, and no empty pixel afterwards."""

import cv2
import numpy as np
import pytest

from gscompleter.data.lens import Distortion, Pinhole, distort, undistorted, undistortion_map

PINHOLE = Pinhole(fl_x=130.0, fl_y=127.5, cx=81.5, cy=59.0, width=160, height=120)

LENSES = {
    "phone": Distortion(False, (0.058, -0.08, 0.0, 0.0), (-0.001, 0.0002)),
    "barrel": Distortion(False, (-0.3, 0.1, -0.01, 0.0), (0.001, 0.002)),
    "pincushion": Distortion(False, (0.3, 0.0, 0.0, 0.0)),
    "fisheye": Distortion(True, (0.05, -0.01, 0.002, -0.001)),
    "equidistant": Distortion(True),
}


def opencv_matrix(pinhole: Pinhole) -> np.ndarray:
    """Its intrinsics with the centre of the top-left pixel at (0, 0)."""
    return np.array(
        [[pinhole.fl_x, 0, pinhole.cx - 0.5], [0, pinhole.fl_y, pinhole.cy - 0.5], [0, 0, 1]]
    )


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_the_map_is_that_of_opencv_half_a_pixel_apart(lens):
    new = undistorted(PINHOLE, lens)
    k1, k2, k3, _ = lens.radial
    if lens.fisheye:
        rectify, coefficients = cv2.fisheye.initUndistortRectifyMap, np.array(lens.radial)
    else:
        rectify, coefficients = (
            cv2.initUndistortRectifyMap,
            np.array([k1, k2, *lens.tangential, k3]),
        )
    x, y = rectify(
        opencv_matrix(PINHOLE),
        coefficients,
        np.eye(3),
        opencv_matrix(new),
        (PINHOLE.width, PINHOLE.height),
        cv2.CV_32FC1,
    )
    assert np.allclose(undistortion_map(PINHOLE, lens, new), np.stack([x, y], -1), atol=1e-4)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_every_pixel_comes_from_the_photograph_and_little_of_it_is_lost(lens):
    new = undistorted(PINHOLE, lens)
    source = undistortion_map(PINHOLE, lens, new)
    low, high = source.min(axis=(0, 1)), source.max(axis=(0, 1))
    size = np.array([PINHOLE.width, PINHOLE.height])
    assert (low >= -0.001).all()
    assert (high <= size - 0.999).all()
    # One more step of the zoom (half a percent of the image) would leave it.
    margins = np.concatenate([low, size - 1 - high])
    assert margins.min() < 0.005 * PINHOLE.width


def test_the_radius_grows_by_the_polynomial_of_the_first_coefficient():
    bent = distort(np.array([[0.5, 0.0], [0.0, -1.0]]), Distortion(False, (0.1, 0.0, 0.0, 0.0)))
    assert np.allclose(bent, [[0.5 * 1.025, 0.0], [0.0, -1.1]])


def test_an_equidistant_fisheye_maps_angles_to_radii():
    bent = distort(np.array([[1.0, 0.0], [0.0, 0.0]]), Distortion(True))
    assert np.allclose(bent, [[np.pi / 4, 0.0], [0.0, 0.0]])


def test_without_distortion_nothing_changes():
    assert undistorted(PINHOLE, Distortion()) is PINHOLE


def test_the_principal_point_stays_and_pixels_keep_their_shape():
    new = undistorted(PINHOLE, LENSES["pincushion"])
    assert (new.cx, new.cy, new.width, new.height) == (81.5, 59.0, 160, 120)
    assert new.fl_x / new.fl_y == pytest.approx(130.0 / 127.5)
    assert new.fl_x > PINHOLE.fl_x
