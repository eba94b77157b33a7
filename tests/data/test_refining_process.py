"""The process that refines poses: what it measures is in one frame."""

import cv2
import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")

from gscompleter.data.sfm.placing import KnownCopy
from gscompleter.data.sfm.refining_process import (
    join_poses,
    make_pose,
    measure_epipolar_distances,
    move_adjusted,
)

SIZE = 160
PINHOLE = (150.0, 150.0, SIZE / 2, SIZE / 2)
NUMBERS = (1, 2, 3, 4)
"""Numbers of the images of a straight drive along x."""


def make_copy(number: int) -> KnownCopy:
    """Make the copy of an image whose camera looks along z, from a place on the x axis."""
    viewmat = np.eye(3, 4)
    viewmat[0, 3] = -0.3 * number
    return KnownCopy(f"{number}.png", SIZE, SIZE, PINHOLE, viewmat.tolist(), is_masked=False)


def test_a_copy_that_kept_its_pose_is_measured_in_the_frame_of_the_others():
    """COLMAP leaves the roll about the line of a drive free, and the last copy had few points."""
    copies = {number: make_copy(number) for number in NUMBERS}
    points = np.random.default_rng(0).uniform([-1, -1, 3], [2, 1, 6], (20, 3))
    keypoints = {}
    for number, copy in copies.items():
        flat = points @ np.array(copy.viewmat)[:, :3].T + np.array(copy.viewmat)[:, 3]
        keypoints[number] = PINHOLE[0] * flat[:, :2] / flat[:, 2:] + SIZE / 2
    same = np.stack([np.arange(20), np.arange(20)], axis=1)
    matches = {(i, j): same for i in NUMBERS for j in NUMBERS if i < j}

    # Points and cameras have turned together.
    roll = np.eye(4)
    roll[:3, :3] = cv2.Rodrigues(np.array([2.4, 0.0, 0.0]))[0]
    adjusted = {n: (np.array(copies[n].viewmat) @ roll).tolist() for n in NUMBERS[:3]}
    moved = move_adjusted(adjusted, copies)
    assert sorted(moved) == [1, 2, 3]
    poses = join_poses(moved, copies)
    distances = measure_epipolar_distances(
        matches, keypoints, poses, dict.fromkeys(NUMBERS, PINHOLE)
    )
    assert len(distances) == 6 * 20
    assert distances.max() < 1e-6

    # As they come from COLMAP, they are not in one frame with the last.
    mixed = {**{n: make_pose(adjusted[n]) for n in adjusted}, 4: make_pose(copies[4].viewmat)}
    apart = measure_epipolar_distances(matches, keypoints, mixed, dict.fromkeys(NUMBERS, PINHOLE))
    assert apart.max() > 10


def test_two_cameras_determine_no_frame():
    copies = {number: make_copy(number) for number in NUMBERS}
    assert move_adjusted({n: copies[n].viewmat for n in (1, 2)}, copies) == {}
