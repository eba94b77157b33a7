"""Segments of the Waymo Open Dataset 2 with known cameras, depth and boxes."""

from __future__ import annotations

import builtins
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

pytest.importorskip("pyarrow", reason="needs gscompleter[waymo]")

from command import run
from gscompleter import InputError
from gscompleter.data.driving.vehicle import build_poses
from gscompleter.data.formats import open_photographs
from gscompleter.data.photographs import Photographs
from gscompleter.evaluation.cases import open_clips
from gscompleter.evaluation.store import list_row_paths, read_run_file
from kitti_city_segment import kitti_city_segment
from measured_photographs import find_moving
from waymo_segment import (
    SEGMENT,
    Laser,
    Moment,
    RigCamera,
    Seen,
    write_segment,
)

WIDTH, HEIGHT = 96, 64
LENS = (80.0, 80.0, 50.0, 30.0, 0.0, 0.0, 0.0, 0.0, 0.0)
PLACE = np.array([7213.0, -4100.0, 30.0])
"""Start of the drive, far from the origin of its map."""
ALONG = np.array([0.9, 0.4, 0.0])
"""Step from one place to the next."""
WALL = np.array([0.9, 0.3, -0.1, 12.0])
"""Plane n·x = d in front of the vehicle at the start, in its axes and metres."""


def turned(yaw: float, pitch: float = 0.0, place: tuple[float, ...] = (0.0, 0.0, 0.0)):
    """Return a pose that is pitched, then yawed, in radians."""
    return build_poses(np.array([0.0, pitch, yaw, *place]))


VEHICLES = [turned(0.4 + 0.02 * n, 0.01, tuple(PLACE + n * ALONG)) for n in range(3)]
MOUNTED = turned(0.03, 0.02, (1.5, 0.1, 2.1))
ASIDE = turned(1.2, 0.0, (1.4, 0.3, 2.0))
CAMERAS = (
    RigCamera(1, LENS, (WIDTH, HEIGHT), MOUNTED),
    RigCamera(2, LENS, (WIDTH, HEIGHT), ASIDE),
)
LASERS = (
    Laser(
        1, turned(2.6, 0.01, (1.4, 0.0, 2.2)), -0.4, 0.1, tuple(np.linspace(-0.63, 0.4, 20) ** 3)
    ),
    Laser(2, turned(-0.3, 0.0, (4.0, 0.0, 0.7)), -0.6, 0.6),
)


def jpeg(shade: int) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (WIDTH, HEIGHT), (shade, 128, 255 - shade)).save(file, "JPEG", quality=95)
    return file.getvalue()


def wall_in_world() -> np.ndarray:
    """Return the plane in the world; it is fixed while the vehicle drives."""
    first = VEHICLES[0]
    normal = first[:3, :3] @ WALL[:3]
    return np.array([*normal, WALL[3] + normal @ first[:3, 3]])


