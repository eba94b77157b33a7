"""Writers of a synthetic room in every format of posed photographs."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from gscompleter.data.colmap import CAMERA_MODELS
from gscompleter.data.scene import write_cameras
from gscompleter.system.files.image import write_image
from gscompleter.types import Camera, View
from scenes import Room, camera_at, view_of

SIZE = 64
CAMERAS = [camera_at(x=0.1 * i, y=0.05 * i, z=-0.03 * i, yaw=4.0 * i, size=SIZE) for i in range(5)]
VIEWS = [view_of(Room(), camera) for camera in CAMERAS]
NAMES = [f"{i}.png" for i in range(len(VIEWS))]
PARAMETERS = (0.9 * SIZE, 0.9 * SIZE, SIZE / 2, SIZE / 2)
"""Number of COLMAP's PINHOLE."""


def write_photographs(
    folder: Path, names: Sequence[str] = NAMES, views: Sequence[View] = VIEWS
) -> Path:
    """Write the photographs of the room under these names."""
    for name, view in zip(names, views, strict=True):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(folder / name, view.image)
    return folder


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """Return the quaternion (real part first) of a rotation by less than 180°."""
    w = np.sqrt(1 + np.trace(rotation)) / 2
    r = rotation
    axis = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    return np.array([w, *(axis / (4 * w))])


def world_to_camera(camera: Camera) -> tuple[list[float], list[float]]:
    """Return quaternion and translation as in COLMAP."""
    viewmat = np.linalg.inv(camera.c2w.double().numpy())
    return quaternion_of(viewmat[:3, :3]).tolist(), viewmat[:3, 3].tolist()


