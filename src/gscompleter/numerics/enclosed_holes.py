"""Holes in an object that stands on nothing (not in the paper).

Around an object everything is empty, and nothing of it is missing. A connected part of the empty
pixels is a hole only if the object encloses it, its border lies on one smooth surface, the object
surrounds it thickly, and it is a hole from other sides, too. A gap between an arm and the body
fails one of these; a hole that was cut into a surface passes them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import (
    axis_angle_to_matrix,
    is_inside,
    project,
    sample,
    shrink_camera,
    unproject,
)
from gscompleter.numerics.image_ops import dilate, fill_smoothly, is_enclosed, label_regions
from gscompleter.types import Camera, Render

ENCLOSURE_SIDE = 224
"""Longer side, in pixels, of the images from other sides."""
MIN_PART_PIXELS = 12
"""Pixels of the smallest part that can be judged; smaller ones stay empty."""
OBJECT_ALPHA = 0.9
"""Alpha from which a pixel beside a hole counts as the object."""
HOLE_BORDER = 0.02
"""Width of the border of a hole, relative to the longer side of the image."""
MIN_BORDER_PIXELS = 12
"""Fewest opaque pixels in the border that a surface is fitted to."""
MAX_ROUGHNESS = 0.02
"""Largest relative deviation of the border's inverse depths from one quadric, as a quantile."""
ROUGHNESS_QUANTILE = 0.8
MIN_THICKNESS = 0.62
"""Least share of opaque pixels at three to four border widths around a hole."""
MIN_OPEN_ELSEWHERE = 0.3
"""Least share of a plug in the hole that other sides see in holes."""
TURNS = (-45.0, 45.0)
"""Other sides: turns about the middle of the hole, in degrees. From far aside, all of a plug
lies on the object behind it."""
MIN_IN_IMAGE = 0.5
"""Least share of the plug that must lie in the image of another side for it to count."""
MIN_UNHIDDEN = 0.2
"""Least share of these that no surface may hide."""
HIDING = 0.98
"""Depth of a surface, relative to the plug, before which it hides the plug."""


def keep_enclosed(
    empty: Bool[Tensor, "h w"],
    render: Render,
    camera: Camera,
    render_at: Callable[[Camera], Render],
) -> Bool[Tensor, "h w"]:
    """Keep the parts of `empty` that are holes in an object; `render` shows it at `camera`.

    `render_at` renders it at other cameras.
    """
    kept = torch.zeros_like(empty)
    labels, count = label_regions(empty)
    for label in range(1, count):
        part = labels == label
        if is_hole_in_object(part, render, camera, render_at):
            kept |= part
    return kept


def is_hole_in_object(
    part: Bool[Tensor, "h w"],
    render: Render,
    camera: Camera,
    render_at: Callable[[Camera], Render],
) -> bool:
    """Judge one connected part of the empty pixels; the cheap criteria come first."""
    if not is_enclosed(part) or int(part.sum()) < MIN_PART_PIXELS:
        return False
    opaque = render.alpha >= OBJECT_ALPHA
    width = max(3, round(HOLE_BORDER * max(part.shape)))
    beside = dilate(part, 1)
    border = dilate(part, width + 1) & ~beside & opaque
    if int(border.sum()) < MIN_BORDER_PIXELS:
        return False
    if measure_roughness(render.depth, border) > MAX_ROUGHNESS:
        return False
    around = dilate(part, 4 * width) & ~dilate(part, 3 * width)
    if not around.any() or opaque[around].float().mean().item() < MIN_THICKNESS:
        return False

    # A plug at the depth that continues the border: where other sides look at it through a hole,
    # the surface is missing.
    depth = fill_smoothly(render.depth.where(border, 0.0), border)
    plug = unproject(depth, camera)[part]
    shares = [
        measure_open_share(plug, other, render_at(other)) for other in turn_around(camera, plug)
    ]
    known = [share for share in shares if share is not None]
    return bool(known) and sum(known) / len(known) >= MIN_OPEN_ELSEWHERE


def measure_roughness(depth: Float[Tensor, "h w"], border: Bool[Tensor, "h w"]) -> float:
    """Measure how far the inverse depths of border pixels are from one quadric, relative to them.

    A plane has an inverse depth that is linear in the pixel.
    """
    y, x = border.nonzero().to(depth).T / max(border.shape)
    x = x - x.mean()
    y = y - y.mean()
    inverse = (1 / depth[border].double()).unsqueeze(1)
    terms = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=1).double()
    solution = torch.linalg.lstsq(terms, inverse).solution
    deviation = ((terms @ solution - inverse).abs() / inverse)[:, 0]
    return deviation.quantile(ROUGHNESS_QUANTILE).item()


def turn_around(camera: Camera, plug: Float[Tensor, "n 3"]) -> Iterator[Camera]:
    """Turn a small camera about the middle of a plug, about its own vertical axis."""
    small = shrink_camera(camera, ENCLOSURE_SIDE)
    middle = plug.mean(dim=0)
    for degrees in TURNS:
        turn = axis_angle_to_matrix(camera.c2w[:3, 1], math.radians(degrees))
        yield move_about(small, turn, middle)


def move_about(camera: Camera, turn: Float[Tensor, "3 3"], pivot: Float[Tensor, "3"]) -> Camera:
    """Turn a camera about a point."""
    c2w = camera.c2w.clone()
    c2w[:3, :3] = turn @ camera.c2w[:3, :3]
    c2w[:3, 3] = pivot + turn @ (camera.center - pivot)
    return replace(camera, c2w=c2w)


def measure_open_share(plug: Float[Tensor, "n 3"], camera: Camera, render: Render) -> float | None:
    """Measure the share of a plug that a camera sees in holes; None if it sees too little of it."""
    pixels, z = project(plug, camera)
    inside = is_inside(pixels, z, camera)
    if inside.float().mean().item() < MIN_IN_IMAGE:
        return None
    surface = sample(torch.stack([render.depth, render.alpha], dim=-1), pixels[inside])
    is_open = surface[:, 1] < COVERED
    hidden = ~is_open & (surface[:, 0] < HIDING * z[inside])
    if (~hidden).float().mean().item() < MIN_UNHIDDEN:
        return None
    return is_open.float().mean().item()
