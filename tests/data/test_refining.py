"""Refined poses: they agree better with matches that were kept back, in the given frame."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from gscompleter.data.formats import open_photographs
from gscompleter.data.photographs import Photographs
from gscompleter.data.sfm.placing import write_known_copies
from gscompleter.data.sfm.refining import (
    PoseRefinement,
    move_to_given_frame,
    pair_near,
    refine_poses,
)
from gscompleter.system.errors import InputError
from scenes import camera_at, photographed

CAMERAS = [
    camera_at(x=0.3 * i - 1.05, y=0.1 * (i % 3), z=0.05 * i, yaw=14 - 4 * i, size=160)
    for i in range(8)
]
"""Cameras 0.3 apart, whose pixels are 0.4 degrees wide."""
ORIGIN = np.array([4e5, -5e6, 120.0])
"""Origin of a map, where float32 has half a unit."""


def compute_error(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Compute the distance of two cameras, and the angle between them in degrees."""
    cosine = (np.trace(one[:3, :3].T @ other[:3, :3]) - 1) / 2
    angle = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return float(np.linalg.norm(one[:3, 3] - other[:3, 3])), angle


def shake(photographs: Photographs, degrees: float, distance: float) -> Photographs:
    """Turn and move each camera at random, by about so much."""
    rng = np.random.default_rng(3)
    frames = []
    for frame in photographs.frames:
        c2w = frame.c2w.copy()
        turn = rng.normal(size=3) * np.radians(degrees) / np.sqrt(3)
        c2w[:3, :3] = c2w[:3, :3] @ cv2.Rodrigues(turn)[0]
        c2w[:3, 3] += rng.normal(size=3) * distance / np.sqrt(3)
        frames.append(replace(frame, c2w=c2w))
    return replace(photographs, frames=tuple(frames))


def move_to_map(photographs: Photographs) -> Photographs:
    """Move photographs into a map, of which they have a local origin."""
    frames = []
    for frame in photographs.frames:
        c2w = frame.c2w.copy()
        c2w[:3, 3] += ORIGIN
        frames.append(replace(frame, c2w=c2w))
    return replace(photographs, frames=tuple(frames), origin=ORIGIN)


def measure_worst(photographs: Photographs) -> tuple[float, float]:
    """Measure the largest distance and angle of the cameras from the true ones."""
    pairs = zip(photographs.frames, CAMERAS, strict=True)
    origin = np.append(photographs.origin, 0.0)[:, None] * [0, 0, 0, 1]
    errors = [compute_error(f.c2w - origin, c.c2w.double().numpy()) for f, c in pairs]
    return max(d for d, _ in errors), max(a for _, a in errors)


def test_shaken_cameras_come_back_into_the_given_frame(tmp_path):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    true = open_photographs(photographed(tmp_path / "scene", CAMERAS))
    shaken = shake(move_to_map(true), 0.8, 0.03)
    refined, done = refine_poses(shaken)
    assert done is not None
    assert done.is_accepted
    assert done.photographs == 8
    assert done.refined_error < done.given_error / 3
    before = measure_worst(shaken)
    after = measure_worst(refined)
    assert after[1] < before[1] / 2
    # The frame is that of the shaken cameras, which are off by their mean error.
    assert after[0] < before[0]
    assert refined.origin is shaken.origin
    assert f"{done.given_error:.2f} px" in done.describe()


# `test_poses_are_refined_only_where_kept_back_matches_agree_better` decides without COLMAP.
@pytest.mark.slow
def test_cameras_that_agree_stay_bit_for_bit(tmp_path):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    true = open_photographs(photographed(tmp_path / "scene", CAMERAS[:5]))
    kept, done = refine_poses(true)
    assert done is not None
    assert not done.is_accepted
    assert kept is true
    assert done.describe().startswith("Given poses are kept")


def test_damaged_photographs_are_left_out_unless_all_are(tmp_path):
    photographs = open_photographs(photographed(tmp_path / "room", CAMERAS))
    files = [frame.file.path for frame in photographs.frames]
    files[2].write_bytes(b"no image")
    copies, sources = write_known_copies(photographs, tmp_path / "copies")
    assert [copy.name for copy in copies] == list(sources)
    assert list(sources.values()) == [path.name for path in files if path != files[2]]
    for path in files:
        path.write_bytes(b"no image")
    with pytest.raises(InputError, match=f"{files[0].name} is not an image"):
        write_known_copies(photographs, tmp_path / "others")


def test_two_photographs_hold_no_frame_and_are_left(tmp_path):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    pair = open_photographs(photographed(tmp_path / "scene", CAMERAS[:2]))
    assert refine_poses(pair) == (pair, None)


def test_a_moved_turned_and_scaled_model_is_brought_back():
    given = np.stack([camera.c2w.double().numpy() for camera in CAMERAS])
    turn = cv2.Rodrigues(np.array([0.2, -1.1, 0.4]))[0]
    moved = given.copy()
    moved[:, :3, :3] = turn @ given[:, :3, :3]
    moved[:, :3, 3] = 3.0 * given[:, :3, 3] @ turn.T + [5.0, -2.0, 1.0]
    assert np.abs(move_to_given_frame(moved, given) - given).max() < 1e-12 * np.abs(given).max()


def test_a_straight_drive_keeps_its_roll():
    given = np.stack([camera_at(z=0.5 * i).c2w.double().numpy() for i in range(6)])
    turn = cv2.Rodrigues(np.array([0.0, 0.0, 0.7]))[0]
    moved = given.copy()
    moved[:, :3, :3] = turn @ given[:, :3, :3]
    moved[:, :3, 3] = given[:, :3, 3] @ turn.T
    assert np.abs(move_to_given_frame(moved, given) - given).max() < 1e-12 * np.abs(given).max()


def test_each_camera_is_paired_with_near_ones_of_its_direction():
    row = [camera_at(x=0.1 * i) for i in range(20)]
    pairs = pair_near(row)
    assert (0, 1) in pairs
    assert (0, 19) not in pairs
    # What looks the other way is farther than any of the row.
    assert not [pair for pair in pair_near([*row, camera_at(x=0.0, yaw=180)]) if pair == (0, 20)]
    # Cameras in one place have no parallax.
    assert (0, 1) not in pair_near([camera_at(), camera_at(yaw=5), camera_at(x=1), camera_at(x=2)])


@pytest.mark.parametrize(
    ("given", "refined", "is_accepted"),
    [(0.2, 0.1, True), (0.2, 0.19, False), (0.2, 0.3, False), (0.0, 0.0, False)],
)
def test_poses_are_refined_only_where_kept_back_matches_agree_better(given, refined, is_accepted):
    done = PoseRefinement(9, given_error=given, refined_error=refined, moved=0.1)
    assert done.is_accepted == is_accepted


def test_poses_that_no_kept_back_match_compares_are_left(tmp_path, monkeypatch):
    """As COLMAP's process answers if it kept no match back: then nothing is known of the errors."""
    scene = open_photographs(photographed(tmp_path / "scene", CAMERAS[:4]))
    moved = [camera.c2w.double().numpy() + 0.01 for camera in CAMERAS[:4]]
    answer = {"poses": np.array(moved).tolist(), "given_error": None, "refined_error": None}
    monkeypatch.setattr("gscompleter.data.sfm.refining.run_colmap", lambda *_: answer)
    monkeypatch.setattr("gscompleter.data.sfm.refining.require_pycolmap", lambda: None)
    assert refine_poses(scene) == (scene, None)
