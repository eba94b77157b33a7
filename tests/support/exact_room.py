"""An exact synthetic room, ray cast in numpy, and writers of it as scenes that users bring.

A box is seen from inside, with two smaller boxes in it. All surfaces have smooth noise as texture,
rich enough for stereo and features. Photographs, z-depths, cameras and points are exact, so that a
completion of it has a known right value. Axes are those of OpenCV: x right, y down, z forward.

Unlike `scenes.py` it needs neither torch nor the package: it cannot share a fault with what it
tests. All that is written is in a folder that the caller names.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

TEXTURE_SIZE = 512
"""Texels along a side of a texture."""
TEXELS_PER_UNIT = 85.0
"""Texels per unit of length of the room."""
OCTAVES = (4, 8, 16, 32, 64, 128)
"""Cells along a side of the grids of random colours that make a texture, coarse to fine."""
N_TEXTURES = 12
ROOM = (np.array([-3.0, -1.6, -2.0]), np.array([3.0, 1.4, 4.0]))
"""Lowest and highest corner of the room."""
BOXES = (
    (np.array([-0.5, 0.2, 1.6]), np.array([0.4, 1.4, 2.4])),
    (np.array([1.2, -0.4, 2.4]), np.array([2.0, 1.4, 3.2])),
)
"""Lowest and highest corners of the boxes in it."""
OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes of nerfstudio, whose y points up and z backward."""

Similarity = tuple[float, Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]
"""Scale s, rotation R and translation t of `s R x + t`, from the room to another frame."""


@dataclass(frozen=True, eq=False)
class ExactCamera:
    """A camera in the room, with a lens of COLMAP's PINHOLE, OPENCV or OPENCV_FISHEYE."""

    c2w: Float[np.ndarray, "4 4"]
    """Camera-to-world, OpenCV axes."""
    width: int = 320
    height: int = 240
    focal: float = 260.0
    """Focal length in pixels, the same along x and y."""
    principal_point: tuple[float, float] | None = None
    """In pixels, with the corner of the first one at 0; None for the middle."""
    model: str = "PINHOLE"
    distortion: tuple[float, ...] = ()
    """k1 k2 p1 p2 of OPENCV, or k1 k2 k3 k4 of OPENCV_FISHEYE."""

    @property
    def parameters(self) -> list[float]:
        """Parameters in the order of COLMAP: fx fy cx cy and the distortion."""
        cx, cy = self.principal_point or (self.width / 2, self.height / 2)
        return [self.focal, self.focal, cx, cy, *self.distortion]

    def compute_rays(self, supersampling: int = 1) -> Float[np.ndarray, "h w 3"]:
        """Compute directions in camera axes through the centres of pixels, or of parts of them."""
        _, _, cx, cy = self.parameters[:4]
        u = (np.arange(self.width * supersampling) + 0.5) / supersampling
        v = (np.arange(self.height * supersampling) + 0.5) / supersampling
        x, y = np.meshgrid((u - cx) / self.focal, (v - cy) / self.focal)
        if self.model == "OPENCV":
            x, y = _undistort_radial(x, y, self.distortion)
        if self.model == "OPENCV_FISHEYE":
            return _undistort_fisheye(x, y, self.distortion)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    @cached_property
    def photograph(self) -> UInt8[np.ndarray, "h w 3"]:
        """The photograph, averaged over four rays per pixel."""
        colours, _ = self._cast(supersampling=2)
        averaged = colours.reshape(self.height, 2, self.width, 2, 3).mean(axis=(1, 3))
        return (averaged.clip(0, 1) * 255 + 0.5).astype(np.uint8)

    @cached_property
    def depth(self) -> Float[np.ndarray, "h w"]:
        """The z-depth at the centres of the pixels."""
        return self._cast(supersampling=1)[1]

    def _cast(
        self, supersampling: int
    ) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
        rays = self.compute_rays(supersampling)
        directions = rays.reshape(-1, 3) @ self.c2w[:3, :3].T
        colours, lengths = cast_rays(self.c2w[:3, 3], directions)
        return colours.reshape(rays.shape), lengths.reshape(rays.shape[:2]) * rays[..., 2]