def ranges_to_wall(laser: Laser, vehicle: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Compute the distance of the wall along the beams, by the published range image formula."""
    h, w = shape
    even = laser.low + (np.arange(h) + 0.5) / h * (laser.high - laser.low)
    rising = even if laser.values is None else np.array(laser.values)
    yaw = np.arctan2(laser.vehicle_from_laser[1, 0], laser.vehicle_from_laser[0, 0])
    ratios = (np.arange(w, 0, -1) - 0.5) / w
    azimuth, inclination = np.meshgrid((ratios * 2 - 1) * np.pi - yaw, rising[::-1])
    x = np.cos(azimuth) * np.cos(inclination)
    rays = np.stack([x, np.sin(azimuth) * np.cos(inclination), np.sin(inclination)], axis=-1)
    pose, plane = vehicle @ laser.vehicle_from_laser, wall_in_world()
    along = (rays @ pose[:3, :3].T) @ plane[:3]
    distance = (plane[3] - plane[:3] @ pose[:3, 3]) / along
    return np.where((distance > 0) & (distance < 60), distance, -1)


def moments(while_turning: bool) -> list[Moment]:
    """Return three times of the drive, with two lasers that see the wall."""
    found = []
    for number, vehicle in enumerate(VEHICLES):
        shape = (20, 400)
        poses = np.zeros((*shape, 6))
        poses[..., 1:] = [0.01, 0.4 + 0.02 * number, *vehicle[:3, 3]]
        moving = Seen((9.0, 0.0, 1.0), (2.0, 2.0, 2.0), 0.3, 1, (0.0, 3.0, 0.0))
        parked = Seen((9.0, -3.0, 1.0), (2.0, 2.0, 2.0), 0.3, 1, (0.0, 0.1, 0.0))
        sign = Seen((9.0, 3.0, 2.0), (1.0, 1.0, 1.0), 0.0, 3, None)
        found.append(
            Moment(
                1000 * (number + 1),
                vehicle,
                {2: jpeg(number), 1: jpeg(10 * number)},
                {
                    1: ranges_to_wall(LASERS[0], vehicle, shape),
                    2: ranges_to_wall(LASERS[1], vehicle, (40, 200)),
                },
                poses if while_turning else None,
                (moving, parked, sign),
            )
        )
    return found


def segment(root: Path, while_turning: bool = False) -> Path:
    return write_segment(root, moments(while_turning), CAMERAS, LASERS)


def depth_of_wall(photographs: Photographs, frame: int) -> torch.Tensor:
    """Return z-depth of the wall at the centre of each pixel."""
    camera = photographs.camera(frame)
    plane = torch.from_numpy(wall_in_world())
    rays, center = camera.z_rays().double(), camera.center.double()
    center = center + torch.from_numpy(photographs.origin)
    return (plane[3] - plane[:3] @ center) / (rays @ plane[:3])


def test_frames_come_camera_by_camera_and_clips_are_of_the_front_camera(tmp_path):
    root = segment(tmp_path)
    every = open_photographs(root)
    names = [
        f"{camera}/{time}" for camera in ("FRONT", "FRONT_LEFT") for time in (1000, 2000, 3000)
    ]
    assert (every.format, every.name, [frame.name for frame in every.frames]) == (
        "waymo",
        SEGMENT,
        names,
    )
    (clip,) = open_clips(root)
    assert [frame.name for frame in clip.frames] == names[:3]
    assert clip.find_skip_reason() is None
    shades = [view.image[5, 5, 0].item() for view in every.views([0, 2, 5])]
    assert shades == pytest.approx([0, 20 / 255, 2 / 255], abs=4 / 255)


def test_cameras_stand_where_vehicle_and_mounting_put_them(tmp_path):
    photographs = open_photographs(segment(tmp_path))
    for frame in range(3):
        camera = photographs.camera(frame)
        expected = VEHICLES[frame] @ MOUNTED
        c2w = camera.c2w.double().numpy()
        assert c2w[:3, 3] + photographs.origin == pytest.approx(expected[:3, 3], abs=1e-4)
        # Right, down and forward of OpenCV are -y, -z and x of Waymo.
        axes = np.stack([-expected[:3, 1], -expected[:3, 2], expected[:3, 0]], axis=1)
        assert np.abs(c2w[:3, :3] - axes).max() < 1e-6
    assert photographs.camera(0).K.diagonal().tolist() == [80, 80, 1]
    assert photographs.camera(0).K[:2, 2].tolist() == [50, 30]


@pytest.mark.parametrize("while_turning", [False, True])
def test_lasers_tell_the_depth_of_a_wall(tmp_path, while_turning):
    photographs = open_photographs(segment(tmp_path, while_turning))
    for view in photographs.views([0, 2]):
        known = view.depth > 0
        assert 0.05 < known.float().mean() < 0.9
        expected = depth_of_wall(photographs, view.frame)
        error = ((view.depth - expected).abs() / expected)[known]
        # A point lies anywhere in its pixel, whose corners are 0.9 % nearer or farther.
        assert error.max() < 0.012
        assert error.median() < 0.005


def test_the_vehicle_moves_while_a_laser_turns(tmp_path):
    """Poses of the pixels that are two metres ahead move what is measured by as much."""
    told = [
        open_photographs(segment(tmp_path / str(t), t)).frames[0].laser_points() for t in (0, 1)
    ]
    assert told[0] == pytest.approx(told[1], abs=2e-3)
    ahead = moments(True)
    for moment in ahead:
        moment.pixel_poses[..., 3:] += [2.0, 0.0, 0.0]
    root = write_segment(tmp_path / "ahead", ahead, CAMERAS, LASERS)
    shift = open_photographs(root).frames[0].laser_points() - told[1]
    from_roof = (ranges_to_wall(LASERS[0], VEHICLES[0], (20, 400)) > 0).sum()
    assert shift[:from_roof] == pytest.approx(np.array([[2.0, 0, 0]] * from_roof), abs=1e-6)
    assert np.abs(shift[from_roof:]).max() == 0


def test_poses_of_pixels_that_are_not_those_of_the_laser_are_refused(tmp_path):
    cut = [replace(moment, pixel_poses=moment.pixel_poses[:-1]) for moment in moments(True)]
    root = write_segment(tmp_path, cut, CAMERAS, LASERS)
    with pytest.raises(InputError, match="does not fit its calibration or its poses"):
        open_photographs(root).views([0])


def test_boxes_mask_what_moves(tmp_path):
    photographs = open_photographs(segment(tmp_path))
    mask = find_moving(photographs, 0)
    camera = photographs.camera(0)

    def shown(center: tuple[float, float, float]) -> bool:
        world = VEHICLES[0] @ [*center, 1]
        local = camera.c2w[:3, :3].T @ (
            torch.from_numpy(world[:3] - photographs.origin).float() - camera.center
        )
        x, y = ((camera.K @ local)[:2] / local[2]).long().tolist()
        return bool(mask[y, x])

    assert shown((9.0, 0.0, 1.0))
    assert not shown((9.0, -3.0, 1.0))
    assert not shown((9.0, 3.0, 2.0))
    assert 0.02 < mask.float().mean() < 0.3
    halved = find_moving(photographs, 0, (HEIGHT // 2, WIDTH // 2))
    assert halved.float().mean().item() == pytest.approx(mask.float().mean().item(), rel=0.15)


@pytest.mark.parametrize(
    ("component", "said"),
    [
        ("camera_image", "cannot be read"),
        ("camera_calibration", "cannot be read"),
        ("lidar", "cannot be read"),
        ("lidar_calibration", "cannot be read"),
        ("vehicle_pose", "cannot be read"),
    ],
)
def test_a_damaged_table_is_refused(tmp_path, component, said):
    root = segment(tmp_path)
    file = root / component / f"{SEGMENT}.parquet"
    file.write_bytes(file.read_bytes()[:-30])
    with pytest.raises(InputError, match=said) as error:
        open_photographs(root).views([0])
    assert "\n" not in str(error.value)


def test_a_segment_without_its_cameras_is_refused(tmp_path):
    root = segment(tmp_path)
    (root / "camera_calibration" / f"{SEGMENT}.parquet").unlink()
    with pytest.raises(InputError, match="camera_calibration.* cannot be read"):
        open_photographs(root)


def test_a_segment_without_lasers_has_no_depth(tmp_path):
    bare = [Moment(1, VEHICLES[0], {1: jpeg(0)}, {})]
    photographs = open_photographs(write_segment(tmp_path, bare, CAMERAS))
    (view,) = photographs.views([0])
    assert view.depth is None
    assert find_moving(photographs, 0) is None


def test_without_pyarrow_a_sentence_says_what_to_install(tmp_path, monkeypatch):
    root = segment(tmp_path)
    given = builtins.__import__

    def without(name, *rest):
        if name.startswith("pyarrow"):
            raise ImportError(name)
        return given(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"pip install 'gscompleter\[waymo\]'"):
        open_photographs(root)


@pytest.mark.slow
def test_a_real_road_is_evaluated(shared, tmp_path, monkeypatch, capsys):
    """The protocol of two photographs and one beyond them, with true depth of the road."""
    root = kitti_city_segment(shared, tmp_path / "waymo", count=5)
    words = ("--protocol", "n-2", "--limit", 1, "--resolution", 36, 120, "--quiet")
    methods = ("--methods", "context", "full")
    assert run(monkeypatch, "evaluate", root, *words, *methods, "--out", tmp_path / "out") == 0
    rows = [read_run_file(path) for path in list_row_paths(tmp_path / "out")]
    assert sorted(row["method"] for row in rows) == ["context", "full"]
    assert {row["task"]["name"] for row in rows} == {f"{SEGMENT} 0+2>4"}
    scores = {row["method"]: row["steps"][0]["scores"] for row in rows}
    assert all(score["depth_observed"] is not None for score in scores.values())
    before, after = (scores["full"][f"target_{when}"]["psnr"] for when in ("before", "after"))
    assert after > before - 0.1  # what lies ahead has next to no hole; nothing is to be spoilt
    assert scores["context"]["target_after"]["psnr"] == before


@pytest.mark.slow
def test_what_moves_on_a_real_road_does_not_count(shared, tmp_path, monkeypatch, capsys):
    ahead = Seen((14.0, 0.0, 1.0), (4.0, 2.0, 2.0), 0.0, 1, (5.0, 0.0, 0.0))
    root = kitti_city_segment(shared, tmp_path / "waymo", count=5, boxes=(ahead,))
    words = ("--protocol", "n-2", "--limit", 1, "--resolution", 36, 120, "--quiet")
    words = (*words, "--methods", "context")
    for out, more in (("all", ()), ("ignoring", ("--ignore-moving",))):
        assert run(monkeypatch, "evaluate", root, *words, *more, "--out", tmp_path / out) == 0
    found = [
        read_run_file(path)
        for out in ("all", "ignoring")
        for path in list_row_paths(tmp_path / out)
    ]
    every, ignoring = (row["steps"][0]["scores"] for row in found)
    assert ignoring["hole_fraction"] > every["hole_fraction"]
    bare = kitti_city_segment(shared, tmp_path / "bare", count=5)
    (bare / "lidar_box").mkdir(exist_ok=True)
    words = (*words, "--ignore-moving", "--out", tmp_path / "bare-out")
    assert run(monkeypatch, "evaluate", bare, *words) == 2
    assert "has no boxes of moving objects" in capsys.readouterr().err
