"""What a nerfstudio `transforms.json` says, checked, without opening any image."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.data.lens import Distortion, Pinhole
from gscompleter.errors import InputError
from gscompleter.io.image import image_size
from gscompleter.io.json_file import read_json

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""nerfstudio's cameras look along -z with y up, ours along z with y down."""

PERSPECTIVE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
FISHEYE_MODELS = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")

MAX_RIGID_ERROR = 1e-3
"""Largest entry of RᵀR - I that still counts as rounding of a rotation R."""
FLOAT_NOISE = 1e-6
"""Rotations this close to exact are taken as they are."""

DOWNSCALED = (2, 4, 8)
"""By how much the copies of photographs are smaller that folders such as `images_4` hold."""

_INTRINSICS = (
    *("camera_model", "is_fisheye", "w", "h", "fl_x", "fl_y", "cx", "cy"),
    *("camera_angle_x", "camera_angle_y", "k1", "k2", "k3", "k4", "p1", "p2"),
)
"""Keys that may stand at the top, for all frames, or in a frame, for it alone."""


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics as the file gives them. None stands for what it leaves out."""

    size: tuple[int, int] | None
    """Width and height that the pixel values belong to."""
    focal: tuple[float | None, float | None]
    angle: tuple[float | None, float | None]
    """Full opening angles in radians, for files that give them in place of focal lengths."""
    center: tuple[float | None, float | None]
    distortion: Distortion

    def at(self, width: int, height: int) -> Pinhole:
        """The intrinsics of an image of that size, before its distortion is removed."""
        w, h = self.size or (width, height)
        fl_x = self.focal[0] or _focal_of(self.angle[0], w)
        fl_y = self.focal[1] or _focal_of(self.angle[1], h)
        cx = w / 2 if self.center[0] is None else self.center[0]
        cy = h / 2 if self.center[1] is None else self.center[1]
        # Where only one of the two is known, pixels are square.
        known = fl_x or fl_y
        assert known is not None
        return Pinhole(fl_x or known, fl_y or known, cx, cy, w, h).resized(width, height)


@dataclass(frozen=True)
class Frame:
    """One camera of a scene, and where its photograph should lie."""

    name: str
    """What error messages call it."""
    file_path: str | None
    """As the file has it; frames are numbered in its order."""
    c2w: Float[np.ndarray, "4 4"]
    """Camera-to-world in OpenCV axes and float64."""
    intrinsics: Intrinsics
    folder: Path
    depth_path: Path | None
    depth_unit: float

    @property
    def photograph(self) -> Path | None:
        """The image file of the frame; None where there is none.

        Where its folder `images` lacks it, the largest copy in `images_2`, `images_4` or
        `images_8`, as nerfstudio writes and DL3DV publishes them, takes its place.
        """
        if self.file_path is None:
            return None
        path = self.folder / self.file_path
        folders = [path.parent]
        if path.parent.name:
            folders += [path.parent.with_name(f"{path.parent.name}_{n}") for n in DOWNSCALED]
        names = [path.name + ending for ending in ("", ".png", ".jpg", ".jpeg")]
        candidates = [folder / name for folder in folders for name in names]
        return next((candidate for candidate in candidates if os.path.isfile(candidate)), None)

    def size(self) -> tuple[int, int]:
        """Width and height of the photograph, or where there is none, what the file says.

        Raises:
            InputError: where neither is known.
        """
        photograph = self.photograph
        if photograph is not None:
            return image_size(photograph)
        if self.intrinsics.size is None:
            raise InputError(
                f"The size of {self.name} is not known, because it has no image and no `w` and "
                "`h`; add these."
            )
        return self.intrinsics.size


@dataclass(frozen=True)
class SceneIndex:
    """The frames of a scene by number, with nothing read from disk but the JSON."""

    path: Path
    frames: tuple[Frame, ...]

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, number: int) -> Frame:
        """The frame of that number.

        Raises:
            InputError: where there is none.
        """
        if not 0 <= number < len(self.frames):
            raise InputError(
                f"There is no frame {number} in {self.path}, whose frames are numbered 0 to "
                f"{len(self.frames) - 1}; choose one of these."
            )
        return self.frames[number]


def read_index(scene: Path | str) -> SceneIndex:
    """The frames of a scene, numbered in the order of their sorted `file_path`.

    Where a frame has none, as in a list of cameras, the order of the file counts.

    Args:
        scene: A folder with a `transforms.json`, or the path of such a file.

    Raises:
        InputError: as `read_frames`.
    """
    frames = read_frames(scene)
    if all(frame.file_path is not None for frame in frames):
        frames = sorted(frames, key=lambda frame: frame.file_path or "")
    return SceneIndex(_json_path(Path(scene)), tuple(frames))


def read_frames(scene: Path | str) -> list[Frame]:
    """The frames of a scene in the order of the file.

    Poses within `MAX_RIGID_ERROR` of a rigid transform are made exactly rigid (the nearest
    rotation), unless they are so already up to `FLOAT_NOISE`.

    Raises:
        InputError: where the file is missing, is not JSON or has no frames, and where a pose
            or the intrinsics of one are missing or impossible.
    """
    path = _json_path(Path(scene))
    content = _read_transforms(path)
    entries = content.get("frames")
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path} lists no frames; its `frames` has to be a list with cameras.")
    shared = {key: content[key] for key in _INTRINSICS if key in content}
    unit = _number(content, "depth_unit_scale_factor", str(path))
    unit = 1e-3 if unit is None else unit
    if unit <= 0:
        raise InputError(f"{path} has a `depth_unit_scale_factor` of {unit}; it must be positive.")
    return [_frame(entry, i, shared, unit, path) for i, entry in enumerate(entries)]


def _json_path(scene: Path) -> Path:
    if os.path.isdir(scene):
        path = scene / "transforms.json"
        if not os.path.isfile(path):
            raise InputError(
                f"The folder {scene} has no transforms.json; export the scene in nerfstudio's "
                "format, or name the JSON file itself."
            )
        return path
    if not os.path.exists(scene):
        raise InputError(f"There is no scene {scene}; name a folder with a transforms.json.")
    return scene


def _read_transforms(path: Path) -> dict[str, Any]:
    content = read_json(path, "export the scene again")
    if not isinstance(content, dict):
        raise InputError(f"{path} is no transforms.json: it has to be an object with `frames`.")
    return content


def _frame(
    entry: Any, position: int, shared: Mapping[str, Any], depth_unit: float, path: Path
) -> Frame:
    name = f"frame {position} of {path}"
    if not isinstance(entry, dict):
        raise InputError(f"{_capital(name)} is not an object with a `transform_matrix`.")
    file_path = _text(entry, "file_path", name)
    if file_path is not None:
        name = f"frame {file_path} of {path}"
    depth_file_path = _text(entry, "depth_file_path", name)
    return Frame(
        name=name,
        file_path=file_path,
        c2w=_pose(entry.get("transform_matrix"), name) @ OPENCV_FROM_OPENGL,
        intrinsics=_intrinsics({**shared, **entry}, name),
        folder=path.parent,
        depth_path=None if depth_file_path is None else path.parent / depth_file_path,
        depth_unit=depth_unit,
    )


def _pose(matrix: Any, name: str) -> Float[np.ndarray, "4 4"]:
    """A rigid transform from nested lists of 3 or 4 rows."""
    if matrix is None:
        raise InputError(f"{_capital(name)} has no `transform_matrix`; add its camera-to-world.")
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (ValueError, TypeError):
        pose = np.zeros(0)
    if pose.shape not in ((3, 4), (4, 4)):
        raise InputError(
            f"The `transform_matrix` of {name} is no 3×4 or 4×4 matrix of numbers; correct it."
        )
    pose = np.vstack([pose[:3], [0, 0, 0, 1]]) if len(pose) == 3 else pose
    if not np.isfinite(pose).all():
        raise InputError(
            f"The `transform_matrix` of {name} holds NaN or infinity; correct it or remove the "
            "frame."
        )
    return _rigid(pose, name)


def _rigid(pose: Float[np.ndarray, "4 4"], name: str) -> Float[np.ndarray, "4 4"]:
    rotation = pose[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > MAX_RIGID_ERROR or np.abs(pose[3] - [0, 0, 0, 1]).max() > MAX_RIGID_ERROR:
        raise InputError(
            f"The `transform_matrix` of {name} is not a rigid transform but scaled, sheared or "
            "projective; a rotation and a translation are needed."
        )
    if np.linalg.det(rotation) < 0:
        raise InputError(
            f"The `transform_matrix` of {name} is a reflection (its determinant is negative); a "
            "rotation is needed, so flip one of its axes."
        )
    if error > FLOAT_NOISE:
        u, _, v = np.linalg.svd(rotation)
        rotation = u @ v
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = rotation, pose[:3, 3]
    return rigid


def _intrinsics(entry: Mapping[str, Any], name: str) -> Intrinsics:
    size = _size(entry, name)
    focal = _positive(entry, "fl_x", name), _positive(entry, "fl_y", name)
    angle = _positive(entry, "camera_angle_x", name), _positive(entry, "camera_angle_y", name)
    if not any(focal) and not any(angle):
        raise InputError(
            f"The focal length of {name} is missing; add `fl_x` and `fl_y`, or `camera_angle_x`."
        )
    if any(value is not None and value >= math.pi for value in angle):
        raise InputError(f"The camera angle of {name} is not below π radians; correct it.")
    center = _number(entry, "cx", name), _number(entry, "cy", name)
    return Intrinsics(size, focal, angle, center, _distortion(entry, name))


def _size(entry: Mapping[str, Any], name: str) -> tuple[int, int] | None:
    w, h = _positive(entry, "w", name), _positive(entry, "h", name)
    if w is None or h is None:
        return None
    if w != int(w) or h != int(h):
        raise InputError(
            f"The `w` and `h` of {name} are not whole numbers of pixels; correct them."
        )
    return int(w), int(h)


def _distortion(entry: Mapping[str, Any], name: str) -> Distortion:
    model = entry.get("camera_model")
    if model is None:
        model = "OPENCV_FISHEYE" if entry.get("is_fisheye") else "OPENCV"
    if model not in PERSPECTIVE_MODELS + FISHEYE_MODELS:
        raise InputError(
            f"The camera model {model!r} of {name} is not supported; undistort the images first, "
            f"or use one of {', '.join(PERSPECTIVE_MODELS + FISHEYE_MODELS)}."
        )
    k1, k2, k3, k4 = (_number(entry, key, name) or 0.0 for key in ("k1", "k2", "k3", "k4"))
    p1, p2 = (_number(entry, key, name) or 0.0 for key in ("p1", "p2"))
    if model in FISHEYE_MODELS:
        return Distortion(True, (k1, k2, k3, k4))
    if k4:
        raise InputError(
            f"The coefficient k4 of {name} belongs to fisheye lenses, and its camera model is "
            f"{model}; set it to 0, or undistort the images first."
        )
    return Distortion(False, (k1, k2, k3, 0.0), (p1, p2))


def _number(entry: Mapping[str, Any], key: str, name: str) -> float | None:
    value = entry.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InputError(f"The `{key}` of {name} is {value!r}; a finite number is needed.")
    return float(value)


def _positive(entry: Mapping[str, Any], key: str, name: str) -> float | None:
    value = _number(entry, key, name)
    if value is not None and value <= 0:
        raise InputError(f"The `{key}` of {name} is {value:g}; a positive number is needed.")
    return value


def _text(entry: Mapping[str, Any], key: str, name: str) -> str | None:
    value = entry.get(key)
    if value is not None and (not isinstance(value, str) or not value):
        raise InputError(f"The `{key}` of {name} is {value!r}; the path of a file is needed.")
    return value


def _focal_of(angle: float | None, length: int) -> float | None:
    return None if angle is None else length / 2 / math.tan(angle / 2)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def as_tensor(c2w: Float[np.ndarray, "4 4"]) -> Float[Tensor, "4 4"]:
    """A pose in float32."""
    return torch.from_numpy(c2w).float()
