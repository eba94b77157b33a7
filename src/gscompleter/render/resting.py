"""Frozen views at rest: the lists of their tiles, and none of the splats that these name.

What each tile draws, in which order, takes long to find out and little room. Where a Gaussian falls
in the image takes the room, and is soon told again of the few that something new meets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int32, Int64
from numpy import ndarray
from torch import Tensor

from gscompleter.kernels import lists
from gscompleter.kernels.rasterizer import Frame, Layer
from gscompleter.render import ColourErrors, DepthRender, OpacityRender
from gscompleter.render.cpu import CpuView, Viewpoint, arrays_of, opaque, render_of, starts_of
from gscompleter.render.folded import Folded
from gscompleter.types import Gaussians, Render, merge


@dataclass(frozen=True)
class RestingView:
    """A `CpuView` that keeps names in place of splats, and wakes where something new meets it."""

    viewpoint: Viewpoint
    parts: tuple[Gaussians, ...]
    """The context, and what extended it, one after the other."""
    frame: Frame
    """The context alone."""
    depth_limits: Float32[ndarray, "tiles"]
    """z-depth behind which a tile shows nothing new."""
    tile_start: Int64[ndarray, "bounds"]
    """Where the names of each tile start, and the end [tiles + 1]."""
    names: Int32[ndarray, "entries"]
    """Which Gaussian each entry is, of all parts."""

    @property
    def context(self) -> Render:
        """The context alone."""
        return render_of(self.frame)

    def resting(self, context: Gaussians) -> RestingView:
        """Itself."""
        return self

    def awake(self, where: Bool[ndarray, "tiles"]) -> CpuView:
        """The view as it was frozen, with empty lists in all other tiles."""
        sizes = np.diff(self.tile_start)
        start = starts_of(np.where(where, sizes, 0))
        named, count = self.names[np.repeat(where, sizes)], sum(map(len, self.parts))
        order, entries = lists.number_by_use(named, count)
        splats = self.viewpoint.project(arrays_of(taken(self.parts, order)))
        layer = Layer(splats.columns, splats.opacities, splats.boxes, start, entries)
        frame = self.frame._replace(used=np.where(where[:, None], self.frame.used, 0))
        return CpuView(self.viewpoint, layer, frame, self.depth_limits, order, count)

    def extended(self, new: Gaussians) -> RestingView:
        """The same as freezing context and `new` together, in that order."""
        where = self.met_by(new)
        grown = self.awake(where).extended(new)
        sizes = np.where(where, np.diff(grown.layer.tile_start), np.diff(self.tile_start))
        met = np.repeat(where, sizes)
        names = np.empty(len(met), np.int32)
        names[met] = grown.rows[grown.layer.entries]
        names[~met] = self.names[np.repeat(~where, np.diff(self.tile_start))]
        used = np.where(where[:, None], grown.frame.used, self.frame.used)
        return replace(
            self,
            parts=(*self.parts, replace(new, encoded=None)),
            frame=grown.frame._replace(used=used),
            depth_limits=np.where(where, grown.depth_limits, self.depth_limits),
            tile_start=starts_of(sizes),
            names=names,
        )

    def met_by(self, new: Gaussians) -> Bool[ndarray, "tiles"]:
        """The tiles that `new` touches, whatever its opacities."""
        splats = self.viewpoint.project(opaque(new))
        return np.diff(self.viewpoint.enter(splats, self.depth_limits).tile_start) > 0

    def around(self, new: Gaussians) -> CpuView:
        """The view where `new` meets it."""
        return self.awake(self.met_by(new))

    @property
    def whole(self) -> CpuView:
        """The view as it was frozen."""
        return self.awake(np.ones(self.viewpoint.tiles, np.bool_))

    def sums(self, layers: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        return self.whole.sums(layers)

    def repainted(self, colours: Float[Tensor, "n 3"]) -> Float[Tensor, "h w 3"]:
        return self.whole.repainted(colours)

    def composite(self, new: Gaussians) -> Render:
        return self.around(new).composite(new)

    def plan(self, new: Gaussians) -> OpacityRender:
        return self.around(new).plan(new)

    def plan_appearance(self, new: Gaussians) -> Folded:
        return self.around(new).plan_appearance(new)

    def plan_colours(self, new: Gaussians) -> ColourErrors:
        return self.around(new).plan_colours(new)

    def plan_depths(self, new: Gaussians, where: Bool[Tensor, "h w"]) -> DepthRender:
        return self.around(new).plan_depths(new, where)


def taken(parts: Sequence[Gaussians], names: Int32[ndarray, "m"]) -> Gaussians:
    """These Gaussians of all parts, which are numbered one after the other."""
    if len(parts) == 1:
        return parts[0][torch.from_numpy(names.astype(np.int64))]
    bounds = np.cumsum([0, *map(len, parts)])
    owned = [np.flatnonzero((a <= names) & (names < b)) for a, b in pairwise(bounds)]
    found = [
        part[torch.from_numpy(names[here] - start)]
        for part, here, start in zip(parts, owned, bounds[:-1], strict=True)
    ]
    return merge(found)[torch.from_numpy(np.concatenate(owned).argsort())]
