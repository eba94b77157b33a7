"""Writers of a synthetic room as phones export it, from the documented layouts."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from gscompleter.system.files.image import convert_to_pixels
from gscompleter.types import Camera
from scenes import Room, view_of

WIDE, UPRIGHT = (96, 72), (72, 96)
"""Sizes of photographs, width and height; depth maps have a third of them."""
UNSURE = 8
"""Columns on the left of a depth map whose confidence is low."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def camera_of(number: int, size: tuple[int, int], scale: float = 1.0) -> Camera:
    """Make a tilted camera whose focal lengths and principal point differ in x and y."""
    c2w = np.eye(4)
    c2w[:3, :3] = Rotation.from_euler("yxz", [3.0 * number, 7.0, -11.0], degrees=True).as_matrix()
    c2w[:3, 3] = [0.1 * number, 0.05 * number, -0.02 * number]
    width, height = (round(scale * side) for side in size)
    K = (
        np.array([[82.0, 0, size[0] / 2 + 3], [0, 80.0, size[1] / 2 - 4], [0, 0, 1 / scale]])
        * scale
    )
    return Camera(torch.from_numpy(c2w).float(), torch.from_numpy(K).float(), width, height)


def stored_pose(number: int, size: tuple[int, int]) -> np.ndarray:
    """Return camera-to-world with the axes of ARKit: x right, y up, z back."""
    return camera_of(number, size).c2w.double().numpy() @ OPENGL


@cache
def depth_of(number: int, size: tuple[int, int]) -> np.ndarray:
    """Return the true z-depth at the pixel centres of a depth map, in metres."""
    depth = view_of(Room(), camera_of(number, size, 1 / 3)).depth
    assert depth is not None
    return depth.numpy()


def confidence_of(size: tuple[int, int], high: int) -> np.ndarray:
    confidence = np.full((size[1] // 3, size[0] // 3), high, np.uint8)
    confidence[:, :UNSURE] = 0
    confidence[:, UNSURE : UNSURE + 4] = high // 2
    return confidence


def encode(pixels: np.ndarray, kind: str = "PNG") -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format=kind, quality=95, subsampling=0)
    return file.getvalue()


@cache
def photograph(number: int, size: tuple[int, int], kind: str = "JPEG") -> bytes:
    image = view_of(Room(), camera_of(number, size)).image
    return encode(convert_to_pixels(image), kind)


def millimetres(number: int, size: tuple[int, int]) -> bytes:
    return encode((depth_of(number, size) * 1000).round().astype(np.uint16))


Files = dict[str, bytes]
"""Content of files by their paths below the export."""


def polycam(corrected: bool = True) -> Files:
    """Return the raw data of Polycam; with `corrected`, the other poses have drifted."""
    files = {"mesh_info.json": b"{}", "raw.glb": b"glTF"}
    for number in range(4):
        stem, K = str(1_660_000_000_000 + number), camera_of(number, WIDE).K.tolist()
        pose = stored_pose(number, WIDE)
        lens = {"fx": K[0][0], "fy": K[1][1], "cx": K[0][2], "cy": K[1][2]}
        entry = {"width": WIDE[0], "height": WIDE[1], "blur_score": 99.0, "timestamp": 1, **lens}
        for kind in ("corrected_", "") if corrected else ("",):
            moved = pose if kind or not corrected else pose + 0.01 * np.eye(4, k=3)
            rows = {f"t_{i}{j}": moved[i, j] for i in range(3) for j in range(4)}
            files[f"keyframes/{kind}cameras/{stem}.json"] = json.dumps({**entry, **rows}).encode()
            files[f"keyframes/{kind}images/{stem}.jpg"] = photograph(number, WIDE)
        files[f"keyframes/depth/{stem}.png"] = millimetres(number, WIDE)
        files[f"keyframes/confidence/{stem}.png"] = encode(confidence_of(WIDE, 255))
    return files


def scanner_app() -> Files:
    """Return all data of 3d Scanner App: every second frame has no photograph."""
    files = {"info.json": b"{}", "points.ply": b"ply\n"}
    for frame in range(8):
        number, stem = frame // 2, f"{frame:05d}"
        K = camera_of(number, WIDE).K - torch.tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        content = {
            "cameraPoseARFrame": stored_pose(number, WIDE).ravel().tolist(),
            "intrinsics": K.flatten().tolist(),
            "frame_index": frame,
        }
        files[f"frame_{stem}.json"] = json.dumps(content).encode()
        files[f"depth_{stem}.png"] = millimetres(number, WIDE)
        files[f"conf_{stem}.png"] = encode(confidence_of(WIDE, 2))
        if frame % 2 == 0:
            files[f"frame_{stem}.jpg"] = photograph(number, WIDE)
    return files


def nerf_capture() -> Files:
    """Return a recording of NeRFCapture: depth up to 10 m in 16 bits, as large as photographs."""
    K, files, frames = camera_of(0, WIDE).K.tolist(), Files(), []
    for number in range(4):
        depth = np.kron(depth_of(number, WIDE), np.ones((3, 3))) * 65535 / 10
        files[f"images/{number}.png"] = photograph(number, WIDE, "PNG")
        files[f"images/{number}.depth.png"] = encode(depth.astype(np.uint16))
        place = {"file_path": f"images/{number}", "depth_path": f"images/{number}.depth.png"}
        frames.append({"transform_matrix": stored_pose(number, WIDE).tolist(), **place})
    lens = {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2]}
    scale = {"w": WIDE[0], "h": WIDE[1], "integer_depth_scale": 10 / 65535}
    content = {**lens, **scale, "frames": frames}
    return {**files, "transforms.json": json.dumps(content).encode()}


def pack(data: bytes) -> bytes:
    """Return an LZFSE stream of one block without compression."""
    return b"bvx-" + struct.pack("<I", len(data)) + data + b"bvx$"


def record3d(
    size: tuple[int, int] = UPRIGHT, own_lenses: bool = True, pack: Callable[[bytes], bytes] = pack
) -> Files:
    """Return a recording of Record3D; with `own_lenses`, `K` is that of another lens."""
    cameras = [camera_of(number, size) for number in range(4)]
    files, K = {"icon": b"", "sound.m4a": b""}, cameras[0].K.double().numpy()
    poses = []
    for number in range(4):
        pose = stored_pose(number, size)
        poses.append([*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]])
        files[f"rgbd/{number}.jpg"] = photograph(number, size)
        files[f"rgbd/{number}.depth"] = pack(depth_of(number, size).astype("<f4").tobytes())
        files[f"rgbd/{number}.conf"] = pack(confidence_of(size, 2).tobytes())
    metadata = {"w": size[0], "h": size[1], "fps": 30, "poses": poses, "K": K.T.ravel().tolist()}
    if own_lenses:
        metadata["K"] = (2 * K.T).ravel().tolist()
        metadata["perFrameIntrinsicCoeffs"] = [K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()] * 4
    return {**files, "metadata": json.dumps(metadata).encode()}


def write_folder(folder: Path, files: Files) -> Path:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def write_archive(path: Path, files: Files, home: str = "") -> Path:
    """Write a zip archive, with the files in a folder `home` and what macOS adds to it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(home + name, content)
            if home:
                parent, _, last = (home + name).rpartition("/")
                archive.writestr(f"__MACOSX/{parent}/._{last}", b"\0\5\x16\7")
    return path
