"""Rays, projections, rotations, and relations between cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.types import Camera, Gaussians, PaddedCamera

SAME_SURFACE = 0.03
"""Relative distance from a surface within which a Gaussian counts as what is seen of it."""


def unproject(depth: Float[Tensor, "h w"], camera: Camera) -> Float[Tensor, "h w 3"]:
    """Lift z-depths at the pixel centres of `camera` to world points."""
    return camera.center + depth[..., None] * camera.z_rays()


def project(
    points: Float[Tensor, "*shape 3"], camera: Camera
) -> tuple[Float[Tensor, "*shape 2"], Float[Tensor, "*shape"]]:
    """Project world points to pixels (x, y), meaningful for positive z-depth only, and z-depths."""
    camera_points = (points - camera.center) @ camera.c2w[:3, :3]
    z = camera_points[..., 2]
    # Without the absolute value and its bound, points on the camera plane would divide by 0.
    homogeneous = camera_points @ camera.K.T
    return homogeneous[..., :2] / z.abs().clamp_min(torch.finfo(z.dtype).tiny)[..., None], z


def is_inside(
    pixels: Float[Tensor, "*shape 2"], z: Float[Tensor, "*shape"], camera: Camera
) -> Bool[Tensor, "*shape"]:
    """Return True for projected points in front of the camera and within its image."""
    x, y = pixels.unbind(-1)
    return (z > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)


def compute_sparse_depth(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "h w"]:
    """Project points to z-depth in scene units: the nearest per pixel, 0 without one."""
    pixels, z = project(points, camera)
    seen = is_inside(pixels, z, camera)
    x, y = pixels[seen].long().unbind(-1)
    nearest = z.new_full((camera.height * camera.width,), torch.inf)
    nearest = nearest.scatter_reduce(0, y * camera.width + x, z[seen], "amin")
    return nearest.where(nearest.isfinite(), 0.0).view(camera.height, camera.width)


def sample(
    values: Float[Tensor, "h w c"], pixels: Float[Tensor, "*shape 2"], mode: str = "bilinear"
) -> Float[Tensor, "*shape c"]:
    """Sample `values` at pixel coordinates, extending the border.

    `mode` is `bilinear`, `nearest` or `bicubic`, which keeps more of the finest octave and may
    overshoot.
    """
    h, w, c = values.shape
    x, y = pixels.unbind(-1)
    # Divided by numbers, since a tensor of the size would be copied to the GPU in each call.
    grid = (torch.stack([x / w, y / h], dim=-1) * 2 - 1).reshape(1, 1, -1, 2)
    sampled = torch.nn.functional.grid_sample(
        values.permute(2, 0, 1)[None], grid, mode, padding_mode="border", align_corners=False
    )
    return sampled[0, :, 0].T.reshape(*pixels.shape[:-1], c)


def slide(
    gaussians: Gaussians,
    camera: Camera,
    ratio: Float[Tensor, "n"],
    footprint: Literal["constant", "fixed"],
) -> Gaussians:
    """Move Gaussians to `ratio` times their distance from the centre of `camera`.

    With a constant footprint they are scaled about the camera centre, which keeps the image in that
    camera exactly as it was.
    """
    means = camera.center + ratio[:, None] * (gaussians.means - camera.center)
    scales = gaussians.scales * ratio[:, None] if footprint == "constant" else gaussians.scales
    return replace(gaussians, means=means, scales=scales, encoded=None)


def move_to_depths(gaussians: Gaussians, camera: Camera, depths: Float[Tensor, "n"]) -> Gaussians:
    """Move Gaussians along the rays of `camera` to other z-depths, with a constant footprint."""
    return slide(gaussians, camera, depths / compute_z_depths(gaussians.means, camera), "constant")


def compute_z_depths(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n"]:
    """Compute the z-depths of world points in `camera`, in scene units."""
    return (points - camera.center) @ camera.forward


def adapt_to_mode(scene: Gaussians, gaussians: Gaussians, camera: Camera) -> Gaussians:
    """Adapt Gaussians made for the pixels of `camera` to the rendering mode of `scene`.

    Classic rendering widens each splat by the low-pass and keeps its opacity; antialiased rendering
    lowers it. So the low-pass becomes part of the Gaussians' size, with the same total coverage.
    """
    if gaussians.is_antialiased or not scene.is_antialiased:
        return gaussians
    pixel = compute_z_depths(gaussians.means, camera) * 2 / (camera.K[0, 0] + camera.K[1, 1])
    scales = torch.hypot(gaussians.scales, math.sqrt(camera.blur) * pixel[:, None])
    return replace(gaussians, scales=scales, encoded=None, is_antialiased=True)


def measure_rotation(a: Camera, b: Camera) -> float:
    """Compute the angle of the rotation between two cameras, in degrees.

    The arctangent of sine and cosine is exact for small angles; the arccosine of the trace is not.
    """
    relative = (a.on_cpu.c2w[:3, :3].T @ b.on_cpu.c2w[:3, :3]).double()
    cos = (relative.trace() - 1) / 2
    skew = relative - relative.T
    axis = torch.stack([skew[2, 1], skew[0, 2], skew[1, 0]])
    return torch.rad2deg(torch.atan2(axis.norm() / 2, cos)).item()


def measure_baseline(a: Camera, b: Camera) -> float:
    """Compute the distance between the camera centres, in scene units."""
    return (a.on_cpu.center - b.on_cpu.center).norm().item()


def pad_camera(camera: Camera, margin: float) -> PaddedCamera:
    """Pad the image of `camera` on every side by `margin` of its size."""
    return pad_pixels(camera, round(margin * camera.width), round(margin * camera.height))


def pad_pixels(camera: Camera, left: int, top: int) -> PaddedCamera:
    """Pad the image of `camera` by `left` pixels on the left and right, `top` above and below."""
    K = camera.K.clone()
    K[0, 2] += left
    K[1, 2] += top
    padding = (camera.padding[0] + left, camera.padding[1] + top)
    width = camera.width + 2 * left
    height = camera.height + 2 * top
    wide = replace(camera, K=K, width=width, height=height, padding=padding)
    return PaddedCamera(camera, wide, left, top)


def remove_padding(camera: Camera) -> PaddedCamera:
    """Return a camera with padding beside the one without it."""
    left, top = camera.padding
    K = camera.K.clone()
    K[0, 2] -= left
    K[1, 2] -= top
    width = camera.width - 2 * left
    height = camera.height - 2 * top
    inner = replace(camera, K=K, width=width, height=height, padding=(0, 0))
    return PaddedCamera(inner, camera, left, top)


def pad_like(camera: Camera, padded: Camera) -> PaddedCamera:
    """Pad the image of `camera` to the size of `padded`, centred."""
    left = (padded.width - camera.width) // 2
    top = (padded.height - camera.height) // 2
    return pad_pixels(camera, left, top)


def is_same_camera(a: Camera, b: Camera) -> bool:
    """Return True if two cameras see the same image, up to float rounding."""
    a = a.on_cpu
    b = b.on_cpu
    extent = max(a.center.abs().max().item(), b.center.abs().max().item())
    return (
        (a.width, a.height) == (b.width, b.height)
        and torch.allclose(a.K, b.K, rtol=1e-5, atol=1e-4)
        and measure_baseline(a, b) <= 1e-6 * extent
        and measure_rotation(a, b) <= 1e-3
    )


def quats_to_rotations(quats: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 3 3"]:
    """Convert wxyz quaternions of any length but zero to rotation matrices."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    return stack_matrices(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    )


