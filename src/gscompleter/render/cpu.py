"""A renderer for CPUs on compiled kernels, fast enough to optimise with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int32, Int64
from numpy import ndarray
from torch import Tensor
from torch.autograd.function import once_differentiable

from gscompleter.numerics.kernels import composite, project
from gscompleter.numerics.kernels.composite import Layer, RasterFrame
from gscompleter.numerics.kernels.project import CameraArrays, GaussianArrays
from gscompleter.numerics.kernels.simd import TILE
from gscompleter.render.protocols import Backpropagation, ColorErrors, ColorSums, DepthRender
from gscompleter.render.viewpoint import (
    BinnedSplats,
    Splats,
    Viewpoint,
    bin_layer,
    find_touched_tiles,
    order_by_use,
    to_float32,
)
from gscompleter.system.errors import InputError
from gscompleter.system.files.mapping import file_array_beside, release_pages
from gscompleter.types import Camera, Gaussians, Render

FROZEN_BLOCK = 4_000_000
"""Gaussians that are frozen at a time."""
OCCLUDER_BLOCK = 500_000
"""Gaussians of which at a time is found what hides others."""
MAX_TILED_SIDE = TILE * np.iinfo(np.int16).max
"""Largest side of an image in pixels, since kernels number tiles in 16 bits."""


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
        threads = self.threads or numba.config.NUMBA_NUM_THREADS
        return freeze_nothing(Viewpoint(make_pinhole(camera), threads))


@dataclass(frozen=True)
class CpuFrozenScene:
    """The frozen context: projected, sorted, binned, and cut behind opaque surfaces.

    It keeps only splats that some tile shows. New ones are composited only in tiles they touch.
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

    def move_beside(self, mapped: Tensor) -> CpuFrozenScene:
        """Move the lists to files, beside the file in which `mapped` lies."""
        layer = Layer(*[file_array_beside(array, mapped) for array in self.layer])
        return replace(self, layer=layer, rows=file_array_beside(self.rows, mapped))

    def release(self) -> None:
        """Release the memory of lists that lie in files, after all of them were read.

        What was read stays in memory otherwise, for each of the frozen views (decision 134).
        """
        for array in (*self.layer, self.rows):
            release_pages(array)

    def extend(self, new: Gaussians) -> CpuFrozenScene:
        """Freeze context and `new` together, in that order, some at a time to save memory."""
        frozen = self
        for start in range(0, len(new), FROZEN_BLOCK):
            frozen = frozen._extend(new[start : start + FROZEN_BLOCK])
        return frozen

    def _extend(self, new: Gaussians) -> CpuFrozenScene:
        """Freeze context and `new` together: composite once, and keep what the image showed."""
        # No variable holds the splats, of which most are in no list.
        added, order = order_by_use(
            self.viewpoint.fill_lists(
                self.viewpoint.project(to_arrays(new), new.is_antialiased), self.depth_limits
            )
        )
        count = self.count + len(new)
        if len(added.entries) == 0:
            return replace(self, count=count)
        frame = self.viewpoint.composite(self.layer, self.frame, added)

        # In each tile, the entries of context and new splats that were composited until it was full
        # are merged by depth to one list. Whatever lies behind is dropped, since nothing that is
        # added later can uncover it.
        used = np.zeros_like(frame.used)
        used[:, 0] = frame.used.sum(axis=1)
        tile_start = np.concatenate([[0], np.cumsum(used[:, 0], dtype=np.int64)])
        entries = np.empty(tile_start[-1], np.int32)
        depth_limits = np.empty(self.viewpoint.tiles, np.float32)
        self.viewpoint.share(
            composite.merge_lists,
            len(used),
            self.layer,
            added,
            frame.used,
            frame.full,
            tile_start,
            entries,
            depth_limits,
        )

        layer, (context_rows, new_rows) = join_layers(self.layer, added, tile_start, entries)
        rows = np.concatenate([self.rows[context_rows], order[new_rows] + np.int32(self.count)])
        frame = frame._replace(used=used)
        self.release()
        # A limit never grows: those of `freeze_occluders` are nearer than what the frame tells.
        np.minimum(depth_limits, self.depth_limits, out=depth_limits)
        return CpuFrozenScene(self.viewpoint, layer, frame, depth_limits, rows, count)

    def freeze_occluders(self, others: Gaussians) -> CpuFrozenScene:
        """Freeze `others` up to the last frozen Gaussian of each tile; none in tiles without."""
        # A list ends with the splat behind all others. No depth is below 0.
        limits = np.full(self.viewpoint.tiles, -1, np.float32)
        touched = find_touched_tiles(self.layer)
        last = self.layer.entries[self.layer.tile_start[touched + 1] - 1]
        limits[touched] = self.layer.splats[last, project.DEPTH]
        frozen = replace(freeze_nothing(self.viewpoint), depth_limits=limits)
        # Few enter any list, so that many small blocks cost no time.
        for start in range(0, len(others), OCCLUDER_BLOCK):
            frozen = frozen._extend(others[start : start + OCCLUDER_BLOCK])
        return frozen

    def hide(self, hidden: Bool[Tensor, "n"], parts: Sequence[Gaussians]) -> CpuFrozenScene:
        """Draw tiles that showed `hidden` Gaussians again, and keep the lists of the others."""
        old = self.layer
        is_entry_hidden = hidden.numpy()[self.rows][old.entries]
        tile_of_entry = np.repeat(np.arange(self.viewpoint.tiles), np.diff(old.tile_start))
        is_drawn = np.zeros(self.viewpoint.tiles, np.bool_)
        is_drawn[tile_of_entry[is_entry_hidden]] = True
        # No depth is below 0: nothing enters the other tiles.
        limits = np.where(is_drawn, np.float32(np.inf), np.float32(-1))
        drawn = replace(freeze_nothing(self.viewpoint), depth_limits=limits)
        for part in parts:
            drawn = drawn.extend(part)

        layer, rows = choose_lists(self, drawn, is_drawn)
        frame = choose_pixels(self, drawn, is_drawn)
        depth_limits = np.where(is_drawn, drawn.depth_limits, self.depth_limits)
        self.release()
        return CpuFrozenScene(self.viewpoint, layer, frame, depth_limits, rows, self.count)

    def repaint(self, rows: Int64[Tensor, "m"], painted: Gaussians) -> CpuFrozenScene:
        """Composite the frozen lists once more, in the new colours: nothing is sorted or binned."""
        # Row of `painted` for each splat, or -1. What a tile shows does not depend on colours.
        row_of_gaussian = np.full(self.count, -1, np.int32)
        row_of_gaussian[rows.numpy()] = np.arange(len(rows), dtype=np.int32)
        row_of_splat = row_of_gaussian[self.rows]
        is_painted = row_of_splat >= 0
        new = self.viewpoint.project(to_arrays(painted), painted.is_antialiased)
        splats = self.layer.splats.copy()
        splats[is_painted, project.RED :] = new.columns[row_of_splat[is_painted], project.RED :]

        layer = self.layer._replace(splats=splats)
        frame, _ = freeze_nothing(self.viewpoint).composite_layer(layer)
        # The layer was composited as a new one, whose entries the second column counts.
        frame = frame._replace(used=np.ascontiguousarray(frame.used[:, ::-1]))
        self.release()
        return replace(self, layer=layer, frame=frame)

    def backproject(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        """Backproject `image` by the backward pass on the frozen frame."""
        # Kernels give gradients to new splats only, so that the context is passed as the new layer
        # before an empty context; `used` counts entries of the context first, then of the new.
        nothing = freeze_nothing(self.viewpoint).layer
        itself = bin_layer(self.layer)
        frame = self.frame._replace(used=np.ascontiguousarray(self.frame.used[:, ::-1]))
        zeros = torch.zeros_like(image[..., 0])
        gradients = self.viewpoint.composite_backward(
            nothing, itself, frame, (image, zeros, zeros), composite.WANT_COLOR
        )

        totals = np.zeros((self.count, 3), np.float32)
        totals[self.rows] = self.viewpoint.sum_by_gaussian(itself, gradients)
        self.release()
        return torch.from_numpy(totals)

    def splat(self, values: Float[Tensor, "n"]) -> Float[Tensor, "h w"]:
        """Composite the frozen lists once more, with the values as red."""
        # Colours below 0 are cut off before kernels get them.
        splats = self.layer.splats.copy()
        splats[:, project.RED] = np.maximum(to_float32(values)[self.rows], 0)
        nothing = freeze_nothing(self.viewpoint)
        _, render = nothing.composite_layer(self.layer._replace(splats=splats))
        self.release()
        return render.image[..., 0].clone()

    def composite(self, new: Gaussians) -> Render:
        """Render context and `new`; only `new` is projected, sorted and binned."""
        # The conversion is outside the autograd function, so that gradients return to the dtype and
        # device of `new`.
        tensors = [getattr(new, name).to("cpu", torch.float32) for name in GaussianArrays._fields]
        return Render(*_Composite.apply(self, new.is_antialiased, *tensors))

    def composite_layer(self, new: Layer) -> tuple[RasterFrame, Render]:
        """Composite the context and a new layer."""
        frame = self.viewpoint.composite(self.layer, self.frame, new)
        return frame, to_render(frame)

    def vary_opacities(self, new: Gaussians, is_fading: bool = False) -> CpuOpacityRender:
        """Project, sort and bin `new` once, so that boxes hold for every opacity to come.

        That is up to 1, or what Gaussians have that are fading: of faint ones boxes are small.
        """
        largest = new.opacities if is_fading else torch.ones_like(new.opacities)
        splats = self.viewpoint.project(
            to_arrays(replace(new, opacities=largest)), new.is_antialiased
        )
        # Opacities are given in each render, and multiply the factors of antialiasing.
        factors = np.ones(len(new), np.float32) if splats.factors is None else splats.factors
        splats = replace(splats, opacities=factors)
        return CpuOpacityRender(self, self.viewpoint.enter(splats, self.depth_limits))

    def vary_colors(self, new: Gaussians) -> ColorErrors:
        """Project, sort and bin `new` once."""
        splats = self.viewpoint.project(to_arrays(new), new.is_antialiased)
        binned = self.viewpoint.enter(splats, self.depth_limits)

        def errors(colors: Float[Tensor, "n 3"], photograph: Float[Tensor, "h w 3"]) -> ColorSums:
            # Written in place instead of into a copy; calls must not overlap.
            binned.layer.splats[:, project.RED :] = np.maximum(to_float32(colors), 0)
            sums = self.viewpoint.backproject_residual(self.layer, binned, to_float32(photograph))
            return torch.from_numpy(sums[:, :3]), torch.from_numpy(sums[:, 3])

        return errors

    def vary_depths(self, new: Gaussians) -> DepthRender:
        """Project `new` once."""
        splats = self.viewpoint.project(to_arrays(new), new.is_antialiased)

        def render(depths: Float[Tensor, "n"]) -> Render:
            return Render(*_VaryDepths.apply(self, splats, depths.to("cpu", torch.float32)))

        return render


@dataclass(frozen=True)
class CpuOpacityRender:
    """A frozen scene with Gaussians that vary in opacity."""

    scene: CpuFrozenScene
    binned: BinnedSplats
    """The Gaussians, with factors on the opacities in place of these."""

    def __call__(self, opacities: Float[Tensor, "n"]) -> Render:
        """Render the scene with the Gaussians at other opacities; differentiable."""
        return Render(*_VaryOpacities.apply(self, opacities.to("cpu", torch.float32)))

    def begin(self, opacities: Float[Tensor, "n"]) -> tuple[Render, Backpropagation]:
        """Render, and prepare the gradients of several functions of the image at once."""
        opacities = opacities.to("cpu", torch.float32)
        binned = self.set_opacities(opacities)
        frame, render = self.scene.composite_layer(binned.layer)

        def backpropagate(images: Float[Tensor, "images h w 3"]) -> list[Float[Tensor, "n"]]:
            return self.differentiate(binned, frame, opacities, images)

        return render, backpropagate

    def set_opacities(self, opacities: Float[Tensor, "n"]) -> BinnedSplats:
        """Give the Gaussians other opacities."""
        layer = self.binned.layer
        layer = layer._replace(opacities=to_float32(opacities) * layer.opacities)
        return replace(self.binned, layer=layer)

    def differentiate(
        self,
        binned: BinnedSplats,
        frame: RasterFrame,
        opacities: Float[Tensor, "n"],
        images: Float[Tensor, "images h w 3"],
    ) -> list[Float[Tensor, "n"]]:
        """Compute a gradient in the opacities from each gradient of the image of `frame`."""
        scene = self.scene
        sums = scene.viewpoint.backpropagate_images(scene.layer, binned, frame, to_float32(images))
        return [divide_by_opacity(column, to_float32(opacities)) for column in sums.T]


class _Composite(torch.autograd.Function):
    """Image, depth and alpha of a frozen context with new Gaussians."""

    @staticmethod
    def forward(
        ctx: Any, scene: CpuFrozenScene, is_antialiased: bool, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        gaussians = GaussianArrays(*[to_float32(tensor) for tensor in tensors])
        splats = scene.viewpoint.project(gaussians, is_antialiased)
        layer = scene.viewpoint.fill_lists(splats, scene.depth_limits)
        frame, render = scene.composite_layer(layer)
        if not any(ctx.needs_input_grad):
            return render.image, render.depth, render.alpha
        # `save_for_backward` takes tensors alone; arrays are attributes.
        ctx.scene = (scene, splats.factors, bin_layer(layer), frame)
        # Torch raises an error if a saved tensor is written to before the backward pass. This one
        # reads depth and alpha of the frame, and not its image.
        ctx.save_for_backward(*tensors, render.depth, render.alpha)
        return render.image, render.depth, render.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *d_frame: Tensor) -> tuple[Tensor | None, ...]:
        scene, factors, binned, frame = ctx.scene
        gaussians = GaussianArrays(*[to_float32(tensor) for tensor in ctx.saved_tensors[:5]])
        values, written = scene.viewpoint.composite_backward(scene.layer, binned, frame, d_frame)
        result = GaussianArrays(*[np.zeros_like(array) for array in gaussians])
        scene.viewpoint.share(
            project.project_backward,
            len(result.means),
            gaussians,
            scene.viewpoint.pinhole,
            factors,
            binned.layer.splats,
            binned.slot_start,
            values,
            written,
            result,
        )
        # No gradients for the scene and the mode.
        return None, None, *[torch.from_numpy(array) for array in result]


class _VaryOpacities(torch.autograd.Function):
    """Image, depth and alpha for varying opacities: nothing is projected, sorted or binned."""

    @staticmethod
    def forward(ctx: Any, varied: CpuOpacityRender, opacities: Tensor) -> tuple[Tensor, ...]:
        binned = varied.set_opacities(opacities)
        frame, render = varied.scene.composite_layer(binned.layer)
        ctx.scene = (varied, binned, frame)
        ctx.save_for_backward(opacities, render.depth, render.alpha)
        # An output that nothing depends on has no gradient then, where it would have zeros.
        ctx.set_materialize_grads(False)
        return render.image, render.depth, render.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *d_frame: Tensor | None) -> tuple[Tensor | None, ...]:
        varied, binned, frame = ctx.scene
        opacities, *_ = ctx.saved_tensors
        d_image, d_depth, d_alpha = d_frame
        if d_image is not None and d_depth is None and d_alpha is None:
            # Most functions read the image alone, and this way fills a tenth of the memory.
            (result,) = varied.differentiate(binned, frame, opacities, d_image[None])
            return None, result
        scene = varied.scene
        outputs = (frame.image, frame.depth, frame.alpha)
        gradients = scene.viewpoint.composite_backward(
            scene.layer,
            binned,
            frame,
            tuple(
                torch.zeros(output.shape) if gradient is None else gradient
                for gradient, output in zip(d_frame, outputs, strict=True)
            ),
        )
        sums = scene.viewpoint.sum_by_gaussian(binned, gradients)[:, project.SUM]
        return None, divide_by_opacity(sums, to_float32(opacities))


