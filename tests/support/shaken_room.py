"""Photographs of the room, one of which has a wrong pose, and a stand-in for COLMAP."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from gscompleter.data.photographs import Photographs
from gscompleter.data.sfm.refining import PoseRefinement
from scenes import camera_at, photographed

CAMERAS = [
    camera_at(x=0.3 * i - 1.05, y=0.1 * (i % 3), z=0.05 * i, yaw=14 - 4 * i, size=160)
    for i in range(8)
]
SHAKEN = 4
"""Photograph whose given pose is turned by a pixel and a half."""
CONTEXT = (2, SHAKEN)
DONE = PoseRefinement(8, given_error=0.4, refined_error=0.1, moved=0.05)


def write_shaken(folder: Path) -> Path:
    """Write photographs of the room, one of them with a wrong pose."""
    photographed(folder, CAMERAS)
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    content["frames"][SHAKEN]["transform_matrix"] = turn(
        np.array(content["frames"][SHAKEN]["transform_matrix"])
    ).tolist()
    path.write_text(json.dumps(content))
    return folder


def turn(pose: np.ndarray) -> np.ndarray:
    """Turn a camera by 0.6 degrees to the side and up."""
    angle = np.radians(0.6)
    about_y = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    about_x = [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ np.array(about_y) @ np.array(about_x)
    return turned


def correct(photographs: Photographs) -> tuple[Photographs, PoseRefinement]:
    """Stand in for COLMAP: give the wrong camera its true pose."""
    frames = list(photographs.frames)
    frames[SHAKEN] = replace(frames[SHAKEN], c2w=CAMERAS[SHAKEN].c2w.double().numpy())
    return replace(photographs, frames=tuple(frames)), DONE