def rotations_to_quats(rotations: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 4"]:
    """Convert rotation matrices to unit wxyz quaternions, by the largest component."""
    # Each row of 4 q qᵀ is the quaternion times four times one of its components; the row of the
    # largest component is the most exact.
    r = rotations.flatten(-2).unbind(-1)
    w = 1 + r[0] + r[4] + r[8]
    x = 1 + r[0] - r[4] - r[8]
    y = 1 - r[0] + r[4] - r[8]
    z = 1 - r[0] - r[4] + r[8]
    a, b, c = r[7] - r[5], r[2] - r[6], r[3] - r[1]
    d, e, f = r[3] + r[1], r[2] + r[6], r[7] + r[5]
    candidates = stack_matrices([w, a, b, c], [a, x, d, e], [b, d, y, f], [c, e, f, z])
    largest = torch.stack([w, x, y, z], dim=-1).argmax(-1)
    best = candidates.take_along_dim(largest[..., None, None], dim=-2)[..., 0, :]
    return torch.nn.functional.normalize(best, dim=-1)


def multiply_quats(
    after: Float[Tensor, "*#n 4"], before: Float[Tensor, "*#n 4"]
) -> Float[Tensor, "*n 4"]:
    """Compose rotations given as wxyz quaternions: first `before`, then `after`."""
    w, x, y, z = after.unbind(-1)
    left = stack_matrices([w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w])
    return (left @ before[..., None])[..., 0]


def axis_angle_to_matrix(axis: Float[Tensor, "3"], angle: float) -> Float[Tensor, "3 3"]:
    """Compute the rotation by `angle` radians about a unit `axis`."""
    real = torch.tensor([math.cos(angle / 2)], dtype=torch.float64, device=axis.device)
    return quats_to_rotations(torch.cat([real, math.sin(angle / 2) * axis.double()])).to(axis)


def slerp_rotation(rotation: Float[Tensor, "3 3"], share: float) -> Float[Tensor, "3 3"]:
    """Scale the angle of a rotation by `share`, taking the shorter way round."""
    quat = rotations_to_quats(rotation.double())
    real, imaginary = (quat if quat[0] >= 0 else -quat).split([1, 3])
    length = imaginary.norm()
    axis = imaginary / length.clamp_min(torch.finfo(length.dtype).tiny)
    return axis_angle_to_matrix(axis, share * 2 * torch.atan2(length, real[0]).item()).to(rotation)


def move_camera(camera: Camera, turn: Float[Tensor, "3 3"], shift: Float[Tensor, "3"]) -> Camera:
    """Rotate a camera by `turn` and shift its centre by `shift`, both in world axes."""
    c2w = camera.c2w.clone()
    c2w[:3, :3] = turn @ camera.c2w[:3, :3]
    c2w[:3, 3] += shift
    return replace(camera, c2w=c2w)


def interpolate_camera(first: Camera, second: Camera, share: float) -> Camera:
    """Move `first` by a `share` in [0, 1] of the way to the pose of `second`."""
    # The rotation, in world axes, that turns the first camera into the second.
    turn = second.c2w[:3, :3].double() @ first.c2w[:3, :3].double().T
    shift = share * (second.center - first.center)
    return move_camera(first, slerp_rotation(turn, share).to(first.c2w), shift)


def stack_matrices(*rows: list[Float[Tensor, "*n"]]) -> Float[Tensor, "*n r c"]:
    """Stack entries, given row by row, to matrices."""
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def compute_field_of_view(camera: Camera) -> tuple[float, float]:
    """Compute the horizontal and vertical field of view in radians."""
    half = torch.tensor([camera.width, camera.height]) / 2 / camera.K.diagonal()[:2].cpu()
    wide, high = (2 * torch.atan(half)).tolist()
    return wide, high


def estimate_up(cameras: Sequence[Camera]) -> Float[Tensor, "3"]:
    """Estimate the unit up direction that most images share."""
    # The direction most like all others is the seed; cameras that are upside down against it are
    # left out of the mean.
    ups = torch.stack([-camera.c2w[:3, 1] for camera in cameras])
    likeness = (ups @ ups.T).sum(dim=1)
    return normalize(ups[(ups @ ups[likeness.argmax()]) > 0].mean(dim=0), dim=0)


def shrink_camera(camera: Camera, side: int) -> Camera:
    """Reduce the image of a camera to at most `side` pixels on its longer side."""
    factor = min(side / max(camera.width, camera.height), 1.0)
    width = max(round(factor * camera.width), 1)
    height = max(round(factor * camera.height), 1)
    return resize_camera(camera, width, height)


def add_near_plane(camera: Camera, points: Float[Tensor, "n 3"]) -> Camera:
    """Add a near plane, relative to the depth of points in front of a camera that has none.

    A scene may have any unit, and their median depth is one. The far plane is left out: no renderer
    uses it.
    """
    z = compute_z_depths(points, camera)
    if camera.near is not None or not (z > 0).any():
        return camera
    return replace(camera, near=0.1 * z[z > 0].median().item(), far=None)


def look_along(camera: Camera, direction: Float[Tensor, "3"], up: Float[Tensor, "3"]) -> Camera:
    """Turn a camera in place to look along a direction, with a level horizon.

    `direction` must not be parallel to `up`; neither needs unit length.
    """
    forward = normalize(direction, dim=0)
    right = normalize(torch.linalg.cross(forward, up), dim=0)
    axes = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
    c2w = camera.c2w.clone()
    c2w[:3, :3] = axes
    return replace(camera, c2w=c2w)


def resize_camera(camera: Camera, width: int, height: int) -> Camera:
    """Change the image size of a camera, in pixels."""
    scales = (width / camera.width, height / camera.height)
    K = torch.tensor([*scales, 1.0]).to(camera.K)[:, None] * camera.K
    # Rounded down, so that something is left of the image within the padding.
    left, top = (int(scale * pad) for scale, pad in zip(scales, camera.padding, strict=True))
    return replace(camera, K=K, width=width, height=height, padding=(left, top))


def measure_distances(cameras: Sequence[Camera], targets: Sequence[Camera]) -> Float[Tensor, "c"]:
    """Measure how far each camera stands from the nearest target, in scene units."""
    # Numbers of a camera on a GPU are copied once.
    places = torch.stack([target.on_cpu.center for target in targets])
    # There may be no camera.
    distances = [
        (places - camera.on_cpu.center.to(places)).norm(dim=-1).min().item() for camera in cameras
    ]
    return torch.tensor(distances, dtype=places.dtype)


def sample_image(small: Camera, large: Camera) -> Camera:
    """Let the image of a small camera sample that of a large one, of the same photograph.

    Gaussians are as wide as in the large image, for which the scene was made. Widened by a pixel of
    the small one instead, those in front would cover what lies beside and behind them (decision
    144).
    """
    focals = [camera.K.diagonal()[:2].double().prod().item() for camera in (small, large)]
    return replace(small, blur=large.blur * min(focals[0] / focals[1], 1.0))


def select_spread_cameras(cameras: Sequence[Camera], count: int) -> list[int]:
    """Select up to `count` cameras that are far apart (farthest point sampling); return indices."""
    where = embed_cameras(cameras)
    apart = (where - where[0]).norm(dim=1)
    # A camera is chosen once, also where others stand in its place.
    weights = torch.ones_like(apart)
    weights[0] = 0.0
    return [0, *select_apart(where, weights, apart, min(count, len(cameras)) - 1)]


def select_apart(
    where: Float[Tensor, "n 6"], weights: Float[Tensor, "n"], apart: Float[Tensor, "n"], count: int
) -> list[int]:
    """Select `count` embedded cameras of large weight that are far from each other.

    `apart` is the distance of each from the nearest one that is known already. At least `count`
    have a weight above 0, and others are not selected.
    """
    chosen: list[int] = []
    weights = weights.clone()
    for _ in range(count):
        # One that stands in the place of another comes last, and before none.
        best = int((weights * apart.clamp_min(1e-30)).argmax())
        chosen.append(best)
        weights[best] = 0.0
        apart = torch.minimum(apart, (where - where[best]).norm(dim=1))
    return chosen


def embed_cameras(cameras: Sequence[Camera]) -> Float[Tensor, "n 6"]:
    """Embed cameras as centres, relative to their extent, and viewing directions."""
    centers = torch.stack([camera.center for camera in cameras])
    # Relative to their middle: distances between them would cancel far from the origin.
    offsets = centers - centers.mean(dim=0)
    extent = offsets.norm(dim=1).max().clamp_min(1e-30)
    return torch.cat([offsets / extent, torch.stack([c.forward for c in cameras])], dim=1)


def compute_spacing(cameras: Sequence[Camera]) -> float:
    """Compute the median distance to the nearest other camera, in scene units."""
    centers = torch.stack([camera.center for camera in cameras]).double()
    apart = (centers[:, None] - centers).norm(dim=-1)
    apart.fill_diagonal_(torch.inf)
    nearest = apart.amin(dim=1)
    return nearest.median().item() if len(cameras) > 1 else 0.0


def find_at_depth(
    gaussians: Gaussians, depth: Float[Tensor, "h w"], camera: Camera
) -> Bool[Tensor, "n"]:
    """Find the Gaussians whose means are on the surfaces at `depth`, z-depth in scene units."""
    surface = look_up(depth, gaussians, camera)
    return (compute_z_depths(gaussians.means, camera) - surface).abs() < SAME_SURFACE * surface


def project_mask(
    mask: Bool[Tensor, "h w"], gaussians: Gaussians, camera: Camera
) -> Bool[Tensor, "n"]:
    """Find Gaussians whose means project into `mask`."""
    return look_up(mask, gaussians, camera)


def look_up(
    values: Shaped[Tensor, "h w"], gaussians: Gaussians, camera: Camera
) -> Shaped[Tensor, "n"]:
    """Look up the value of the pixel that each mean projects to; 0 outside of the image."""
    pixels, z = project(gaussians.means, camera)
    seen = is_inside(pixels, z, camera)
    # Pixels outside must not be looked up; they are (0, 0) here and replaced afterwards.
    x, y = pixels.where(seen[:, None], 0.0).long().unbind(-1)
    looked_up = values[y, x]
    return looked_up.where(seen, torch.zeros_like(looked_up))


def count_outside(gaussians: Gaussians, camera: Camera) -> int:
    """Count the Gaussians outside of an image, such as those in the padding of a target."""
    return len(gaussians) - int(is_inside(*project(gaussians.means, camera), camera).sum())