@dataclass(frozen=True)
class ExactPoint:
    """A point on a surface of the room, and the pixels of the cameras that see it."""

    position: Float[np.ndarray, "3"]
    colour: UInt8[np.ndarray, "3"]
    track: tuple[tuple[int, float, float], ...]
    """Index of a camera and x, y in pixels, for each camera that sees it."""


def make_pose(
    position: Sequence[float], yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0
) -> Float[np.ndarray, "4 4"]:
    """Make a camera-to-world pose; degrees to the right, up and clockwise."""
    y, p, r = np.radians([yaw, pitch, roll])
    turn = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    tilt = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
    spin = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = turn @ tilt @ spin
    pose[:3, 3] = position
    return pose


def make_path(count: int = 8) -> list[Float[np.ndarray, "4 4"]]:
    """Make poses on an arc through the front of the room, which look at its back."""
    return [
        make_pose(
            [1.4 * s, 0.12 * np.sin(3 * s), -1.2 + 0.25 * s * s],
            yaw=-9 * s,
            pitch=3 * np.cos(2 * s),
        )
        for s in np.linspace(-1, 1, count)
    ]


def make_cameras(count: int = 8, **lens: Any) -> list[ExactCamera]:
    """Make cameras along `make_path`; `lens` are fields of `ExactCamera`."""
    return [ExactCamera(pose, **lens) for pose in make_path(count)]


