"""Writers of a synthetic room in vehicle formats that `pose_files` does not cover."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from pose_files import CAMERAS, NAMES, SIZE, VIEWS, dgp, surface_points, write_photographs

IDENTITY = {
    "rotation": {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0},
    "translation": {"x": 0.0, "y": 0.0, "z": 0.0},
}


def infos() -> dict[str, Any]:
    """Build infos of mmdetection3d: one camera, half a second between samples."""
    return {
        "metainfo": {"categories": {"car": 0, "barrier": 1}},
        "data_list": [info(number) for number in range(len(CAMERAS))],
    }


def info(number: int) -> dict[str, Any]:
    camera = CAMERAS[number]
    image = {
        "img_path": NAMES[number],
        "cam2img": camera.K.tolist(),
        "lidar2cam": np.linalg.inv(camera.c2w.double().numpy()).tolist(),
        "width": SIZE,
        "height": SIZE,
    }
    box = {"bbox_3d": [0.0, 0.0, 5.0, 1.0, 1.0, 1.0, 0.0], "bbox_label_3d": 0}
    return {
        "timestamp": 0.5 * number,
        "context_name": "room",
        "ego2global": np.eye(4).tolist(),
        "lidar_points": {"lidar2ego": np.eye(4).tolist()},
        "images": {"CAM_FRONT": image},
        "instances": [{**box, "velocity": [3.0, 0.0]}],
    }


def write_infos(folder: Path, content: Any = None) -> Path:
    """Write infos.pkl beside the photographs of the room."""
    write_photographs(folder)
    path = folder / "infos.pkl"
    path.write_bytes(pickle.dumps(infos() if content is None else content))
    return path


def write_swept_dgp(folder: Path) -> Path:
    """Write a DGP scene whose photographs belong to a laser sweep."""
    path = dgp(folder) / "scene_1.json"
    scene = json.loads(path.read_text())
    for number, datum in enumerate(scene["data"]):
        datum["key"] = str(number)
    scene["data"][0]["datum"]["point_cloud"]["pose"] = IDENTITY
    scene["samples"][0]["datum_keys"] = [datum["key"] for datum in scene["data"]]
    path.write_text(json.dumps(scene))
    np.savez(folder / "0.npz", data=surface_points())
    return folder


def write_drive(folder: Path) -> Path:
    """Write a drive of raw KITTI, all sensors at the camera, one metre between frames."""
    numbers = " ".join(f"{value:.12e}" for value in np.eye(3).ravel())
    K = np.concatenate([CAMERAS[0].K.double().numpy(), np.zeros((3, 1))], axis=1)
    projection = " ".join(f"{value:.12e}" for value in K.ravel())
    drive = folder / "2011_09_26_drive_0001_sync"
    names = [f"{number:010d}" for number in range(len(VIEWS))]
    write_photographs(drive / "image_02" / "data", [f"{name}.png" for name in names])
    (folder / "calib_cam_to_cam.txt").write_text(
        f"calib_time: 09-Jan-2012 13:57:47\nR_rect_00: {numbers}\nP_rect_02: {projection}\n"
    )
    for sensor in ("velo_to_cam", "imu_to_velo"):
        (folder / f"calib_{sensor}.txt").write_text(f"R: {numbers}\nT: 0 0 0\n")
    (drive / "oxts" / "data").mkdir(parents=True)
    for number, name in enumerate(names):
        north = 49.0 + np.degrees(number / 6_378_137.0)
        (drive / "oxts" / "data" / f"{name}.txt").write_text(f"{north:.12f} 8.4 116 0 0 0 0\n")
    return drive
