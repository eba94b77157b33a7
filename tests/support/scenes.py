"""Small synthetic rooms of known geometry, rendered by ray casting.

A room is a box seen from inside, with smaller boxes in it. Every surface has a texture that is a
fixed function of the world point, so that all views agree on colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import plyfile
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.data.scene import write_cameras
from gscompleter.generators import GeneratorOutput, GeneratorRequest, as_generator
from gscompleter.splats.ply import save_ply
from gscompleter.system.files.image import write_image
from gscompleter.types import (
    Camera,
    DepthMap,
    Gaussians,
    Reconstruction,
    View,
    make_observed,
    merge,
    sh_from_rgb,
)


@dataclass(frozen=True)
class Room:
    """Axis-aligned boxes [low, high]; the first is seen from inside, the others from outside."""

    boxes: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = (
        ((-3.0, -1.5, -1.0), (3.0, 1.5, 5.0)),
        ((-0.5, 0.3, 2.2), (0.3, 1.5, 3.0)),
        ((0.9, -0.2, 3.2), (1.5, 1.5, 3.8)),
    )
    unit: float = 1.0
    """Factor of all lengths."""


def camera_at(
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.0,
    yaw: float = 0.0,
    *,
    size: int = 96,
    focal: float = 0.9,
    unit: float = 1.0,
) -> Camera:
    """Make a square camera at (x, y, z), turned by `yaw` degrees about the downward axis.

    `focal` is in image widths; near and far enclose the default room.
    """
    angle = torch.deg2rad(torch.tensor(yaw, dtype=torch.float64))
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[0, 0] = c2w[2, 2] = angle.cos()
    c2w[0, 2], c2w[2, 0] = angle.sin(), -angle.sin()
    c2w[:3, 3] = torch.tensor([x, y, z]) * unit
    K = torch.tensor([[focal * size, 0.0, size / 2], [0.0, focal * size, size / 2], [0, 0, 1]])
    return Camera(c2w.float(), K.float(), size, size, near=0.5 * unit, far=20.0 * unit)


def unchecked(camera: Camera, **changes: object) -> Camera:
    """Change a camera into one that its constructor refuses."""
    other = copy(camera)
    vars(other).update(changes)
    return other


def texture(points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Compute the colour of world points: waves of several lengths and directions, for stereo."""
    generator = torch.Generator().manual_seed(7)
    colour = torch.full_like(points, 0.5)
    for wavelength, strength in ((2.5, 0.16), (1.0, 0.10), (0.45, 0.08), (0.22, 0.06)):
        for _ in range(3):
            direction = torch.randn(3, generator=generator).to(points)
            direction = direction / direction.norm() * (6.2832 / wavelength)
            phase = torch.rand(3, generator=generator).to(points) * 6.2832
            colour = colour + strength * torch.sin((points @ direction)[..., None] + phase)
    return colour.clamp(0, 1)


MOST_CASTS = 300
"""Images that are kept; those of 64 x 64 pixels take 20 MB."""
casts: dict[tuple[object, ...], tuple[Tensor, Tensor]] = {}
"""Images and depths by the room and the camera, as many tests photograph the same."""


def cast(room: Room, camera: Camera) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Compute the true image and z-depth at the pixel centres."""
    # Another camera, such as one with a lens, may have other rays.
    if type(camera) is not Camera or camera.K.device.type != "cpu":
        return cast_rays(room, camera.center.double(), camera.z_rays().double())
    numbers = [value for matrix in (camera.c2w, camera.K) for value in matrix.flatten().tolist()]
    key = (room, camera.K.dtype, camera.width, camera.height, *numbers)
    if key not in casts:
        if len(casts) == MOST_CASTS:
            casts.pop(next(iter(casts)))
        casts[key] = cast_rays(room, camera.center.double(), camera.z_rays().double())
    # Some tests change what they get.
    image, depth = casts[key]
    return image.clone(), depth.clone()


def cast_rays(
    room: Room, origin: Float[Tensor, "3"], z_rays: Float[Tensor, "h w 3"]
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Compute colours and depths along rays, in multiples of their lengths."""
    depth = torch.full(z_rays.shape[:2], torch.inf, dtype=torch.float64)
    for index, (low, high) in enumerate(room.boxes):
        low_t = torch.tensor(low, dtype=torch.float64) * room.unit
        high_t = torch.tensor(high, dtype=torch.float64) * room.unit
        to_low, to_high = (low_t - origin) / z_rays, (high_t - origin) / z_rays
        enter = torch.minimum(to_low, to_high).nan_to_num(-torch.inf).amax(-1)
        leave = torch.maximum(to_low, to_high).nan_to_num(torch.inf).amin(-1)
        hit = leave if index == 0 else enter.where((enter < leave) & (enter > 0), torch.inf)
        depth = torch.minimum(depth, hit)
    points = (origin + depth[..., None] * z_rays) / room.unit
    return texture(points).float(), depth.float()


def view_of(room: Room, camera: Camera, frame: int | None = None) -> View:
    """Take a photograph of the room, with its true depth."""
    image, depth = cast(room, camera)
    return View(image, camera, frame, depth)