def cast_rays(
    origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Compute the colour that each ray meets, and the distance in lengths of its direction."""
    nearest = np.full(len(directions), np.inf)
    colours = np.zeros((len(directions), 3))
    for number, (low, high) in enumerate((ROOM, *BOXES)):
        is_room = number == 0
        with np.errstate(divide="ignore", invalid="ignore"):
            to_low = (low - origin) / directions
            to_high = (high - origin) / directions
        enter = np.minimum(to_low, to_high)
        leave = np.maximum(to_low, to_high)
        # A box seen from inside is met where the ray leaves it, one from outside where it enters.
        distance = leave.min(axis=1) if is_room else enter.max(axis=1)
        axis = leave.argmin(axis=1) if is_room else enter.argmax(axis=1)
        is_met = (distance > 1e-6) & (distance < nearest)
        if not is_room:
            is_met &= enter.max(axis=1) < leave.min(axis=1)
        points = origin + directions * distance[:, None]
        for a in range(3):
            for side in range(2):
                chosen = is_met & (axis == a) & ((directions[:, a] > 0) == bool(side))
                texture = _make_texture((6 * number + 2 * a + side) % N_TEXTURES)
                # Every coordinate of the room plus 10 is positive.
                uv = np.delete(points[chosen], a, axis=1) + 10
                colours[chosen] = _look_up(texture, uv)
        nearest = np.where(is_met, distance, nearest)
    return colours, nearest


def make_points(cameras: Sequence[ExactCamera], count: int = 1500) -> list[ExactPoint]:
    """Make points on what pinhole cameras see, each in the track of two cameras or more."""
    rng = np.random.default_rng(0)
    rays = [camera.compute_rays() for camera in cameras]
    points = []
    for number in range(count):
        camera = cameras[number % len(cameras)]
        u = int(rng.integers(4, camera.width - 4))
        v = int(rng.integers(4, camera.height - 4))
        ray = rays[number % len(cameras)][v, u]
        local = ray / ray[2] * camera.depth[v, u]
        position = camera.c2w[:3, :3] @ local + camera.c2w[:3, 3]
        pixels = [(index, _project_visible(other, position)) for index, other in enumerate(cameras)]
        track = tuple((index, *pixel) for index, pixel in pixels if pixel is not None)
        if len(track) > 1:
            points.append(ExactPoint(position, camera.photograph[v, u], track))
    return points


def write_photographs(
    folder: Path, cameras: Sequence[ExactCamera], names: Sequence[str] | None = None
) -> list[str]:
    """Write the photographs as `names` in the folder, photo_000.png and so on unless named."""
    names = names or [f"photo_{index:03d}.png" for index in range(len(cameras))]
    for camera, name in zip(cameras, names, strict=True):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(camera.photograph).save(path)
    return list(names)


def write_transforms(
    folder: Path,
    cameras: Sequence[ExactCamera],
    names: Sequence[str] | None = None,
    paths: Sequence[str] | None = None,
    fields: Mapping[str, Any] | None = None,
    frame_fields: Sequence[Mapping[str, Any]] | None = None,
) -> Path:
    """Write a transforms.json of nerfstudio and its photographs.

    `names` are where photographs are written and `paths` what the file calls them, if it differs.
    `fields` are added to the file, and one of `frame_fields` to each of its frames.
    """
    names = names or [f"images/photo_{index:03d}.png" for index in range(len(cameras))]
    write_photographs(folder, cameras, names)
    camera = cameras[0]
    content: dict[str, Any] = dict(
        zip(("fl_x", "fl_y", "cx", "cy"), camera.parameters[:4], strict=True)
    )
    content |= {"w": camera.width, "h": camera.height}
    if camera.model != "PINHOLE":
        keys = ("k1", "k2", "p1", "p2") if camera.model == "OPENCV" else ("k1", "k2", "k3", "k4")
        content |= {"camera_model": camera.model}
        content |= dict(zip(keys, camera.distortion, strict=True))
    content |= dict(fields or {})
    content["frames"] = [
        {"file_path": path, "transform_matrix": (other.c2w @ OPENCV_TO_OPENGL).tolist(), **extra}
        for path, other, extra in zip(
            paths or names, cameras, frame_fields or [{}] * len(cameras), strict=True
        )
    ]
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def write_colmap(
    folder: Path,
    cameras: Sequence[ExactCamera],
    names: Sequence[str] | None = None,
    similarity: Similarity | None = None,
    n_points: int = 1500,
) -> Path:
    """Write a COLMAP text model in sparse/0 and the photographs in images.

    Each photograph has a camera of its own in the model. `similarity` maps the room to the frame
    that is written.
    """
    model = folder / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    names = write_photographs(folder / "images", cameras, names)
    scale, rotation, translation = similarity or (1.0, np.eye(3), np.zeros(3))
    seen: list[list[str]] = [[] for _ in cameras]  # x, y and id of the points of each image
    with (model / "points3D.txt").open("w") as file:
        for number, point in enumerate(make_points(cameras, n_points), start=1):
            elements = []
            for index, x, y in point.track:
                elements += [str(index + 1), str(len(seen[index]))]
                seen[index].append(f"{x:.4f} {y:.4f} {number}")
            position = scale * rotation @ point.position + translation
            values = [*position.tolist(), *point.colour.tolist(), 0.3]  # the error in pixels
            print(number, *values, *elements, file=file)
    with (model / "cameras.txt").open("w") as file:
        for number, camera in enumerate(cameras, start=1):
            print(number, camera.model, camera.width, camera.height, *camera.parameters, file=file)
    with (model / "images.txt").open("w") as file:
        for number, (camera, name) in enumerate(zip(cameras, names, strict=True), start=1):
            world_to_camera = (rotation @ camera.c2w[:3, :3]).T
            centre = scale * rotation @ camera.c2w[:3, 3] + translation
            pose = [*compute_quaternion(world_to_camera), *(-world_to_camera @ centre).tolist()]
            print(number, *pose, number, name, file=file)
            print(*seen[number - 1], file=file)
    return folder


def compute_quaternion(rotation: Float[np.ndarray, "3 3"]) -> list[float]:
    """Compute the wxyz quaternion of a rotation, of any angle (Bar-Itzhack, 2000)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    symmetric = np.array(
        [
            [xx - yy - zz, 0, 0, 0],
            [yx + xy, yy - xx - zz, 0, 0],
            [zx + xz, zy + yz, zz - xx - yy, 0],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    values, vectors = np.linalg.eigh(symmetric)  # reads the lower triangle
    x, y, z, w = vectors[:, values.argmax()].tolist()
    # The eigenvector is of either sign; the real part is positive by convention.
    return [w, x, y, z] if w >= 0 else [-w, -x, -y, -z]


@cache
def _make_texture(seed: int) -> Float[np.ndarray, "size size 3"]:
    """Make noise of all octaves, coarse ones stronger, tinted with a random colour."""
    rng = np.random.default_rng(seed)
    total = np.zeros((TEXTURE_SIZE, TEXTURE_SIZE, 3))
    for cells in OCTAVES:
        grid = Image.fromarray((rng.random((cells, cells, 3)) * 255).astype(np.uint8))
        enlarged = grid.resize((TEXTURE_SIZE, TEXTURE_SIZE), Image.Resampling.BICUBIC)
        total += np.asarray(enlarged) / 255 / cells**0.35
    total -= total.min()
    tint = 0.35 + 0.65 * np.random.default_rng(seed + 50).random(3)
    return total / total.max() * tint


def _look_up(
    texture: Float[np.ndarray, "size size 3"], uv: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    """Interpolate a texture bilinearly at coordinates in units of the room; it repeats."""
    texels = (uv * TEXELS_PER_UNIT) % (TEXTURE_SIZE - 1)
    corner = np.floor(texels).astype(int)
    right, down = (texels - corner)[:, :1], (texels - corner)[:, 1:]
    x, y = corner[:, 0], corner[:, 1]
    upper = texture[y, x] * (1 - right) + texture[y, x + 1] * right
    lower = texture[y + 1, x] * (1 - right) + texture[y + 1, x + 1] * right
    return upper * (1 - down) + lower * down


def _undistort_radial(
    x: Float[np.ndarray, "h w"], y: Float[np.ndarray, "h w"], distortion: Sequence[float]
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Invert the OPENCV lens on normalised coordinates, by fixed-point iteration."""
    k1, k2, p1, p2 = distortion
    a, b = x.copy(), y.copy()
    for _ in range(30):
        r2 = a * a + b * b
        factor = 1 + k1 * r2 + k2 * r2 * r2
        dx = 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
        dy = p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
        a, b = (x - dx) / factor, (y - dy) / factor
    return a, b


def _undistort_fisheye(
    x: Float[np.ndarray, "h w"], y: Float[np.ndarray, "h w"], distortion: Sequence[float]
) -> Float[np.ndarray, "h w 3"]:
    """Invert the OPENCV_FISHEYE lens by Newton's method on the angle; returns unit rays."""
    radius = np.hypot(x, y)
    angle = radius.copy()
    coefficients = np.zeros(10)  # of angle + k1 angle^3 + k2 angle^5 + k3 angle^7 + k4 angle^9
    coefficients[1] = 1
    coefficients[3::2] = distortion
    polynomial = np.polynomial.Polynomial(coefficients)
    for _ in range(40):
        angle = angle - (polynomial(angle) - radius) / polynomial.deriv()(angle)
    scale = np.sin(angle) / np.maximum(radius, 1e-9)
    return np.stack([x * scale, y * scale, np.cos(angle)], axis=-1)


def _project_visible(
    camera: ExactCamera, position: Float[np.ndarray, "3"]
) -> tuple[float, float] | None:
    """Project a point into a pinhole camera; None outside of its image or behind a surface."""
    if camera.model != "PINHOLE":
        raise ValueError("tracks are made for pinhole cameras only")
    x, y, z = camera.c2w[:3, :3].T @ (position - camera.c2w[:3, 3])
    if z <= 0.05:
        return None
    _, _, cx, cy = camera.parameters
    u = camera.focal * x / z + cx
    v = camera.focal * y / z + cy
    if not (1 < u < camera.width - 1 and 1 < v < camera.height - 1):
        return None
    return (u, v) if abs(camera.depth[int(v), int(u)] / z - 1) < 0.01 else None
