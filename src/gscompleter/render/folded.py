"""New Gaussians in a frozen scene that keep their place: all that is frozen is folded once.

Of a pixel only what is new in it is left, its fragments, and between two of them one colour and one
transmittance of all that is frozen there. So a drawing costs what is new, however much is frozen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from numpy import ndarray
from torch import Tensor
from torch.autograd.function import once_differentiable

from gscompleter.kernels import lists
from gscompleter.kernels import rasterizer as kernels
from gscompleter.kernels.rasterizer import Fragments

if TYPE_CHECKING:
    from gscompleter.render.cpu import Binned, CpuView, Viewpoint


@dataclass(frozen=True)
class Folded:
    """New Gaussians of which only opacities and colours change, in a frozen scene."""

    viewpoint: Viewpoint
    image: Float32[ndarray, "h w 3"]
    """The frozen scene alone."""
    binned: Binned
    means: Float32[ndarray, "n 3"]
    fragments: Fragments
    solid: Float32[ndarray, "solid 9"]
    """The frozen splats that have fragments, as `Layer` has them."""

    def __call__(
        self, opacities: Float[Tensor, "n"], sh: Float[Tensor, "n k 3"]
    ) -> Float[Tensor, "h w 3"]:
        """The image; differentiable."""
        image: Tensor = _Drawn.apply(self, opacities, sh)
        return image

    @cached_property
    def shown(self) -> Int64[ndarray, "shown"]:
        """Which of the Gaussians have fragments."""
        named = np.zeros(len(self.means), np.bool_)
        named[self.fragments.names[self.fragments.names >= 0]] = True
        return np.flatnonzero(named)

    def colours(self, sh: Float32[ndarray, "n k 3"]) -> Float32[ndarray, "n 3"]:
        """As the camera sees them; of those that it does not see, anything."""
        colours = np.empty((len(sh), 3), np.float32)
        seen = (self.shown, self.viewpoint.pinhole.center, self.means)
        self.viewpoint.share(kernels.shade, len(self.shown), *seen, sh, colours)
        return colours

    def draw(
        self, opacities: Float32[ndarray, "n"], colours: Float32[ndarray, "n 3"]
    ) -> Float32[ndarray, "h w 3"]:
        """The frozen image, drawn anew where it has fragments."""
        image = self.image.copy()
        drawn = (self.fragments, self.solid, opacities, colours, image)
        count = len(self.fragments.tiles)
        self.viewpoint.share(kernels.draw_fragments, count, *drawn)
        return image

    def slopes(
        self,
        opacities: Float32[ndarray, "n"],
        colours: Float32[ndarray, "n 3"],
        image: Float32[ndarray, "h w 3"],
        d_image: Float32[ndarray, "h w 3"],
    ) -> Float32[ndarray, "n 4"]:
        """Of opacities and colours, from those of the image."""
        values = np.empty((len(self.binned.slots), 4), np.float32)
        written = np.zeros(len(values), np.bool_)
        drawn = (self.fragments, self.solid, opacities, colours, image, d_image)
        count = len(self.fragments.tiles)
        received = (values, written)
        self.viewpoint.share(kernels.draw_fragments_backward, count, *drawn, *received)
        return self.viewpoint.sums(self.binned, received)

    def slopes_of_sh(
        self, colours: Float32[ndarray, "n 3"], slopes: Float32[ndarray, "n 3"], bands: int
    ) -> Float32[ndarray, "n k 3"]:
        """Of spherical harmonics, from those of colours."""
        d_sh = np.zeros((len(colours), bands, 3), np.float32)
        seen = (self.shown, self.viewpoint.pinhole.center, self.means)
        received = (colours, slopes, d_sh)
        self.viewpoint.share(kernels.shade_backward, len(self.shown), *seen, *received)
        return d_sh


class _Drawn(torch.autograd.Function):
    """The image of `Folded`."""

    @staticmethod
    def forward(ctx: Any, folded: Folded, opacities: Tensor, sh: Tensor) -> Tensor:
        colours, opaque = folded.colours(float32(sh)), float32(opacities)
        image = folded.draw(opaque, colours)
        ctx.scene = (folded, opaque, colours, image, sh.shape[1])
        ctx.shapes = (opacities.shape, sh.shape)
        return torch.from_numpy(image)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        folded, opacities, colours, image, bands = ctx.scene
        if not slope.any():  # A photograph that is content
            return None, *(torch.zeros(shape) for shape in ctx.shapes)
        slopes = folded.slopes(opacities, colours, image, float32(slope))
        d_opacities, d_sh = np.ascontiguousarray(slopes[:, 0]), None
        if ctx.needs_input_grad[2]:
            d_sh = torch.from_numpy(folded.slopes_of_sh(colours, slopes[:, 1:], bands))
        return None, torch.from_numpy(d_opacities), d_sh


def folded(view: CpuView, binned: Binned, means: Float32[ndarray, "n 3"]) -> Folded:
    """The fragments of splats of opacity 1, and what is frozen between them."""
    viewpoint, context, new = view.viewpoint, view.layer, binned.layer
    tiles = np.flatnonzero(np.diff(new.tile_start))
    bounds = np.zeros((len(tiles), 2), np.int64)
    viewpoint.share(
        kernels.bound_fragments, len(tiles), tiles, viewpoint.tiles_x, context, new, bounds
    )
    room = np.concatenate([np.zeros((1, 2), np.int64), bounds.cumsum(axis=0)])
    entries, count = room[-1]
    found = Fragments(
        tiles,
        room[:, 0].copy(),
        np.empty(entries, np.int32),
        np.empty(entries, np.int32),
        np.empty(entries, np.int64),
        np.empty(count, np.uint8),
        np.empty(count, np.float32),
        np.empty((count, 4), np.float32),
        np.zeros_like(view.frame.image),
    )
    counts = np.empty((len(tiles), 2), np.int64)
    known = (context, new, binned.slots, room)
    viewpoint.share(kernels.find_fragments, len(tiles), *known, found, counts)
    fragments, solid = with_solid(packed(viewpoint, found, room, counts), context.splats)
    return Folded(viewpoint, view.frame.image, binned, means, fragments, solid)


def with_solid(
    fragments: Fragments, splats: Float32[ndarray, "splats 9"]
) -> tuple[Fragments, Float32[ndarray, "solid 9"]]:
    """The fragments, and those of the frozen splats that they name, numbered anew: most of a scene
    has none, and need not be kept."""
    frozen, names = fragments.names < 0, fragments.names.copy()
    named, names[frozen] = np.unique(~names[frozen], return_inverse=True)
    names[frozen] = ~names[frozen]
    return fragments._replace(names=names), splats[named]


def packed(
    viewpoint: Viewpoint,
    found: Fragments,
    room: Int64[ndarray, "bounds 2"],
    counts: Int64[ndarray, "tiles 2"],
) -> Fragments:
    """The fragments that were found, without the room between them."""
    ends = np.concatenate([np.zeros((1, 2), np.int64), counts.cumsum(axis=0)])
    entries, count = ends[-1]
    left = Fragments(
        found.tiles,
        ends[:, 0].copy(),
        np.empty(entries, np.int32),
        np.empty(entries, np.int32),
        np.empty(entries + 1, np.int64),
        np.empty(count, np.uint8),
        np.empty(count, np.float32),
        np.empty((count, 4), np.float32),
        found.behind,
    )
    left.start[-1] = count
    viewpoint.share(lists.pack_fragments, len(found.tiles), room, ends, found, left)
    return left


def float32(values: Tensor) -> Float32[ndarray, "..."]:
    """The values of a tensor as a contiguous array, not copied where they are one already."""
    return values.detach().to("cpu", torch.float32).contiguous().numpy()
