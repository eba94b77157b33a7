"""Objects and scenes of flat surfaces, each of Gaussians that cover it."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.types import Gaussians, make_observed

Face = tuple[int, int]
"""Axis and side of a face of a box."""
ALL_FACES: tuple[Face, ...] = tuple((axis, side) for axis in range(3) for side in (-1, 1))
FLOOR: Face = (1, 1)
"""The lowest face, since y is down."""
CEILING: Face = (1, -1)
Z_UP = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Turn from y down to z up."""
Y_UP = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
"""Turn from y down to y up."""


def box(
    center: Sequence[float],
    half: Sequence[float],
    step: float,
    faces: Sequence[Face] = ALL_FACES,
) -> Float[Tensor, "n 3"]:
    """Sample the faces of a box at even steps."""
    parts = []
    for axis, side in faces:
        first, second = (other for other in range(3) if other != axis)
        u = torch.arange(-half[first], half[first] + 1e-6, step)
        v = torch.arange(-half[second], half[second] + 1e-6, step)
        points = torch.zeros(len(u), len(v), 3)
        points[..., axis] = side * half[axis]
        points[..., first] = u[:, None]
        points[..., second] = v
        parts.append(points.reshape(-1, 3))
    return torch.cat(parts) + torch.tensor(center)


def ball(center: Sequence[float], radii: Sequence[float], step: float) -> Float[Tensor, "n 3"]:
    """Sample an ellipsoid evenly, along a spiral."""
    count = round(4 * torch.pi * (sum(radii) / 3) ** 2 / step**2)
    index = torch.arange(count) + 0.5
    polar = torch.acos(1 - 2 * index / count)
    azimuth = torch.pi * (1 + 5**0.5) * index
    x = azimuth.cos() * polar.sin()
    z = azimuth.sin() * polar.sin()
    return torch.stack([x, polar.cos(), z], dim=1) * torch.tensor(radii) + torch.tensor(center)


def cover(parts: Sequence[Float[Tensor, "n 3"]], step: float, opacity: float = 0.98) -> Gaussians:
    """Cover points that are `step` apart with round Gaussians, checkered in colour."""
    means = torch.cat(list(parts))
    checks = (means / (8 * step)).floor().sum(dim=1) % 2
    sh = (checks[:, None, None] - 0.5) * torch.tensor([1.0, 0.6, 0.3])
    count = len(means)
    return make_observed(
        means,
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), 0.7 * step),
        torch.full((count,), opacity),
        sh,
    )


def chair(step: float = 0.02) -> Gaussians:
    """Make a chair with two arms."""
    parts = [
        box((0, 0, 0), (0.25, 0.02, 0.25), step),
        box((0, -0.27, 0.24), (0.25, 0.25, 0.02), step),
    ]
    for x in (-1, 1):
        parts.append(box((0.28 * x, -0.12, 0), (0.02, 0.02, 0.26), step))
        parts += [box((0.23 * x, 0.25, 0.23 * z), (0.02, 0.23, 0.02), step) for z in (-1, 1)]
    return cover(parts, step)


def person(step: float = 0.03) -> Gaussians:
    """Make a person with arms held out."""
    parts = [
        ball((0, -0.75, 0), (0.11, 0.14, 0.12), step),
        ball((0, -0.3, 0), (0.2, 0.33, 0.13), step),
    ]
    for x in (-1, 1):
        parts.append(ball((0.45 * x, -0.5, 0), (0.3, 0.05, 0.05), step))
        parts.append(ball((0.11 * x, 0.4, 0), (0.08, 0.45, 0.08), step))
    return cover(parts, step)


def armchair(step: float = 0.03) -> Gaussians:
    """Make an armchair: a seat between a back and two sides."""
    parts = [
        box((0, 0.1, 0), (0.35, 0.15, 0.35), step),
        box((0, -0.25, 0.4), (0.45, 0.5, 0.1), step),
    ]
    parts += [box((0.42 * x, -0.05, 0), (0.08, 0.3, 0.4), step) for x in (-1, 1)]
    return cover(parts, step)


def table(step: float = 0.03) -> Gaussians:
    """Make a table."""
    legs = [(0.7 * x, 0.0, 0.4 * z) for x in (-1, 1) for z in (-1, 1)]
    top = box((0, -0.35, 0), (0.8, 0.03, 0.5), step)
    return cover([top, *(box(leg, (0.04, 0.35, 0.04), step) for leg in legs)], step)


def figure_on_disc(step: float = 0.03) -> Gaussians:
    """Make a figure on a disc."""
    disc = box((0, 0.7, 0), (0.6, 0.0, 0.6), step, [FLOOR])
    disc = disc[disc[:, [0, 2]].norm(dim=1) < 0.6]
    return cover([disc, ball((0, 0, 0), (0.3, 0.7, 0.3), step)], step)


def stone(step: float = 0.04) -> Gaussians:
    """Make a stone."""
    return cover([ball((0, 0, 0), (0.5, 0.4, 0.6), step)], step)


def room(faces: Sequence[Face], half: Sequence[float] = (2.0, 1.2, 2.0)) -> Gaussians:
    """Make a room of some faces of a box, with two pieces of furniture on its floor."""
    step = 0.06
    parts = [box((0, 0, 0), half, step, faces), box((-0.8, 0.8, 1.0), (0.4, 0.4, 0.3), step)]
    return cover([*parts, box((0.7, 0.6, -0.6), (0.3, 0.6, 0.3), step)], step)


def garden() -> Gaussians:
    """Make open ground with trees."""
    step = 0.1
    places = [(-3.0, -2.0), (-1.0, 2.5), (1.5, -0.5), (3.0, 3.0), (2.5, -3.0), (-3.5, 1.0)]
    parts = [box((0, 1, 0), (5.0, 0.0, 5.0), step, [FLOOR])]
    parts += [ball((x, 0.2, z), (0.12, 0.8, 0.12), step) for x, z in places]
    parts += [ball((x, -0.9, z), (0.6, 0.5, 0.6), step) for x, z in places]
    return cover(parts, step)


def street() -> Gaussians:
    """Make a street between two rows of houses."""
    step = 0.12
    houses = [(4.0 * x, -1.2, z) for x in (-1, 1) for z in (2.0, 7.0, 12.0, 17.0)]
    ground = box((0, 1, 10), (3.0, 0.0, 10.0), step, [FLOOR])
    return cover([ground, *(box(house, (1.0, 2.2, 2.0), step) for house in houses)], step)