class _VaryDepths(torch.autograd.Function):
    """Image, depth and alpha for varying depths: nothing is projected."""

    @staticmethod
    def forward(
        ctx: Any, scene: CpuFrozenScene, splats: Splats, depths: Tensor
    ) -> tuple[Tensor, ...]:
        moved = splats.move_to_depths(to_float32(depths), scene.viewpoint.pinhole.near)
        binned = scene.viewpoint.enter(moved, scene.depth_limits)
        frame, render = scene.composite_layer(binned.layer)
        ctx.scene = (scene, binned, frame)
        ctx.save_for_backward(render.depth, render.alpha)
        # Footprints are constant, so that only the depth varies smoothly; order may change.
        ctx.mark_non_differentiable(render.image, render.alpha)
        return render.image, render.depth, render.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *d_frame: Tensor) -> tuple[Tensor | None, ...]:
        scene, binned, frame = ctx.scene
        gradients = scene.viewpoint.composite_backward(scene.layer, binned, frame, d_frame)
        sums = scene.viewpoint.sum_by_gaussian(binned, gradients)[:, project.SUM_DEPTH]
        return None, None, torch.from_numpy(sums.copy())


def divide_by_opacity(
    sums: Float32[ndarray, "n"], opacities: Float32[ndarray, "n"]
) -> Float[Tensor, "n"]:
    """Compute gradients in the opacities from sums of alpha times dL/dalpha.

    Alpha is proportional to the opacity. An opacity of 0 has no sum, and keeps the gradient 0.
    """
    result = np.divide(sums, opacities, out=np.zeros_like(opacities), where=sums != 0)
    return torch.from_numpy(result)


