"""Driving data sets on real files: camera poses, and sweeps as depth."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from driving_files import infos, write_infos
from gscompleter import InputError
from gscompleter.data.driving.mmdet3d import load_plain, open_infos
from gscompleter.data.driving.vehicle import read_sweep
from gscompleter.data.formats import open_photographs
from gscompleter.data.json_fields import get_number
from gscompleter.evaluation.cases import open_clips
from gscompleter.numerics.geometry import project
from measured_photographs import find_moving


def real(shared: Path, name: str) -> Path:
    path = shared / "formats" / name
    if not path.exists():
        pytest.skip(f"needs {path}")
    return path


def write_grey(path: Path, width: int, height: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", (width, height), 100).save(path)


def write_sweep(path: Path, points: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.pad(points, ((0, 0), (0, 1))).astype("<f4").tofile(path)


def nuscenes(shared: Path, folder: Path) -> tuple[Path, dict]:
    """Write the real infos of one sample, beside photographs of nuScenes size."""
    info = folder / "info.pkl"
    shutil.copy(real(shared, "nuscenes_mmdet3d/info.pkl"), info)
    content = load_plain(info)
    for image in content["data_list"][0]["images"].values():
        write_grey(folder / image["img_path"], 1600, 900)
    return info, content["data_list"][0]


def test_nuscenes_cameras_show_boxes_where_its_own_infos_put_them(shared, tmp_path):
    info, sample = nuscenes(shared, tmp_path)
    photographs = open_photographs(info)
    assert photographs.format == "mmdet3d"
    assert [frame.name.split("/")[0] for frame in photographs.frames[:2]] == [
        "CAM_FRONT",
        "CAM_BACK",
    ]
    camera = photographs.camera(0)
    assert camera.K[0].tolist() == pytest.approx([1266.417, 0, 816.267], abs=1e-3)
    centers = photographs.frames[0].boxes().mean(axis=1) - photographs.origin
    pixels, depths = project(torch.from_numpy(centers).float(), camera)
    things = sample["cam_instances"]["CAM_FRONT"]
    shown = [thing for thing in things if np.hypot(*thing["velocity"]) >= 0.5]
    assert len(shown) > 1
    for thing in shown:
        gap = (pixels - torch.tensor(thing["center_2d"])).norm(dim=-1)
        near = gap.masked_fill(depths <= 0, torch.inf).argmin()
        assert gap[near] < 1.0
        assert depths[near].item() == pytest.approx(thing["depth"], rel=2e-3)


def test_moving_things_of_nuscenes_are_masked_and_parked_ones_are_not(shared, tmp_path):
    info, sample = nuscenes(shared, tmp_path)
    photographs = open_photographs(info)
    mask = find_moving(photographs, 0)
    assert 0 < mask.float().mean() < 0.2
    speeds = [(t, float(np.hypot(*t["velocity"]))) for t in sample["cam_instances"]["CAM_FRONT"]]
    fast = [t for t, speed in speeds if speed > 1]
    assert fast
    inside = [(x, y) for x, y in (map(int, t["center_2d"]) for t in fast) if x < 1600 and y < 900]
    assert all(mask[y, x] for x, y in inside)


def test_waymo_infos_project_as_their_own_matrix_does(shared):
    info = real(shared, "waymo_mmdet3d/waymo_infos_val.pkl")
    (sample,) = load_plain(info)["data_list"]
    photographs = open_photographs(info)
    camera = photographs.camera(0)
    assert (camera.width, camera.height) == (1920, 1280)
    vehicle = np.array(sample["ego2global"])
    points = np.array([[10.0, 1.0, 0.5], [30.0, -4.0, 2.0], [60.0, 8.0, 1.0]])
    world = points @ vehicle[:3, :3].T + vehicle[:3, 3] - photographs.origin
    pixels, depths = project(torch.from_numpy(world).float(), camera)
    homogeneous = np.c_[points, np.ones(3)] @ np.array(sample["images"]["CAM_FRONT"]["lidar2img"]).T
    assert depths.numpy() == pytest.approx(homogeneous[:, 2], rel=1e-4)
    assert pixels.numpy() == pytest.approx(homogeneous[:, :2] / homogeneous[:, 2:3], abs=0.1)


def test_samples_of_which_nothing_names_the_drive_make_one_scene(tmp_path):
    content = infos()
    for sample in content["data_list"]:
        del sample["context_name"]
    content["data_list"][-1]["timestamp"] += 60
    scenes = list(open_infos(write_infos(tmp_path, content)))
    assert [(scene.name, len(scene)) for scene in scenes] == [
        ("infos_0.000", 4),
        ("infos_62.000", 1),
    ]


def test_infos_that_mix_up_left_and_right_cameras_are_refused(tmp_path):
    content = infos()
    image = content["data_list"][0]["images"]["CAM_FRONT"]
    image["cam2img"] = [[*row, 0.0] for row in (*image["cam2img"], [0.0, 0.0, 0.0])]
    with pytest.raises(InputError, match="before mmdetection3d 1.4, which take left cameras"):
        open_photographs(write_infos(tmp_path, content))


class Evil:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return (os.mkdir, (str(self.marker),))


HOSTILE = {
    "a name": b"cposix\nsystem\n(S'true'\ntR.",
    "the outside": b"\x80\x02U\x03oneQ.",
    "an attribute": b"\x80\x04\x8c\x05numpy\x8c\x12core.multiarray.sys\x93.",
    "nothing": b"",
    "half": pickle.dumps({"data_list": [1, 2, 3]})[:-6],
    "a table": b"\x80\x02K\x01r\xff\xff\xff\x7f.",
    "a promise": b"\x80\x04\x8e\xff\xff\xff\xff\xff\x00\x00\x00abc.",
}


@pytest.mark.parametrize("name", [name for name in HOSTILE if name != "a table"])
def test_a_pickle_of_anything_but_plain_values_is_refused(tmp_path, name):
    path = tmp_path / "infos.pkl"
    path.write_bytes(HOSTILE[name])
    with pytest.raises(InputError, match="is no pickle of plain values") as error:
        load_plain(path)
    assert "\n" not in str(error.value)


def test_a_pickle_runs_nothing(tmp_path):
    path, marker = tmp_path / "infos.pkl", tmp_path / "made"
    path.write_bytes(pickle.dumps({"data_list": [Evil(marker)]}))
    with pytest.raises(InputError, match=r"it names posix\.mkdir"):
        open_photographs(path)
    assert not marker.exists()


def test_a_small_pickle_takes_no_large_table(tmp_path):
    path = tmp_path / "infos.pkl"
    path.write_bytes(HOSTILE["a table"])
    assert load_plain(path) == 1


def test_numbers_of_numpy_are_read(tmp_path):
    path = tmp_path / "infos.pkl"
    values = {"a": np.float64(0.1), "b": np.int64(-3), "c": np.bool_(True), "d": [1, "x", None]}
    path.write_bytes(pickle.dumps(values))
    found = load_plain(path)
    assert found == values
    assert get_number(found, "a", "", -9.0, 9.0) == 0.1
    assert get_number(found, "b", "", -9.0, 9.0) == -3


def test_kitti_odometry_with_a_sweep(shared, tmp_path):
    lines = real(shared, "kitti/seq1_calib.txt").read_text().strip().splitlines()
    laser = "0 -1 0 0.1  0 0 -1 -0.2  1 0 0 -0.3"
    (tmp_path / "calib.txt").write_text("\n".join([*lines, f"Tr: {laser}", ""]))
    shutil.copy(real(shared, "kitti/seq1_poses.txt"), tmp_path / "poses.txt")
    for number in range(3):
        write_grey(tmp_path / "image_0" / f"{number:06d}.png", 1241, 376)
    write_sweep(tmp_path / "velodyne" / "000001.bin", np.array([[10.3, -2.0, 1.0], [-9.0, 0, 0]]))
    photographs = open_photographs(tmp_path)
    assert photographs.views([0])[0].depth is None
    (view,) = photographs.views([1])
    K = view.camera.K
    # Ten metres ahead, 2.1 to the right and 1.2 up in the frame of camera 0.
    x, y = int(K[0, 0] * 0.21 + K[0, 2]), int(K[1, 1] * -0.12 + K[1, 2])
    assert (view.depth > 0).sum() == 1
    assert view.depth[y, x].item() == pytest.approx(10.0, rel=1e-5)


def raw_drive(shared: Path, folder: Path) -> Path:
    """Write a drive with real calibrations that moves 20 m north in two steps."""
    cameras = real(shared, "kitti/raw_calib_cam_to_cam.partial.txt").read_text().rstrip("\n")
    rectify = "R_rect_00: 1 0 0 0 1 0 0 0 1"
    (folder / "calib_cam_to_cam.txt").write_text(
        f"calib_time: 09-Jan-2012 13:57:47\n{cameras}\n{rectify}\n"
    )
    shutil.copy(real(shared, "kitti/raw_calib_velo_to_cam.txt"), folder / "calib_velo_to_cam.txt")
    (folder / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n")
    drive = folder / "2011_09_26_drive_0001_sync"
    (drive / "oxts" / "data").mkdir(parents=True)
    for number in range(3):
        write_grey(drive / "image_02" / "data" / f"{number:010d}.png", 1242, 375)
        north = 49.0 + np.degrees(10.0 * number / 6_378_137.0)
        reading = f"{north:.12f} 8.4 116.0 0 0 {np.pi / 2} 0 0 0"
        (drive / "oxts" / "data" / f"{number:010d}.txt").write_text(reading)
    return drive


def test_kitti_raw_drives_along_its_own_axis(shared, tmp_path):
    photographs = open_photographs(raw_drive(shared, tmp_path))
    assert photographs.format == "kitti-raw"
    cameras = [photographs.camera(frame) for frame in range(3)]
    steps = torch.stack([c.center for c in cameras]).diff(dim=0)
    # The vehicle heads north (y), and so does its camera.
    assert steps.numpy() == pytest.approx(np.array([[0.0, 10.0, 0.0]] * 2), abs=0.01)
    assert cameras[0].forward[1] > 0.999
    assert cameras[0].c2w[:3, 1][2] < -0.999
    assert cameras[0].K[0].tolist() == pytest.approx([721.5377, 0, 609.5593], abs=1e-3)


def test_kitti_raw_shows_its_sweeps(shared, tmp_path):
    drive = raw_drive(shared, tmp_path)
    points = np.array([[12.0, 1.0, -0.5], [25.0, -3.0, 0.5]])
    write_sweep(drive / "velodyne_points" / "data" / f"{2:010d}.bin", points)
    (view,) = open_photographs(drive).views([2])
    lines = (tmp_path / "calib_velo_to_cam.txt").read_text().splitlines()
    numbers = {
        line[0]: np.array(line[2:].split(), dtype=float) for line in lines if line[0] in "RT"
    }
    local = points @ numbers["R"].reshape(3, 3).T + numbers["T"]
    row = (tmp_path / "calib_cam_to_cam.txt").read_text().splitlines()[1]
    projected = np.c_[local, np.ones(2)] @ np.array(row.split()[1:], float).reshape(3, 4).T
    for x, y, z in projected:
        assert view.depth[int(y / z), int(x / z)].item() == pytest.approx(z, rel=1e-4)
    assert (view.depth > 0).sum() == 2


def test_kitti_raw_shrinks_its_cameras_with_its_photographs(shared, tmp_path):
    drive = raw_drive(shared, tmp_path)
    calibration = tmp_path / "calib_cam_to_cam.txt"
    content = calibration.read_text()
    calibration.write_text(f"{content}S_rect_02: 1.242000e+03 3.750000e+02\n")
    for number in range(3):
        write_grey(drive / "image_02" / "data" / f"{number:010d}.png", 828, 250)
    K = open_photographs(drive).camera(0).K
    assert K[0].tolist() == pytest.approx([721.5377 / 1.5, 0, 609.5593 / 1.5], abs=1e-3)
    assert K[1].tolist() == pytest.approx([0, 721.5377 / 1.5, 172.854 / 1.5], abs=1e-3)
    write_grey(drive / "image_02" / "data" / f"{0:010d}.png", 640, 160)
    with pytest.raises(InputError, match="another aspect ratio"):
        open_photographs(drive).camera(0)
    for size in ("0 375", "1242"):
        calibration.write_text(f"{content}S_rect_02: {size}\n")
        with pytest.raises(InputError, match="line S_rect_02"):
            open_photographs(drive)


def test_kitti_raw_takes_what_is_no_photograph_for_none(shared, tmp_path):
    drive = raw_drive(shared, tmp_path)
    (drive / "image_02" / "data" / "Thumbs.db").write_bytes(b"small pictures")
    assert len(open_photographs(drive)) == 3


def test_a_projection_of_kitti_with_skew_is_refused(shared, tmp_path):
    drive = raw_drive(shared, tmp_path)
    calibration = tmp_path / "calib_cam_to_cam.txt"
    before, _, after = calibration.read_text().partition(" 0.000000e+00 ")
    calibration.write_text(f"{before} 5.000000e+01 {after}")
    with pytest.raises(InputError, match="is not that of a rectified camera"):
        open_photographs(drive)


def test_kitti_raw_says_what_is_missing(shared, tmp_path):
    drive = raw_drive(shared, tmp_path)
    content = (tmp_path / "calib_cam_to_cam.txt").read_text()
    (tmp_path / "calib_cam_to_cam.txt").write_text(content.replace("R_rect_00", "R_00"))
    with pytest.raises(InputError, match="has no line R_rect_00 of 9 numbers"):
        open_photographs(drive)
    (tmp_path / "calib_imu_to_velo.txt").unlink()
    with pytest.raises(InputError, match="calib_imu_to_velo.txt cannot be read"):
        open_photographs(drive)


def test_a_clip_of_ddad_is_its_front_camera(shared):
    (clip,) = open_clips(real(shared, "dgp_ddad"))
    assert {frame.sensor for frame in clip.frames} == {"CAMERA_01"}
    assert len(clip) == 3


def test_ddad_shows_the_sweep_of_the_same_sample(shared, tmp_path):
    for name in ("scene.json", "calibration.json"):
        shutil.copy(real(shared, f"dgp_ddad/{name}"), tmp_path / name)
    scene = json.loads((tmp_path / "scene.json").read_text())
    data = {datum["key"]: datum for datum in scene["data"]}
    sample = [data[key] for key in scene["samples"][0]["datum_keys"]]
    cloud = next(d["datum"]["point_cloud"] for d in sample if "point_cloud" in d["datum"])
    image = next(d["datum"]["image"] for d in sample if d["id"]["name"] == "CAMERA_01")
    write_grey(tmp_path / image["filename"], 1936, 1216)
    photographs = open_photographs(tmp_path)
    frame = [frame.name for frame in photographs.frames].index(image["filename"])
    world = photographs.camera(frame).c2w.double().numpy() @ [0.5, -0.2, 14.0, 1]
    world[:3] += photographs.origin
    told = cloud["pose"]["rotation"]
    rotation = Rotation.from_quat([told[f"q{key}"] for key in "xyzw"]).as_matrix()
    place = np.array([cloud["pose"]["translation"][axis] for axis in "xyz"])
    points = np.array([*(rotation.T @ (world[:3] - place)), 0.7])[None]
    (tmp_path / cloud["filename"]).parent.mkdir(parents=True)
    np.savez(tmp_path / cloud["filename"], data=points)
    (view,) = open_photographs(tmp_path).views([frame])
    assert view.depth[view.depth > 0].tolist() == pytest.approx([14.0], rel=1e-4)


POSE = {
    "position": {"x": 0.6558286953029124, "y": 0.555863909647736, "z": 1.8011768068489773},
    "heading": {
        "w": 0.6548767857613946,
        "x": -0.6514903276121121,
        "y": 0.27678883380008457,
        "z": -0.26473513174921903,
    },
}
"""First pose of a front camera as PandaSet publishes it."""


def pandaset(folder: Path) -> Path:
    for name in ("back_camera", "front_camera"):
        camera = folder / "camera" / name
        write_grey(camera / "00.jpg", 192, 108)
        ahead = {**POSE, "position": {**POSE["position"], "x": 1.5}}
        (camera / "poses.json").write_text(json.dumps([POSE, ahead]))
        lens = {"fx": 1970.0131, "fy": 1970.0091, "cx": 970.0002, "cy": 483.2988}
        (camera / "intrinsics.json").write_text(json.dumps(lens))
        (camera / "timestamps.json").write_text(json.dumps([1557539924.5, 1557539924.6]))
    return folder


def test_a_sequence_of_pandaset_begins_with_its_front_camera(tmp_path):
    photographs = open_photographs(pandaset(tmp_path / "002"))
    assert (photographs.format, photographs.name) == ("pandaset", "002")
    assert photographs.frames[0].name == "front_camera/00"
    camera = photographs.camera(0)
    # A camera that stands upright and looks ahead: down is against z, forward is level.
    assert camera.c2w[2, 1] < -0.99
    assert abs(camera.forward[2].item()) < 0.03
    center = camera.center.double().numpy() + photographs.origin
    assert center == pytest.approx([*POSE["position"].values()], abs=1e-6)
    (clip,) = open_clips(tmp_path / "002")
    assert len(clip) == 2


def test_a_sequence_of_pandaset_with_damaged_poses_is_refused(tmp_path):
    folder = pandaset(tmp_path / "002")
    (folder / "camera" / "front_camera" / "poses.json").write_text('[{"position": 3}]')
    with pytest.raises(InputError, match="`w` of pose 0 of .* is missing"):
        open_photographs(folder)


def test_a_truncated_sweep_is_refused(tmp_path):
    file = tmp_path / "0.bin"
    file.write_bytes(bytes(33))
    with pytest.raises(InputError, match="ends within a point"):
        read_sweep(file, np.eye(4))