def photographed(folder: Path, cameras: Sequence[Camera], room: Room = Room()) -> Path:
    """Write a scene folder: a photograph of the room by each camera, and a transforms.json."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{number}.png" for number in range(len(cameras))]
    for name, camera in zip(names, cameras, strict=True):
        write_image(folder / name, view_of(room, camera).image)
    write_cameras(folder / "transforms.json", cameras, names)
    return folder


def gaussians_of(view: View, depth: Float[Tensor, "h w"] | None = None) -> Gaussians:
    """Make one round, nearly opaque Gaussian per pixel at its true (or the given) z-depth."""
    camera = view.camera
    depth = view.depth if depth is None else depth
    assert depth is not None
    means = (camera.center + depth[..., None] * camera.z_rays()).reshape(-1, 3)
    n = len(means)
    return make_observed(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        scales=(0.6 * depth / camera.K[0, 0]).reshape(-1, 1).repeat(1, 3),
        opacities=torch.full((n,), 0.95),
        sh=sh_from_rgb(view.image.reshape(-1, 3)),
    )


def room_without_a_box(cameras: Sequence[Camera], room: Room = Room()) -> Gaussians:
    """Make the Gaussians that these cameras see of a room, without what stands near its middle."""
    whole = merge([gaussians_of(view_of(room, camera)) for camera in cameras])
    low, high = torch.tensor(room.boxes[1])
    is_gone = ((whole.means > low - 0.05) & (whole.means < high + 0.05)).all(dim=1)
    return whole[~is_gone]


def half_a_room_of(room: Room, camera: Camera) -> tuple[View, Gaussians, Gaussians]:
    """Return a view, a context that lacks the right half of the room, and the right half."""
    view = view_of(room, camera)
    right = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    right[:, camera.width // 2 :] = True
    gaussians = gaussians_of(view)
    return view, gaussians[~right.flatten()], gaussians[right.flatten()]


def reconstruction_of(
    views: Sequence[View], depths: Sequence[Float[Tensor, "h w"]]
) -> Reconstruction:
    """Return the output of a pixel-aligned Ψ that finds these depths."""
    parts = [gaussians_of(v, d) for v, d in zip(views, depths, strict=True)]
    return Reconstruction(
        merge(parts),
        tuple(DepthMap(d, torch.ones_like(d, dtype=torch.bool)) for d in depths),
        torch.cat([torch.full((d.numel(),), i) for i, d in enumerate(depths)]),
        torch.cat([torch.arange(d.numel()) for d in depths]),
    )


def labelled(path: Path, scene: Gaussians) -> Path:
    """Write the scene as another program does: with a column that numbers the rows."""
    save_ply(path, scene)
    vertex = plyfile.PlyData.read(str(path))["vertex"].data
    rows = np.zeros(len(vertex), [("label", "<i4"), *vertex.dtype.descr])
    for name in vertex.dtype.names:
        rows[name] = vertex[name]
    rows["label"] = np.arange(len(rows))
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(path))
    return path


def random_gaussians(n: int, seed: int = 0, sh_degree: int = 0) -> Gaussians:
    """Make n Gaussians of every shape in front of (and around) `camera_at()`."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator)

    means = torch.stack([uniform(n) * 4 - 2, uniform(n) * 4 - 2, uniform(n) * 4 + 1], dim=-1)
    return make_observed(
        means=means,
        quats=torch.randn(n, 4, generator=generator),
        scales=torch.exp(uniform(n, 3) * 3 - 5),
        opacities=uniform(n) * 0.95 + 0.02,
        sh=torch.randn(n, (sh_degree + 1) ** 2, 3, generator=generator) * 0.4,
    )


def scaled(gaussians: Gaussians, factor: float) -> Gaussians:
    """Scale Gaussians to another unit of length."""
    return replace(
        gaussians,
        means=gaussians.means * factor,
        scales=gaussians.scales * factor,
        encoded=None,
    )


def answer(phi, nearest, target, context) -> GeneratorOutput:
    """Return the output of a generator, or a plain function, for one request."""
    return as_generator(phi).synthesize([GeneratorRequest(nearest, target, context)])[0]


def open_street(camera: Camera) -> View:
    """Return a street under a clear sky: ground and two rows of houses.

    The depth of the sky is infinite.
    """
    origin, rays = camera.center.double(), camera.z_rays().double()
    down = rays[..., 1]
    depth = ((1.5 - origin[1]) / down).where(down > 0, torch.inf)
    for number in range(12):
        start = 3.0 + 2.5 * number
        for side in (-1.0, 1.0):
            x = side * (2.0 + 0.5 * ((number * 7) % 3))
            low = torch.tensor([min(x, 2 * x), -0.5 - 0.7 * ((number * 5) % 4), start]).double()
            high = torch.tensor([max(x, 2 * x), 1.5, start + 1.6]).double()
            to_low, to_high = (low - origin) / rays, (high - origin) / rays
            enter = torch.minimum(to_low, to_high).nan_to_num(-torch.inf).amax(-1)
            leave = torch.maximum(to_low, to_high).nan_to_num(torch.inf).amin(-1)
            depth = torch.minimum(depth, enter.where((enter < leave) & (enter > 0), torch.inf))
    sky = torch.isinf(depth)
    points = origin + depth.where(~sky, 1.0)[..., None] * rays
    above = torch.nn.functional.normalize(rays, dim=-1)[..., 1:2]
    heaven = torch.tensor([0.75, 0.85, 0.95]) + 0.1 * above
    image = torch.where(sky[..., None], heaven, 0.8 * texture(points))
    return View(image.float(), camera, depth=depth.float())
