"""A renderer for CPUs on compiled kernels, fast enough to optimise with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int32, Int64, Integer
from numpy import ndarray
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import max_pool2d

from gscompleter.errors import InputError
from gscompleter.kernels import lists, rasterizer
from gscompleter.kernels.rasterizer import TILE, GaussianArrays, Layer, Pinhole, RasterFrame
from gscompleter.kernels.sharing import run, share, split_range
from gscompleter.render import ColorErrors, ColorSums, DepthRender, OpacityRender
from gscompleter.render.folded import BakedScene, bake_scene, to_float32
from gscompleter.types import Camera, Gaussians, Render

MAX_SIDE = TILE * np.iinfo(np.int16).max
"""Largest side of an image in pixels, since kernels number tiles in 16 bits."""

MAX_ENTRIES = np.iinfo(np.int32).max
"""Largest total length of the tiles' lists, which kernels number in 32 bits."""


MIN_USED_SHARE = 0.9
"""Share of splats in use from which a layer is kept whole, since copying takes longer."""


@dataclass(frozen=True)
class CpuRenderer:
    """Renders in float32, converting other types. The same input gives the same bytes."""

    threads: int | None = None
    """Number of threads, or None for NUMBA_NUM_THREADS; does not affect the result."""

    def render(self, gaussians: Gaussians, camera: Camera) -> Render:
        """Render `gaussians` from `camera`."""
        return self._freeze_nothing(camera).composite(gaussians)

    def freeze(self, context: Gaussians, camera: Camera) -> CpuFrozenScene:
        """Prepare `context` for many renders from `camera`."""
        return self._freeze_nothing(camera).extend(context)

    def _freeze_nothing(self, camera: Camera) -> CpuFrozenScene:
        threads = self.threads or numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
        return Viewpoint(make_pinhole(camera), threads).freeze_nothing()