def freeze_nothing(viewpoint: Viewpoint) -> CpuFrozenScene:
    """Freeze a context without Gaussians."""
    height = viewpoint.pinhole.height
    width = viewpoint.pinhole.width
    frame = RasterFrame(
        image=np.zeros((height, width, 3), np.float32),
        depth=np.zeros((height, width), np.float32),
        alpha=np.zeros((height, width), np.float32),
        transmittance=np.ones((height, width), np.float32),
        last=np.full((height, width), -1, np.int32),
        used=np.zeros((viewpoint.tiles, 2), np.int32),
        full=np.zeros(viewpoint.tiles, np.bool_),
    )
    layer = Layer(
        np.empty((0, project.NUM_SPLAT_COLUMNS), np.float32),
        np.empty(0, np.float32),
        np.empty((0, 4), viewpoint.box_dtype),
        np.zeros(viewpoint.tiles + 1, np.int64),
        np.empty(0, np.int32),
    )
    limits = np.full(viewpoint.tiles, np.inf, np.float32)
    return CpuFrozenScene(viewpoint, layer, frame, limits, np.empty(0, np.int32), 0)


def choose_lists(
    scene: CpuFrozenScene, drawn: CpuFrozenScene, is_drawn: Bool[ndarray, "tiles"]
) -> tuple[Layer, Int32[ndarray, "splats"]]:
    """Choose the lists of `drawn` in some tiles, and those of `scene` in the others.

    Both are frozen from the same Gaussians at the same camera. Also returns the index of the
    Gaussian of each splat.
    """
    # Entries of either layer, tile by tile, by the rows of their Gaussians; of a Gaussian that is
    # in both layers, either splat will do.
    old = scene.layer
    new = drawn.layer
    starts = np.where(is_drawn, len(old.entries) + new.tile_start[:-1], old.tile_start[:-1])
    counts = np.where(is_drawn, np.diff(new.tile_start), np.diff(old.tile_start))
    tile_start = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    places = np.repeat(starts - tile_start[:-1], counts)
    places += np.arange(len(places))
    splats = np.concatenate([old.entries, new.entries + np.int32(len(old.splats))])[places]
    del places
    rows_of_entries = np.concatenate([scene.rows, drawn.rows])[splats]
    splat_of_row = np.full(scene.count, -1, np.int32)
    splat_of_row[rows_of_entries] = splats
    rows = np.flatnonzero(splat_of_row >= 0).astype(np.int32)
    kept = splat_of_row[rows]
    # From here on the number of each splat among those that are kept.
    splat_of_row[rows] = np.arange(len(rows), dtype=np.int32)

    # Joined to one array, those of both layers would be copied twice.
    is_new = kept >= len(old.splats)
    new_kept = kept[is_new] - len(old.splats)

    def take(mine: ndarray, other: ndarray) -> ndarray:
        taken = mine[np.where(is_new, 0, kept)]
        taken[is_new] = other[new_kept]
        return taken

    layer = Layer(
        take(old.splats, new.splats),
        take(old.opacities, new.opacities),
        take(old.boxes, new.boxes),
        tile_start,
        splat_of_row[rows_of_entries],
    )
    return layer, rows


