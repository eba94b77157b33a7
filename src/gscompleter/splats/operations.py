"""What `convert` does to Gaussians on the way: choose, scale, turn, move, and reduce.

In this order, whatever the order on the command line: bands of harmonics, box and sphere (in the
coordinates of the input), similarity, number. All numbers are in the axes of a .ply: x right,
y down, z forward.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.render.lod import merge_nearby
from gscompleter.splats.morton import sort_along_morton
from gscompleter.splats.origin import choose_origin, measure_size
from gscompleter.splats.transform import place_gaussians
from gscompleter.system.errors import InputError
from gscompleter.types import NUM_SH, Gaussians


@dataclass(frozen=True)
class Operations:
    """What is done to a splat; by default nothing."""

    bands: int | None = None
    """Highest degree of harmonics that is kept."""
    box: tuple[float, ...] | None = None
    """Two corners of a box, outside of which Gaussians go, by their centres."""
    sphere: tuple[float, ...] | None = None
    """Centre and radius of a sphere, likewise."""
    scale: float = 1.0
    rotate: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Degrees about the axes x, then y, then z of the file."""
    translate: tuple[float, ...] = (0.0, 0.0, 0.0)
    decimate: float | int | None = None
    """Number of Gaussians that are kept, or if it is a float the share."""

    def __post_init__(self) -> None:
        """Raise InputError for numbers that mean nothing."""
        groups = {
            "crop_box": self.box or (),
            "crop_sphere": self.sphere or (),
            "scale": (self.scale,),
            "rotate": self.rotate,
            "translate": self.translate,
        }
        for name, numbers in groups.items():
            if not all(math.isfinite(number) for number in numbers):
                raise InputError("A number is needed, and none that is infinite.", name)
        if self.box is not None and any(
            low >= high for low, high in zip(self.box[:3], self.box[3:], strict=True)
        ):
            raise InputError(
                "A box needs its smallest x, y and z, and then its largest ones.", "crop_box"
            )
        if self.sphere is not None and self.sphere[3] <= 0:
            raise InputError("A sphere needs a centre and a positive radius.", "crop_sphere")
        if self.decimate is not None and not self.decimate > 0:
            raise InputError("Some Gaussians have to be left: a number or a share.", "decimate")
        if self.scale <= 0:
            raise InputError("A scale has to be above 0; what is mirrored is no splat.", "scale")

    @property
    def similarity(self) -> Float[Tensor, "4 4"] | None:
        """The transform `x' = s R x + t`; None if everything stays in its place."""
        if (self.scale, *self.rotate, *self.translate) == (1.0, *[0.0] * 6):
            return None
        place = torch.eye(4, dtype=torch.float64)
        place[:3, :3] = self.scale * make_rotation(self.rotate)
        place[:3, 3] = torch.tensor(self.translate, dtype=torch.float64)
        return place

    @property
    def is_by_rows(self) -> bool:
        """True if each Gaussian is treated alone, so that some can be in memory at a time."""
        return self.decimate is None

    @property
    def changes(self) -> bool:
        """True if anything is done."""
        return self != Operations()

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """Apply all of them."""
        done = self.apply_to_rows(gaussians)
        if self.decimate is None or len(done) == 0:
            return done
        is_share = isinstance(self.decimate, float)
        count = round(self.decimate * len(done)) if is_share else int(self.decimate)
        return reduce_number(done, max(count, 1))

    def apply_to_rows(self, gaussians: Gaussians) -> Gaussians:
        """Apply those that treat each Gaussian alone."""
        if self.bands is not None and self.bands < gaussians.sh_degree:
            gaussians = replace(gaussians, sh=gaussians.sh[:, : NUM_SH[self.bands]].contiguous())
        if self.box is not None or self.sphere is not None:
            gaussians = gaussians[self._find_inside(gaussians)]
        similarity = self.similarity
        if similarity is None:
            return gaussians
        # Coordinates of maps are too large for float32: the origin moves with the Gaussians.
        place = similarity.clone()
        if gaussians.origin is not None:
            place[:3, 3] += place[:3, :3] @ torch.tensor(gaussians.origin, dtype=torch.float64)
        gaussians = replace(gaussians, origin=None)
        if any(self.rotate):
            return place_gaussians(gaussians, place)
        # Rotations and colours by direction stay bit for bit what they are, and sizes, too, if
        # nothing is scaled.
        origin = choose_origin(place[:3, 3].numpy(), self.scale * measure_size(gaussians))
        shift = place[:3, 3] - torch.tensor(origin or (0, 0, 0), dtype=torch.float64)
        means = gaussians.means.double() * self.scale + shift
        return replace(
            gaussians,
            means=means.to(gaussians.means.dtype),
            scales=gaussians.scales * self.scale,
            encoded=gaussians.encoded if self.scale == 1 else None,
            origin=origin,
        )

    def _find_inside(self, gaussians: Gaussians) -> Bool[Tensor, "n"]:
        means = gaussians.means.double()
        means = means + torch.tensor(gaussians.origin or (0, 0, 0), dtype=torch.float64)
        inside = torch.ones_like(means[:, 0], dtype=torch.bool)
        if self.box is not None:
            low, high = means.new_tensor(self.box[:3]), means.new_tensor(self.box[3:])
            inside &= ((means >= low) & (means <= high)).all(dim=1)
        if self.sphere is not None:
            center = means.new_tensor(self.sphere[:3])
            inside &= (means - center).norm(dim=1) <= self.sphere[3]
        return inside


def make_rotation(degrees: Sequence[float]) -> Float[Tensor, "3 3"]:
    """Make the rotation about x, then y, then z, by angles in degrees."""
    rotation = torch.eye(3, dtype=torch.float64)
    for axis, angle in enumerate(degrees):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        # Exact for quarter turns, whose cosine is not.
        quarter = {0.0: (1.0, 0.0), 90.0: (0.0, 1.0), 180.0: (-1.0, 0.0), 270.0: (0.0, -1.0)}
        radians = math.radians(angle)
        cosine, sine = quarter.get(angle % 360, (math.cos(radians), math.sin(radians)))
        turn = torch.eye(3, dtype=torch.float64)
        turn[first, first] = turn[second, second] = cosine
        turn[second, first] = sine
        turn[first, second] = -sine
        rotation = turn @ rotation
    return rotation


def reduce_number(gaussians: Gaussians, count: int) -> Gaussians:
    """Merge neighbours until about `count` Gaussians are left, in the order of a Morton curve."""
    if count >= len(gaussians):
        return gaussians
    return merge_nearby(sort_along_morton(replace(gaussians, encoded=None)), count)