@dataclass(frozen=True)
class CpuFrozenScene:
    """The frozen context: projected, sorted, binned, and cut behind opaque surfaces.

    It keeps only splats that some tile shows. New Gaussians are composited only in tiles they
    touch.
    """

    viewpoint: Viewpoint
    layer: Layer
    frame: RasterFrame
    """The context alone."""
    depth_limits: Float32[ndarray, "tiles"]
    """z-depth behind which a tile shows nothing."""
    rows: Int32[ndarray, "splats"]
    """Index of the Gaussian of each splat."""
    count: int
    """Number of Gaussians of the context."""

    @cached_property
    def render(self) -> Render:
        """The render of the context alone."""
        return to_render(self.frame)

    def extend(self, new: Gaussians) -> CpuFrozenScene:
        """Freeze context and `new` together, in that order."""
        splats = self.viewpoint.project(to_arrays(new), new.is_antialiased)
        added, order = order_by_use(self.viewpoint.fill_lists(splats, self.depth_limits))
        count = self.count + len(new)
        if len(added.entries) == 0:
            return replace(self, count=count)
        frame = self.viewpoint.composite(self, added)
        used = np.zeros_like(frame.used)
        used[:, 0] = frame.used.sum(axis=1)
        tile_start = compute_starts(used[:, 0])
        entries = np.empty(tile_start[-1], np.int32)
        depth_limits = np.empty(self.viewpoint.tiles, np.float32)
        walked = (self.layer, added, frame.used, frame.full)
        merged = (tile_start, entries, depth_limits)
        self.viewpoint.share(rasterizer.merge_lists, len(used), *walked, *merged)
        layer, kept = join_layers(self.layer, added, tile_start, entries)
        rows = np.concatenate([self.rows[kept[0]], order[kept[1]] + np.int32(self.count)])
        frame = frame._replace(used=used)
        return CpuFrozenScene(self.viewpoint, layer, frame, depth_limits, rows, count)

    def backproject(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        """Backproject `image` by the backward pass on the frozen frame."""
        nothing, itself = self.viewpoint.freeze_nothing().layer, assign_own_slots(self.layer)
        frame = self.frame._replace(used=np.ascontiguousarray(self.frame.used[:, ::-1]))
        d_frame = (image, torch.zeros_like(image[..., 0]), torch.zeros_like(image[..., 0]))
        composited = (nothing, itself, frame, d_frame, rasterizer.WANT_COLOR)
        gradients = self.viewpoint.composite_backward(*composited)
        totals = np.zeros((self.count, 3), np.float32)
        named = (self.layer.entries, self.rows, *gradients, totals)
        pieces = split_range(len(self.rows), self.viewpoint.threads)  # Each reads all entries.
        calls = [(*piece, *named) for piece in pieces]
        run(lists.sum_by_gaussian, calls, self.viewpoint.threads)
        return torch.from_numpy(totals)

    def splat(self, values: Float[Tensor, "n"]) -> Float[Tensor, "h w"]:
        """Composite the frozen lists once more, with the values as red."""
        splats = self.layer.splats.copy()
        splats[:, rasterizer.RED] = np.maximum(to_float32(values)[self.rows], 0)
        frame = self.viewpoint.composite(
            self.viewpoint.freeze_nothing(), self.layer._replace(splats=splats)
        )
        return torch.from_numpy(frame.image[..., 0].copy())

    def composite(self, new: Gaussians) -> Render:
        """Render context and `new`; only `new` is projected, sorted and binned."""
        tensors = (getattr(new, name).to("cpu", torch.float32) for name in GaussianArrays._fields)
        return Render(*_Composite.apply(self, new.is_antialiased, *tensors))

    def vary_opacities(self, new: Gaussians) -> OpacityRender:
        """Project, sort and bin `new` once, with boxes that hold for every opacity."""
        binned = self.viewpoint.bin(to_opaque_arrays(new), new.is_antialiased, self.depth_limits)

        def render(opacities: Float[Tensor, "n"]) -> Render:
            return Render(*_VaryOpacities.apply(self, binned, opacities.to("cpu", torch.float32)))

        return render

    def vary_appearance(self, new: Gaussians, where: Bool[Tensor, "h w"]) -> BakedScene:
        """Project, sort and bin `new` once, and bake the context around it."""
        arrays = to_opaque_arrays(new)
        limits = np.minimum(self.viewpoint.limit_to_mask(where), self.depth_limits)
        binned = self.viewpoint.bin(arrays, new.is_antialiased, limits)
        return bake_scene(self, binned, arrays.means, where)

    def vary_colors(self, new: Gaussians) -> ColorErrors:
        """Project, sort and bin `new` once."""
        binned = self.viewpoint.bin(to_arrays(new), new.is_antialiased, self.depth_limits)

        def errors(colors: Float[Tensor, "n 3"], photograph: Float[Tensor, "h w 3"]) -> ColorSums:
            binned.layer.splats[:, rasterizer.RED :] = np.maximum(to_float32(colors), 0)
            sums = self.viewpoint.backproject_residual(self.layer, binned, to_float32(photograph))
            return torch.from_numpy(sums[:, :3]), torch.from_numpy(sums[:, 3])

        return errors

    def vary_depths(self, new: Gaussians, where: Bool[Tensor, "h w"]) -> DepthRender:
        """Project `new` once, as far as it touches tiles of the mask."""
        splats = self.viewpoint.project(to_arrays(new), new.is_antialiased)
        anywhere = self.viewpoint.limit_to_mask(where)
        touched_splats = np.zeros(len(splats.boxes), np.bool_)
        touched_splats[self.viewpoint.fill_lists(splats, anywhere).entries] = True
        splats = splats.keep_only(touched_splats)
        limits = np.minimum(anywhere, self.depth_limits)

        def render(depths: Float[Tensor, "n"]) -> Render:
            return Render(*_VaryDepths.apply(self, splats, limits, depths.to("cpu", torch.float32)))

        return render


@dataclass(frozen=True)
class Splats:
    """Projected Gaussians, see `Layer`."""

    columns: Float32[ndarray, "n 9"]
    opacities: Float32[ndarray, "n"]
    boxes: Integer[ndarray, "n 4"]
    factors: Float32[ndarray, "n"] | None = None
    """Factors on the opacities of antialiased Gaussians, or None for classic ones."""

    def move_to_depths(self, depths: Float32[ndarray, "n"], near: np.float32) -> Splats:
        """Move the splats to other z-depths; those not beyond `near` get empty boxes."""
        columns = self.columns.copy()
        columns[:, rasterizer.DEPTH] = depths
        return replace(self, columns=columns).keep_only(depths > near)

    def keep_only(self, which: Bool[ndarray, "n"]) -> Splats:
        """Empty the boxes of all other splats."""
        return replace(self, boxes=self.boxes * which[:, None])


@dataclass(frozen=True)
class BinnedSplats:
    """Splats in the lists of the tiles, with the slots of their gradients."""

    layer: Layer
    slots: Int32[ndarray, "entries"]
    """Slot of the gradient of each entry."""
    slot_start: Int64[ndarray, "bounds"]
    """First slot of each Gaussian, and the end [n + 1]."""


SplatArrays = tuple[Float32[ndarray, "n 9"], Float32[ndarray, "n"], Integer[ndarray, "n 4"]]
"""Splats, their opacities and their boxes, see `Layer`."""

EntryGradients = tuple[Float32[ndarray, "entries columns"], Bool[ndarray, "entries"]]
"""Gradients of the tiles' entries by slot, and True for slots that were written."""


@dataclass(frozen=True)
class Viewpoint:
    """A camera and its rendering threads; calls the kernels in order."""

    pinhole: Pinhole
    threads: int

    @property
    def tiles_x(self) -> int:
        """Number of tiles in a row."""
        return -(-self.pinhole.width // TILE)

    @property
    def tiles(self) -> int:
        """Number of tiles of the image."""
        return self.tiles_x * -(-self.pinhole.height // TILE)

    @property
    def box_dtype(self) -> type[np.signedinteger]:
        """Smallest type that holds pixel coordinates, to save memory."""
        fits = max(self.pinhole.width, self.pinhole.height) <= np.iinfo(np.int16).max
        return np.int16 if fits else np.int32

    def freeze_nothing(self) -> CpuFrozenScene:
        """Freeze a context without Gaussians."""
        height, width = self.pinhole.height, self.pinhole.width
        frame = RasterFrame(
            image=np.zeros((height, width, 3), np.float32),
            depth=np.zeros((height, width), np.float32),
            alpha=np.zeros((height, width), np.float32),
            transmittance=np.ones((height, width), np.float32),
            last=np.full((height, width), -1, np.int32),
            used=np.zeros((self.tiles, 2), np.int32),
            full=np.zeros(self.tiles, np.bool_),
        )
        layer = Layer(
            np.empty((0, rasterizer.NUM_SPLAT_COLUMNS), np.float32),
            np.empty(0, np.float32),
            np.empty((0, 4), self.box_dtype),
            np.zeros(self.tiles + 1, np.int64),
            np.empty(0, np.int32),
        )
        limits = np.full(self.tiles, np.inf, np.float32)
        return CpuFrozenScene(self, layer, frame, limits, np.empty(0, np.int32), 0)

    def bin(
        self,
        gaussians: GaussianArrays,
        is_antialiased: bool,
        depth_limits: Float32[ndarray, "tiles"],
    ) -> BinnedSplats:
        """Project, sort and enter Gaussians into the lists of the tiles."""
        return assign_splat_slots(
            self.fill_lists(self.project(gaussians, is_antialiased), depth_limits)
        )

    def project(self, gaussians: GaussianArrays, is_antialiased: bool) -> Splats:
        """Project Gaussians to splats; invisible ones get empty boxes."""
        n = check_lengths(gaussians)
        columns = np.empty((n, rasterizer.NUM_SPLAT_COLUMNS), np.float32)
        boxes = np.empty((n, 4), self.box_dtype)
        factors = np.zeros(n, np.float32) if is_antialiased else None
        self.share(rasterizer.project, n, gaussians, self.pinhole, columns, boxes, factors)
        opacities = gaussians.opacities if factors is None else gaussians.opacities * factors
        return Splats(columns, opacities, boxes, factors)

    def fill_lists(self, splats: Splats, depth_limits: Float32[ndarray, "tiles"]) -> Layer:
        """Enter splats into the lists of the tiles, and sort these."""
        chunks = split_range(len(splats.columns), self.threads)
        counts = np.zeros((len(chunks), self.tiles), np.int32)
        seen = (splats.columns, splats.boxes, depth_limits, self.tiles_x)
        counting = [(*chunk, *seen, count) for chunk, count in zip(chunks, counts, strict=True)]
        run(lists.count_entries, counting, self.threads)
        total = int(counts.sum(dtype=np.int64))
        if total > MAX_ENTRIES:
            raise InputError(
                f"The {len(splats.columns):,} Gaussians cover {total:,} tiles of the image, and at "
                f"most {MAX_ENTRIES:,} can be rendered; use fewer or smaller Gaussians, or a "
                "smaller image."
            )
        tile_start = lists.counts_to_offsets(counts)
        entries, keys = np.empty(total, np.int32), np.empty(total, np.uint32)
        filling = [
            (*chunk, *seen, places, entries, keys)
            for chunk, places in zip(chunks, counts, strict=True)
        ]
        run(lists.fill_entries, filling, self.threads)
        self.share(lists.sort_lists, self.tiles, tile_start, entries, keys)
        return Layer(splats.columns, splats.opacities, splats.boxes, tile_start, entries)

    def composite(self, scene: CpuFrozenScene, new: Layer) -> RasterFrame:
        """Composite the context of `scene` with a new layer, in the tiles that this touches."""
        frame = RasterFrame(*(array.copy() for array in scene.frame))
        tiles = find_touched_tiles(new)
        self.share(rasterizer.composite, len(tiles), tiles, scene.layer, new, frame)
        return frame

    def composite_backward(
        self,
        context: Layer,
        new: BinnedSplats,
        frame: RasterFrame,
        d_frame: tuple[Tensor, ...],
        wanted: int = rasterizer.WANT_ALL,
    ) -> EntryGradients:
        """Compute the gradients of new entries from those of image, depth and alpha."""
        columns = {rasterizer.WANT_ALL: rasterizer.NUM_GRADIENT_COLUMNS, rasterizer.WANT_COLOR: 3}
        values = np.empty((len(new.slots), columns.get(wanted, 1)), np.float32)
        written = np.zeros(len(new.slots), np.bool_)
        tiles = find_touched_tiles(new.layer)
        composited = (tiles, context, new.layer, frame, tuple(map(to_float32, d_frame)))
        received = (new.slots, wanted, values, written)
        self.share(rasterizer.composite_backward, len(tiles), *composited, *received)
        return values, written

    def backproject_residual(
        self, context: Layer, new: BinnedSplats, photograph: Float32[ndarray, "h w 3"]
    ) -> Float32[ndarray, "n 4"]:
        """Backproject the residual of a photograph; the fourth column sums the weights."""
        values = np.empty((len(new.slots), 4), np.float32)
        written = np.zeros(len(new.slots), np.bool_)
        tiles = find_touched_tiles(new.layer)
        composited = (tiles, context, new.layer, photograph, new.slots, values, written)
        self.share(rasterizer.backproject_residual, len(tiles), *composited)
        return self.sum_by_gaussian(new, (values, written))

    def sum_by_gaussian(
        self, new: BinnedSplats, gradients: EntryGradients
    ) -> Float32[ndarray, "n columns"]:
        """Sum the gradients of the entries of each Gaussian."""
        totals = np.empty((len(new.slot_start) - 1, gradients[0].shape[1]), np.float32)
        self.share(lists.sum_entries, len(totals), new.slot_start, *gradients, totals)
        return totals

    def limit_to_mask(self, where: Bool[Tensor, "h w"]) -> Float32[ndarray, "tiles"]:
        """Make depth limits that exclude all tiles outside a mask."""
        tiles = max_pool2d(where[None].float(), TILE, ceil_mode=True).flatten() > 0
        return np.where(tiles.cpu().numpy(), np.float32(np.inf), np.float32(-np.inf))

    def share(self, kernel: Callable[..., None], count: int, *arguments: Any) -> None:
        """Run `kernel(begin, end, *arguments)` over range(count) on the threads."""
        share(kernel, count, *arguments, threads=self.threads)


class _Composite(torch.autograd.Function):
    """Image, depth and alpha of a frozen context with new Gaussians."""

    @staticmethod
    def forward(
        ctx: Any, view: CpuFrozenScene, is_antialiased: bool, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        gaussians = GaussianArrays(*map(to_float32, tensors))
        splats = view.viewpoint.project(gaussians, is_antialiased)
        binned = assign_splat_slots(view.viewpoint.fill_lists(splats, view.depth_limits))
        frame = view.viewpoint.composite(view, binned.layer)
        render = to_render(frame)
        ctx.scene = (view, splats.factors, binned, frame)
        # Torch raises an error if a saved tensor is written to before the backward pass.
        ctx.save_for_backward(*tensors, render.depth, render.alpha)
        return render.image, render.depth, render.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *d_frame: Tensor) -> tuple[Tensor | None, ...]:
        view, factors, binned, frame = ctx.scene
        gaussians = GaussianArrays(*map(to_float32, ctx.saved_tensors[:5]))
        gradients = view.viewpoint.composite_backward(view.layer, binned, frame, d_frame)
        result = GaussianArrays(*map(np.zeros_like, gaussians))
        seen = (gaussians, view.viewpoint.pinhole, factors)
        composited = (*seen, binned.layer.splats, binned.slot_start)
        n = len(gaussians.means)
        view.viewpoint.share(rasterizer.project_backward, n, *composited, *gradients, result)
        return None, None, *map(torch.from_numpy, result)


class _VaryOpacities(torch.autograd.Function):
    """Image, depth and alpha for varying opacities: nothing is projected, sorted or binned."""

    @staticmethod
    def forward(
        ctx: Any, view: CpuFrozenScene, binned: BinnedSplats, opacities: Tensor
    ) -> tuple[Tensor, ...]:
        seen = to_float32(opacities) * binned.layer.opacities  # those of opaque Gaussians
        layer = binned.layer._replace(opacities=seen)
        frame = view.viewpoint.composite(view, layer)
        render = to_render(frame)
        ctx.scene = (view, replace(binned, layer=layer), frame)
        ctx.save_for_backward(opacities, render.depth, render.alpha)
        return render.image, render.depth, render.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *d_frame: Tensor) -> tuple[Tensor | None, ...]:
        view, binned, frame = ctx.scene
        opacities = to_float32(ctx.saved_tensors[0])
        composited = (view.layer, binned, frame, d_frame)
        gradients = view.viewpoint.composite_backward(*composited, rasterizer.WANT_OPACITY)
        sums = view.viewpoint.sums(binned, gradients)[:, 0]
        result = np.divide(sums, opacities, out=np.zeros_like(sums), where=sums != 0)
        return None, None, torch.from_numpy(result)


class _VaryDepths(torch.autograd.Function):
    """Image, depth and alpha for varying depths: nothing is projected."""

    @staticmethod
    def forward(
        ctx: Any, view: CpuFrozenScene, splats: Splats, limits: Any, depths: Tensor
    ) -> tuple[Tensor, ...]:
        moved = splats.move_to_depths(to_float32(depths), view.viewpoint.pinhole.near)
        binned = assign_splat_slots(view.viewpoint.fill_lists(moved, limits))
        frame = view.viewpoint.composite(view, binned.layer)
        render = to_render(frame)
        ctx.scene = (view, binned, frame)
        ctx.save_for_backward(render.depth, render.alpha)
        ctx.mark_non_differentiable(render.image, render.alpha)
        return render.image, render.depth, render.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *d_frame: Tensor) -> tuple[Tensor | None, ...]:
        view, binned, frame = ctx.scene
        composited = (view.layer, binned, frame, d_frame)
        gradients = view.viewpoint.composite_backward(*composited, rasterizer.WANT_DEPTH)
        return None, None, None, torch.from_numpy(view.viewpoint.sums(binned, gradients)[:, 0])


def make_pinhole(camera: Camera) -> Pinhole:
    """Convert a camera for the kernels.

    Raises:
        InputError: The image is empty or larger than the kernels can number.
    """
    if not 0 < min(camera.width, camera.height) <= max(camera.width, camera.height) <= MAX_SIDE:
        raise InputError(
            f"An image of {camera.width} x {camera.height} pixels cannot be rendered; its sides "
            f"must have 1 to {MAX_SIDE:,} pixels."
        )
    K = camera.K.detach().to("cpu", torch.float64)
    c2w = camera.c2w.detach().to("cpu", torch.float64)
    return Pinhole(
        rotation=tuple(to_float32(torch.linalg.inv(c2w[:3, :3])).ravel()),
        center=to_float32(c2w[:3, 3]),
        intrinsics=to_float32(torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])),
        near=np.float32(max(camera.near_plane, 0.0)),
        width=camera.width,
        height=camera.height,
    )