def surface_points(count: int = 400) -> np.ndarray:
    """Return points on the surfaces that the photographs show."""
    generator = torch.Generator().manual_seed(5)
    points = []
    for view in VIEWS:
        assert view.depth is not None
        rays = view.camera.z_rays().reshape(-1, 3)
        chosen = torch.randint(len(rays), (count // len(VIEWS),), generator=generator)
        points.append(view.camera.center + view.depth.reshape(-1, 1)[chosen] * rays[chosen])
    return torch.cat(points).double().numpy()


def write_colmap_binary(
    folder: Path,
    names: Sequence[str] = NAMES,
    model: str = "PINHOLE",
    parameters: Sequence[float] = PARAMETERS,
    size: tuple[int, int] = (SIZE, SIZE),
    points: np.ndarray | None = None,
) -> Path:
    """Write cameras.bin, images.bin and points3D.bin of the room's first cameras, with features."""
    folder.mkdir(parents=True, exist_ok=True)
    numbers = struct.pack(f"<{len(parameters)}d", *parameters)
    camera = struct.pack("<QIiQQ", 1, 7, CAMERA_MODELS[model].number, *size) + numbers
    (folder / "cameras.bin").write_bytes(camera)
    images = struct.pack("<Q", len(names))
    for number, (name, camera_) in enumerate(zip(names, CAMERAS, strict=False)):
        quaternion, translation = world_to_camera(camera_)
        images += struct.pack("<I4d3dI", number + 1, *quaternion, *translation, 7)
        images += name.encode() + b"\0" + struct.pack("<Q", 2) + 2 * struct.pack("<ddq", 1, 2, -1)
    (folder / "images.bin").write_bytes(images)
    points = surface_points() if points is None else points
    content = struct.pack("<Q", len(points))
    for number, point in enumerate(points):
        content += struct.pack("<Q3d3Bd", number, *point, 1, 2, 3, 0.5)
        content += struct.pack("<QIIII", 2, 1, 0, 2, 0)
    (folder / "points3D.bin").write_bytes(content)
    return folder


def write_colmap_text(folder: Path, names: Sequence[str] = NAMES, features: str = "1 2 -1") -> Path:
    """Write cameras.txt, images.txt and points3D.txt of the room, with feature lines."""
    folder.mkdir(parents=True, exist_ok=True)
    parameters = " ".join(map(repr, PARAMETERS))
    (folder / "cameras.txt").write_text(f"# Cameras\n7 PINHOLE {SIZE} {SIZE} {parameters}\n")
    lines = ["# Images"]
    for number, (name, camera) in enumerate(zip(names, CAMERAS, strict=False)):
        quaternion, translation = world_to_camera(camera)
        pose = " ".join(map(repr, quaternion + translation))
        lines += [f"{number + 1} {pose} 7 {name}", features]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{n} {x} {y} {z} 1 2 3 0.5 1 0" for n, (x, y, z) in enumerate(surface_points())]
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")
    return folder


def write_camera_list(path: Path, names: Sequence[str] = NAMES) -> Path:
    """Write a cameras.json as Inria's code does, without endings of names."""
    entries = [
        {
            "id": number,
            "img_name": Path(name).stem,
            "width": camera.width,
            "height": camera.height,
            "position": camera.center.tolist(),
            "rotation": camera.c2w[:3, :3].tolist(),
            "fy": camera.K[1, 1].item(),
            "fx": camera.K[0, 0].item(),
        }
        for number, (name, camera) in enumerate(zip(names, CAMERAS, strict=False))
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(entries))
    return path


def write_llff(path: Path) -> Path:
    """Write a poses_bounds.npy of the room, with surfaces from 1 to 6."""
    rows = []
    for camera in CAMERAS:
        right, down, forward, center = camera.c2w[:3].double().numpy().T
        size = [camera.height, camera.width, camera.K[0, 0].item()]
        matrix = np.stack([down, right, -forward, center, size], axis=1)
        rows.append([*matrix.ravel(), 1.0, 6.0])
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, np.array(rows))
    return path


def write_kitti(folder: Path, labels: bool = True, aside: float = 0.0) -> Path:
    """Write calib.txt and poses.txt of the room; camera 2 is `aside` to the right of camera 0."""
    folder.mkdir(parents=True, exist_ok=True)
    K = CAMERAS[0].K.double().numpy()
    lines, rows = [], []
    for number in range(4):
        offset = np.array([-aside if number == 2 else 0.0, 0.0, 0.0])
        projection = K @ np.concatenate([np.eye(3), offset[:, None]], axis=1)
        label = f"P{number}: " if labels else ""
        lines.append(label + " ".join(f"{value:.12e}" for value in projection.ravel()))
    for camera in CAMERAS:
        first = camera.c2w.double().numpy().copy()
        first[:3, 3] -= aside * first[:3, 0]
        rows.append(" ".join(f"{value:.12e}" for value in first[:3].ravel()))
    (folder / "calib.txt").write_text("\n".join(lines) + "\n")
    (folder / "poses.txt").write_text("\n".join(rows) + "\n")
    return folder


def write_dgp(folder: Path) -> Path:
    """Write a DGP scene with one camera and a laser."""
    data = [{"id": {"name": "LIDAR"}, "datum": {"point_cloud": {"filename": "0.npz"}}}]
    for name, camera in zip(NAMES, CAMERAS, strict=True):
        q = quaternion_of(camera.c2w[:3, :3].double().numpy())
        pose = {
            "rotation": dict(zip(("qw", "qx", "qy", "qz"), q.tolist(), strict=True)),
            "translation": dict(zip("xyz", camera.center.tolist(), strict=True)),
        }
        image = {"filename": f"rgb/CAMERA_01/{name}", "height": SIZE, "width": SIZE, "pose": pose}
        data.append({"id": {"name": "CAMERA_01"}, "datum": {"image": image}})
    (folder / "calibration").mkdir(parents=True, exist_ok=True)
    scene = {"data": data, "samples": [{"calibration_key": "abc"}]}
    (folder / "scene_1.json").write_text(json.dumps(scene))
    fx, fy, cx, cy = PARAMETERS
    lenses = [dict.fromkeys(("fx", "fy", "cx", "cy", "skew"), 0.0)]
    lenses.append({"fx": fx, "fy": fy, "cx": cx, "cy": cy, "skew": 0.0})
    content = {"names": ["LIDAR", "CAMERA_01"], "intrinsics": lenses, "extrinsics": []}
    (folder / "calibration" / "abc.json").write_text(json.dumps(content))
    return folder


def binary(folder: Path) -> Path:
    write_photographs(folder / "images")
    write_colmap_binary(folder / "sparse" / "0")
    return folder


def text(folder: Path) -> Path:
    write_photographs(folder / "images")
    write_colmap_text(folder / "sparse")
    return folder


def camera_list(folder: Path) -> Path:
    write_photographs(folder / "images")
    write_camera_list(folder / "cameras.json")
    return folder


def llff(folder: Path) -> Path:
    write_photographs(folder / "images")
    write_llff(folder / "poses_bounds.npy")
    return folder


def kitti(folder: Path, aside: float = 0.0, labels: bool = True) -> Path:
    names = [f"{number:06d}.png" for number in range(len(VIEWS))]
    write_photographs(folder / "image_2", names)
    return write_kitti(folder, labels, aside)


def kitti_aside(folder: Path) -> Path:
    return kitti(folder, aside=0.54, labels=False)


def dgp(folder: Path) -> Path:
    write_photographs(folder / "rgb" / "CAMERA_01")
    return write_dgp(folder)


def transforms(folder: Path) -> Path:
    write_photographs(folder)
    write_cameras(folder / "transforms.json", CAMERAS, NAMES)
    return folder


def splits(folder: Path) -> Path:
    """Write the layout of NeRF's synthetic scenes: three files, no endings, one field of view."""
    write_photographs(folder)
    parts = {"train": (0, 3), "val": (1, 4), "test": (2,)}
    for part, numbers in parts.items():
        path = folder / f"transforms_{part}.json"
        chosen = [CAMERAS[number] for number in numbers]
        write_cameras(path, chosen, [f"./{number}" for number in numbers])
        content = json.loads(path.read_text())
        frames = [{k: f[k] for k in ("file_path", "transform_matrix")} for f in content["frames"]]
        angle = 2 * np.arctan(0.5 / 0.9)
        path.write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return folder


def write_table(path: Path, table: np.ndarray) -> None:
    """Write rows of numbers with as many digits as restore them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.atleast_2d(table).tolist()
    path.write_text("\n".join(" ".join(map(repr, row)) for row in rows) + "\n")


def write_millimetres(path: Path, view: View, unit: float = 1e-3) -> None:
    """Write the depth of a view as a 16-bit PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = (view.depth.double().numpy() / unit).round().clip(0, 65535)
    Image.fromarray(values.astype(np.uint16)).save(path)


def get_lens(camera: Camera) -> np.ndarray:
    """Return the matrix of the lens in float64."""
    return camera.K.double().numpy()


def scannet(folder: Path) -> Path:
    """Write the layout of ScanNet's reader."""
    write_photographs(folder / "color")
    lens = np.eye(4)
    lens[:3, :3] = get_lens(CAMERAS[0])
    write_table(folder / "intrinsic/intrinsic_color.txt", lens)
    for number, (camera, view) in enumerate(zip(CAMERAS, VIEWS, strict=True)):
        write_table(folder / f"pose/{number}.txt", camera.c2w.double().numpy())
        write_millimetres(folder / f"depth/{number}.png", view)
    return folder


def replica(folder: Path) -> Path:
    """Write the layout of Replica as it is rendered for SLAM."""
    write_photographs(folder / "results", [f"frame{n:06d}.png" for n in range(len(VIEWS))])
    for number, view in enumerate(VIEWS):
        write_millimetres(folder / f"results/depth{number:06d}.png", view, 1 / 6553.5)
    write_table(folder / "traj.txt", np.stack([c.c2w.double().numpy().ravel() for c in CAMERAS]))
    lens = get_lens(CAMERAS[0])
    camera = {"w": SIZE, "h": SIZE, "fx": lens[0, 0], "fy": lens[1, 1], "scale": 6553.5}
    camera |= {"cx": lens[0, 2] - 0.5, "cy": lens[1, 2] - 0.5}  # whole numbers are pixel centres
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder


def mvsnet(folder: Path) -> Path:
    """Write the layout of BlendedMVS and MVSNet."""
    write_photographs(folder / "blended_images", [f"{n:08d}.png" for n in range(len(VIEWS))])
    (folder / "cams").mkdir()
    (folder / "rendered_depth_maps").mkdir()
    for number, (camera, view) in enumerate(zip(CAMERAS, VIEWS, strict=True)):
        viewmat = np.linalg.inv(camera.c2w.double().numpy()).tolist()
        blocks = [
            "extrinsic\n" + "\n".join(" ".join(map(repr, row)) for row in viewmat),
            "intrinsic\n" + "\n".join(" ".join(map(repr, r)) for r in get_lens(camera).tolist()),
            "0.5 0.01 128 6.0",
        ]
        (folder / f"cams/{number:08d}_cam.txt").write_text("\n\n".join(blocks) + "\n")
        depth = view.depth.numpy()[::-1].astype("<f4")
        head = f"Pf\n{SIZE} {SIZE}\n-1.0\n".encode()
        file = folder / f"rendered_depth_maps/{number:08d}.pfm"
        file.write_bytes(head + depth.tobytes())
    return folder


def idr(folder: Path) -> Path:
    """Write the layout of IDR and NeuS, whose projections have any factor."""
    write_photographs(folder / "image", [f"{n:06d}.png" for n in range(len(VIEWS))])
    matrices = {}
    for number, camera in enumerate(CAMERAS):
        viewmat = np.linalg.inv(camera.c2w.double().numpy())
        projection = np.eye(4)
        projection[:3] = get_lens(camera) @ viewmat[:3] * (-2.0 if number % 2 else 3.0)
        matrices[f"world_mat_{number}"] = projection
        matrices[f"scale_mat_{number}"] = np.diag([2.0, 2.0, 2.0, 1.0])
    np.savez(folder / "cameras_sphere.npz", **matrices)
    return folder


WRITERS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "colmap-binary": ("colmap", binary),
    "colmap-text": ("colmap", text),
    "cameras-json": ("cameras-json", camera_list),
    "llff": ("llff", llff),
    "kitti": ("kitti", kitti),
    "kitti-aside": ("kitti", kitti_aside),
    "dgp": ("dgp", dgp),
    "transforms": ("nerfstudio", transforms),
    "splits": ("nerfstudio", splits),
    "scannet": ("scannet", scannet),
    "replica": ("replica", replica),
    "mvsnet": ("mvsnet", mvsnet),
    "idr": ("idr", idr),
}
"""Writers of each kind of folder, and the names of their formats."""