def choose_pixels(
    scene: CpuFrozenScene, drawn: CpuFrozenScene, is_drawn: Bool[ndarray, "tiles"]
) -> RasterFrame:
    """Choose the frame of `drawn` in some tiles, and that of `scene` in the others."""
    height, width = scene.frame.alpha.shape
    tiles = is_drawn.reshape(-1, scene.viewpoint.tiles_x)
    pixels = tiles.repeat(TILE, axis=0).repeat(TILE, axis=1)[:height, :width]

    def join(name: str, where: ndarray) -> ndarray:
        mine, other = getattr(scene.frame, name), getattr(drawn.frame, name)
        return np.where(where.reshape(where.shape + (1,) * (mine.ndim - where.ndim)), other, mine)

    of_tiles = ("used", "full")
    return RasterFrame(
        *[join(name, is_drawn if name in of_tiles else pixels) for name in RasterFrame._fields]
    )


def make_pinhole(camera: Camera) -> CameraArrays:
    """Convert a camera for the kernels, whose image must not be too large for them."""
    if (
        not 0
        < min(camera.width, camera.height)
        <= max(camera.width, camera.height)
        <= MAX_TILED_SIDE
    ):
        raise InputError(
            f"An image of {camera.width} x {camera.height} pixels cannot be rendered; its sides "
            f"must have 1 to {MAX_TILED_SIDE:,} pixels."
        )
    # In float64 until the end, so that the inverse is as exact as float32 holds it.
    K = camera.K.detach().to("cpu", torch.float64)
    c2w = camera.c2w.detach().to("cpu", torch.float64)
    return CameraArrays(
        rotation=tuple(to_float32(torch.linalg.inv(c2w[:3, :3])).ravel()),
        center=to_float32(c2w[:3, 3]),
        intrinsics=to_float32(torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])),
        near=np.float32(max(camera.near_plane, 0.0)),
        width=camera.width,
        height=camera.height,
        padding=camera.padding,
        blur=np.float32(camera.blur),
    )