def find_touched_tiles(layer: Layer) -> Int64[ndarray, "touched"]:
    """Find the tiles in which a layer has entries."""
    return np.flatnonzero(np.diff(layer.tile_start))


def compute_starts(sizes: Integer[ndarray, "tiles"]) -> Int64[ndarray, "bounds"]:
    """Compute the starts of consecutive lists of these sizes, and the end."""
    return np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)])


def order_by_use(layer: Layer) -> tuple[Layer, Int32[ndarray, "splats"]]:
    """Reorder splats by first use and drop unused ones, for locality; also return their order."""
    order, entries = lists.number_by_use(layer.entries, len(layer.splats))
    return Layer(*gather_splats([layer], [order]), layer.tile_start, entries), order


def join_layers(
    context: Layer,
    new: Layer,
    tile_start: Int64[ndarray, "bounds"],
    entries: Int32[ndarray, "entries"],
) -> tuple[Layer, list[Int32[ndarray, "_"]]]:
    """Join two layers to one with only the splats that `entries` names.

    Entries number the splats of `new` after those of the context. Also returns the rows used of
    each layer. New splats that are alone and nearly all used stay as they are.
    """
    counts = len(context.splats), len(new.splats)
    named = np.zeros(sum(counts), np.bool_)
    named[entries] = True
    if np.count_nonzero(named) >= (MIN_USED_SHARE if counts[0] == 0 else 1) * len(named):
        rows = [np.arange(count, dtype=np.int32) for count in counts]
    else:
        numbers = np.cumsum(named, dtype=np.int32) - np.int32(1)
        entries = numbers[entries]
        rows = [np.flatnonzero(part).astype(np.int32) for part in np.split(named, counts[:1])]
    whole = new[:3] if len(rows[1]) == sum(counts) else gather_splats([context, new], rows)
    return Layer(*whole, tile_start, entries), rows


