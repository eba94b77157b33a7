"""Gaussians transformed to another frame, including view-dependent colour.

The axes of a .ply and of most formats are x right, y down, z forward. SPZ and USD have x right,
y up, z back, which is half a turn about x; glTF has x left, y up, z forward, half a turn about z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.numerics.geometry import multiply_quats, rotations_to_quats
from gscompleter.render.spherical_harmonics import evaluate_sh_basis
from gscompleter.splats.origin import choose_origin, measure_size
from gscompleter.splats.packing import UnsupportedError
from gscompleter.types import Gaussians, Origin, merge

MAX_SIMILARITY_ERROR = 1e-3
"""Largest deviation of the rotation of a file from an orthogonal one."""
HALF_TURN_X = (1.0, -1.0, -1.0)
"""Signs of the axes after half a turn about x."""
HALF_TURN_Z = (-1.0, -1.0, 1.0)
"""Signs of the axes after half a turn about z."""


def rotate_half_turn(gaussians: Gaussians, signs: tuple[float, float, float]) -> Gaussians:
    """Rotate Gaussians by half a turn about an axis; exact, because only signs change."""
    flip = torch.tensor(signs)
    k = gaussians.sh.shape[1]
    # Each SH basis function is even or odd under half a turn: any direction tells its sign.
    direction = torch.nn.functional.normalize(torch.tensor([[0.3, 0.5, 0.7]]), dim=1)
    before = evaluate_sh_basis(direction, k)
    after = evaluate_sh_basis(direction * flip, k)
    return replace(
        gaussians,
        means=gaussians.means * flip,
        # Conjugated by the half-turn: w and the part along its axis stay.
        quats=gaussians.quats * torch.tensor((1.0, *signs)),
        sh=gaussians.sh * (after / before).round().mT,
        origin=_turn_origin(gaussians.origin, signs),
    )


def _turn_origin(origin: Origin | None, signs: tuple[float, float, float]) -> Origin | None:
    if origin is None:
        return None
    x, y, z = (place * sign for place, sign in zip(origin, signs, strict=True))
    return (x, y, z)


def require_similarity(place: Float[Tensor, "4 4"], name: str) -> None:
    """Refuse a transform that mirrors or stretches; sentences call it `name`."""
    # For s R, with s > 0, the determinant is s³ and the product with the transpose s² I.
    linear = place[:3, :3]
    volume = float(torch.linalg.det(linear))
    shape = linear @ linear.T / max(volume, 1e-30) ** (2 / 3)
    identity = torch.eye(3, dtype=place.dtype)
    if not volume > 0 or not torch.allclose(shape, identity, atol=MAX_SIMILARITY_ERROR):
        raise UnsupportedError(f"has a {name} that mirrors Gaussians or stretches them unevenly")


def transform_gaussians(gaussians: Gaussians, similarity: Float[Tensor, "4 4"]) -> Gaussians:
    """Transform Gaussians by a similarity `x' = s R x + t` of the coordinates of their file.

    An origin is turned and scaled with them, and t moves the Gaussians alone.
    """
    origin = gaussians.origin
    if origin is not None:
        linear = similarity[:3, :3].double().cpu()
        x, y, z = (linear @ torch.tensor(origin, dtype=torch.float64)).tolist()
        origin = (x, y, z)
    scale = torch.linalg.det(similarity[:3, :3]) ** (1 / 3)
    rotation = similarity[:3, :3] / scale
    return replace(
        gaussians,
        means=gaussians.means @ similarity[:3, :3].T + similarity[:3, 3],
        quats=multiply_quats(rotations_to_quats(rotation), gaussians.quats),
        scales=gaussians.scales * scale,
        sh=_rotate_sh(gaussians.sh, rotation),
        encoded=None,
        origin=origin,
    )


def place_gaussians(gaussians: Gaussians, place: Float[Tensor, "4 4"]) -> Gaussians:
    """Transform Gaussians by a similarity of float64 whose shift may be too large for float32.

    Such a shift becomes their origin.
    """
    scale = float(torch.linalg.det(place[:3, :3])) ** (1 / 3)
    origin = choose_origin(place[:3, 3].numpy(), scale * measure_size(gaussians))
    if origin is None:
        return transform_gaussians(gaussians, place.float())
    near = place.clone()
    near[:3, 3] -= torch.tensor(origin, dtype=torch.float64)
    return replace(transform_gaussians(gaussians, near.float()), origin=origin)


def merge_placed(parts: Sequence[Gaussians]) -> Gaussians:
    """Merge parts of a file, of which some may have an origin, and others lie near zero."""
    if any(part.origin is not None for part in parts):
        parts = [replace(part, origin=part.origin or (0.0, 0.0, 0.0)) for part in parts]
    return merge(parts)


def _rotate_sh(
    sh: Float[Tensor, "n k 3"], rotation: Float[Tensor, "3 3"]
) -> Float[Tensor, "n k 3"]:
    """Rotate SH by least squares, so that they show along `R d` what `sh` shows along d."""
    k = sh.shape[1]
    generator = torch.Generator().manual_seed(0)
    # 64 directions determine the 16 coefficients of degree 3; each degree maps to itself.
    directions = torch.nn.functional.normalize(
        torch.randn(64, 3, generator=generator, dtype=torch.float64), dim=1
    )
    before = evaluate_sh_basis(directions, k)
    after = evaluate_sh_basis(directions @ rotation.double().T, k)
    # Rounded, since the last bits of the solution differ from call to call.
    matrix = torch.linalg.lstsq(after, before).solution.round(decimals=12)
    return torch.einsum("ij,njc->nic", matrix.to(sh), sh)