def join_layers(
    context: Layer,
    new: Layer,
    tile_start: Int64[ndarray, "bounds"],
    entries: Int32[ndarray, "entries"],
) -> tuple[Layer, list[Int32[ndarray, "_"]]]:
    """Join two layers to one with only the splats that `entries` names.

    Entries number the splats of `new` after those of the context. Also returns the rows used of
    each layer.
    """
    named = np.zeros(len(context.splats) + len(new.splats), np.bool_)
    named[entries] = True
    # New number of each splat that is named: how many named ones precede it.
    numbers = np.cumsum(named, dtype=np.int32) - np.int32(1)

    context_rows = np.flatnonzero(named[: len(context.splats)]).astype(np.int32)
    new_rows = np.flatnonzero(named[len(context.splats) :]).astype(np.int32)
    layer = Layer(
        splats=np.concatenate([context.splats[context_rows], new.splats[new_rows]]),
        opacities=np.concatenate([context.opacities[context_rows], new.opacities[new_rows]]),
        boxes=np.concatenate([context.boxes[context_rows], new.boxes[new_rows]]),
        tile_start=tile_start,
        entries=numbers[entries],
    )
    return layer, [context_rows, new_rows]


def to_arrays(gaussians: Gaussians) -> GaussianArrays:
    """Convert Gaussians for the kernels, without gradients."""
    return GaussianArrays(
        *[to_float32(getattr(gaussians, name)) for name in GaussianArrays._fields]
    )


def to_render(frame: RasterFrame) -> Render:
    """Convert a frame to tensors that share its memory."""
    return Render(
        torch.from_numpy(frame.image),
        torch.from_numpy(frame.depth),
        torch.from_numpy(frame.alpha),
    )
