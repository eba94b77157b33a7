"""Depth, poses and photographs that lie in a folder and are not used have names."""

import numpy as np
import pytest
from PIL import Image

from exact_room import make_cameras, write_colmap, write_photographs, write_transforms
from gscompleter.data.formats import open_photographs
from gscompleter.data.sfm.poses import list_all_photographs
from gscompleter.data.unused_files import list_unused

CAMERAS = make_cameras(3, width=64, height=48, focal=52.0)


def write_depth(folder, names):
    """Write depth maps of 16 bits."""
    folder.mkdir(exist_ok=True)
    for name in names:
        Image.fromarray(np.full((48, 64), 2000, np.uint16)).save(folder / name)


def test_depth_whose_form_is_not_known_is_named(tmp_path):
    scene = write_colmap(tmp_path, CAMERAS, n_points=60)
    assert open_photographs(scene).unused == ()
    write_depth(scene / "depths", [f"photo_{number:03d}.png" for number in range(3)])
    assert open_photographs(scene).unused == ("depths (3 files of depth)",)


def test_depth_that_is_read_is_not_named(tmp_path):
    fields = [{"depth_file_path": f"depth/{number}.png"} for number in range(3)]
    scene = write_transforms(tmp_path, CAMERAS, frame_fields=fields)
    write_depth(scene / "depth", [f"{number}.png" for number in range(3)])
    assert open_photographs(scene).unused == ()
    assert open_photographs(scene / "transforms.json").unused == ()


@pytest.mark.parametrize("name", ["lidar", "velodyne", "fused.ply", "scan.LAS"])
def test_points_of_a_laser_are_named(tmp_path, name):
    scene = write_transforms(tmp_path, CAMERAS)
    (scene / name).write_text("")
    assert open_photographs(scene).unused == (f"{name} (points of a laser or of dense stereo)",)


def test_photographs_without_a_camera_are_named(tmp_path):
    scene = write_colmap(tmp_path, CAMERAS, n_points=60)
    write_photographs(scene / "images", CAMERAS[:2], ["extra.png", "masked.png.png"])
    Image.new("L", (64, 48)).save(scene / "images" / "photo_000_mask.png")
    (phrase,) = open_photographs(scene).unused
    assert phrase == "2 photographs in images without a camera (extra.png, masked.png.png)"


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("pose/0.txt", "poses as text"),
        ("odometry.csv", "poses of Stray Scanner"),
        ("groundtruth.txt", "a trajectory of TUM RGB-D"),
        ("frame-000000.pose.txt", "poses of 7-Scenes"),
        ("41048190.traj", "a trajectory"),
        ("sfm_data.json", "cameras of OpenMVG"),
        ("reconstruction.json", "cameras of OpenSfM"),
        ("result.nvm", "cameras of VisualSFM"),
    ],
)
def test_poses_that_are_not_read_are_named_where_cameras_are_found(tmp_path, name, kind):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("")
    assert kind in list_unused(tmp_path, (), has_found_cameras=True)[0]
    assert list_unused(tmp_path, (), has_found_cameras=False) == ()


def test_depth_maps_and_confidence_are_no_photographs(tmp_path):
    write_photographs(tmp_path, CAMERAS, ["frame-0.color.png", "depth of field.png", "2.png"])
    write_depth(tmp_path, ["frame-0.depth.png"])
    write_photographs(tmp_path / "confidence", CAMERAS)
    write_photographs(tmp_path / "mono_depth", CAMERAS)
    names = ["2.png", "depth of field.png", "frame-0.color.png"]
    assert list_all_photographs(tmp_path) == names
    unused = list_unused(tmp_path, (), has_found_cameras=True)
    assert unused == (
        "mono_depth (3 files of depth)",
        "1 depth maps such as frame-0.depth.png",
    )