def assign_own_slots(layer: Layer) -> BinnedSplats:
    """Give each entry of a layer its own slot."""
    slots = np.arange(len(layer.entries), dtype=np.int32)
    return BinnedSplats(layer, slots, np.zeros(1, np.int64))


def assign_splat_slots(layer: Layer) -> BinnedSplats:
    """Give the entries of each splat adjacent slots."""
    return BinnedSplats(layer, *lists.number_slots(layer.entries, len(layer.splats)))


def gather_splats(layers: Sequence[Layer], rows: Sequence[Int32[ndarray, "_"]]) -> SplatArrays:
    """Gather the splats, opacities and boxes of these rows of each layer."""
    bounds = [0, *accumulate(map(len, rows))]
    taken = (
        np.empty((bounds[-1], rasterizer.NUM_SPLAT_COLUMNS), np.float32),
        np.empty(bounds[-1], np.float32),
        np.empty((bounds[-1], 4), layers[0].boxes.dtype),
    )
    for layer, row, (start, stop) in zip(layers, rows, pairwise(bounds), strict=True):
        into = tuple(array[start:stop] for array in taken)
        share(lists.copy_splats, len(row), row, *layer[:3], into)
    return taken


def check_lengths(gaussians: GaussianArrays) -> int:
    """Return the number of Gaussians; raise ValueError if the arrays differ in length."""
    lengths = {len(array) for array in gaussians}
    if len(lengths) > 1:
        raise ValueError(f"the fields of Gaussians have different lengths: {sorted(lengths)}")
    return lengths.pop()


def to_arrays(gaussians: Gaussians) -> GaussianArrays:
    """Convert Gaussians for the kernels, without gradients."""
    return GaussianArrays(
        *(to_float32(getattr(gaussians, name)) for name in GaussianArrays._fields)
    )


def to_opaque_arrays(gaussians: Gaussians) -> GaussianArrays:
    """Convert Gaussians at opacity 1, which makes their boxes hold for every opacity."""
    arrays = to_arrays(gaussians)
    return arrays._replace(opacities=np.ones_like(arrays.opacities))


def to_render(frame: RasterFrame) -> Render:
    """Convert a frame to tensors that share its memory."""
    return Render(*map(torch.from_numpy, (frame.image, frame.depth, frame.alpha)))
