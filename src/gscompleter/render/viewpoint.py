"""A camera and the compiled kernels that render for it, in the order in which they run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, Int64, Integer
from numpy import ndarray
from torch import Tensor

from gscompleter.numerics.kernels import composite, project, tiles
from gscompleter.numerics.kernels.composite import WANT_ALL, WANT_COLOR, Layer, RasterFrame
from gscompleter.numerics.kernels.parallel import run_calls, share, split_range
from gscompleter.numerics.kernels.project import CameraArrays, GaussianArrays
from gscompleter.numerics.kernels.simd import TILE
from gscompleter.system.errors import InputError
from gscompleter.system.files.mapping import release_pages

PROJECTED_BLOCK = 500_000
"""Gaussians that are projected at a time."""
MAX_ENTRIES = np.iinfo(np.int32).max
"""Largest total length of the tiles' lists, which kernels number in 32 bits."""


@dataclass(frozen=True)
class Splats:
    """Projected Gaussians, see `Layer`."""

    columns: Float32[ndarray, "n 9"]
    opacities: Float32[ndarray, "n"]
    boxes: Integer[ndarray, "n 4"]
    factors: Float32[ndarray, "n"] | None = None
    """Factors on the opacities of antialiased Gaussians, or None for classic ones."""

    def move_to_depths(self, depths: Float32[ndarray, "n"], near: np.float32) -> Splats:
        """Move the splats to other z-depths, along their rays and with constant footprints.

        Those not beyond `near` get empty boxes.
        """
        columns = self.columns.copy()
        columns[:, project.DEPTH] = depths
        # A box of zeros covers no tile.
        return replace(self, columns=columns, boxes=self.boxes * (depths > near)[:, None])


@dataclass(frozen=True)
class BinnedSplats:
    """Splats in the lists of the tiles, with the slots of their gradients."""

    layer: Layer
    slots: Int32[ndarray, "entries"]
    """Slot of the gradient of each entry."""
    slot_start: Int64[ndarray, "bounds"]
    """First slot of each Gaussian, and the end [n + 1]."""


EntryGradients = tuple[Float32[ndarray, "entries columns"], Bool[ndarray, "entries"]]
"""Gradients of the tiles' entries by slot, and True for slots that were written."""


@dataclass(frozen=True)
class Viewpoint:
    """A camera and its rendering threads; calls the kernels in order."""

    pinhole: CameraArrays
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

    def enter(self, splats: Splats, depth_limits: Float32[ndarray, "tiles"]) -> BinnedSplats:
        """Enter splats into the lists of the tiles, and give those of each splat adjacent slots.

        `depth_limits` are those of `fill_lists`.
        """
        return bin_layer(self.fill_lists(splats, depth_limits))

    def project(self, gaussians: GaussianArrays, is_antialiased: bool) -> Splats:
        """Project Gaussians to splats; invisible ones get empty boxes."""
        n = check_lengths(gaussians)
        columns = np.empty((n, project.NUM_SPLAT_COLUMNS), np.float32)
        boxes = np.empty((n, 4), self.box_dtype)
        factors = np.zeros(n, np.float32) if is_antialiased else None
        # Harmonics may lie in a file, of which no more than a block is kept in memory.
        for start in range(0, n, PROJECTED_BLOCK):
            block = slice(start, start + PROJECTED_BLOCK)
            part = GaussianArrays(*[array[block] for array in gaussians])
            result = (columns[block], boxes[block], None if factors is None else factors[block])
            self.share(project.project_splats, len(part.means), part, self.pinhole, *result)
            release_pages(part.sh)
        opacities = gaussians.opacities if factors is None else gaussians.opacities * factors
        return Splats(columns, opacities, boxes, factors)

    def fill_lists(self, splats: Splats, depth_limits: Float32[ndarray, "tiles"]) -> Layer:
        """Enter splats into the lists of the tiles, and sort these.

        `depth_limits` are the z-depths behind which nothing is visible in a tile, since what was
        rendered before is opaque there; infinity in others. Splats behind them are not entered.
        """
        # A counting sort by tile: each thread counts the entries of its chunk of splats per tile,
        # the counts become offsets, and each thread fills its own places. Depth sorts each list.
        chunks = split_range(len(splats.columns), self.threads)
        counts = np.zeros((len(chunks), self.tiles), np.int32)
        counting = [
            (*chunk, splats.columns, splats.boxes, depth_limits, self.tiles_x, count)
            for chunk, count in zip(chunks, counts, strict=True)
        ]
        run_calls(tiles.count_entries, counting, self.threads)
        total = int(counts.sum(dtype=np.int64))
        if total > MAX_ENTRIES:
            raise InputError(
                f"The {len(splats.columns):,} Gaussians cover {total:,} tiles of the image, and at "
                f"most {MAX_ENTRIES:,} can be rendered; use fewer or smaller Gaussians, or a "
                "smaller image."
            )

        tile_start = tiles.counts_to_offsets(counts)
        entries = np.empty(total, np.int32)
        keys = np.empty(total, np.uint32)
        filling = [(*call, entries, keys) for call in counting]
        run_calls(tiles.fill_entries, filling, self.threads)
        self.share(tiles.sort_lists, self.tiles, tile_start, entries, keys)
        return Layer(splats.columns, splats.opacities, splats.boxes, tile_start, entries)

    def composite(self, context: Layer, frame: RasterFrame, new: Layer) -> RasterFrame:
        """Composite a context, rendered to `frame`, with a new layer in its tiles."""
        # Tiles that the new layer does not touch stay as they are.
        frame = RasterFrame(*[array.copy() for array in frame])
        tiles = find_touched_tiles(new)
        self.share(composite.composite, len(tiles), tiles, context, new, frame)
        return frame

    def composite_backward(
        self,
        context: Layer,
        new: BinnedSplats,
        frame: RasterFrame,
        d_frame: tuple[Tensor, ...],
        wanted: int = WANT_ALL,
    ) -> EntryGradients:
        """Compute the gradients of new entries from those of image, depth and alpha."""
        columns = 3 if wanted == WANT_COLOR else project.NUM_GRADIENT_COLUMNS
        values = np.empty((len(new.slots), columns), np.float32)
        written = np.zeros(len(new.slots), np.bool_)
        tiles = find_touched_tiles(new.layer)
        self.share(
            composite.composite_backward,
            len(tiles),
            tiles,
            context,
            new.layer,
            frame,
            tuple([to_float32(gradient) for gradient in d_frame]),
            new.slots,
            wanted,
            values,
            written,
        )
        return values, written

    def backpropagate_images(
        self,
        context: Layer,
        new: BinnedSplats,
        frame: RasterFrame,
        d_images: Float32[ndarray, "images h w 3"],
    ) -> Float32[ndarray, "n images"]:
        """Compute opacity times gradient of each new Gaussian from gradients of the image."""
        values = np.empty((len(new.slots), len(d_images)), np.float32)
        written = np.zeros(len(new.slots), np.bool_)
        tiles = find_touched_tiles(new.layer)
        self.share(
            composite.backpropagate_images,
            len(tiles),
            tiles,
            context,
            new.layer,
            frame,
            d_images,
            new.slots,
            values,
            written,
        )
        return self.sum_by_gaussian(new, (values, written))

    def backproject_residual(
        self, context: Layer, new: BinnedSplats, photograph: Float32[ndarray, "h w 3"]
    ) -> Float32[ndarray, "n 4"]:
        """Backproject the residual of a photograph; the fourth column sums the weights."""
        values = np.empty((len(new.slots), 4), np.float32)
        written = np.zeros(len(new.slots), np.bool_)
        tiles = find_touched_tiles(new.layer)
        self.share(
            composite.backproject_residual,
            len(tiles),
            tiles,
            context,
            new.layer,
            photograph,
            new.slots,
            values,
            written,
        )
        return self.sum_by_gaussian(new, (values, written))

    def sum_by_gaussian(
        self, new: BinnedSplats, gradients: EntryGradients
    ) -> Float32[ndarray, "n columns"]:
        """Sum the gradients of the entries of each Gaussian.

        The order of its slots is that of the tiles, so that threads do not change the sum
        (decision 036).
        """
        values, written = gradients
        totals = np.empty((len(new.slot_start) - 1, values.shape[1]), np.float32)
        self.share(tiles.sum_entries, len(totals), new.slot_start, values, written, totals)
        return totals

    def share(self, kernel: Callable[..., None], count: int, *arguments: Any) -> None:
        """Run `kernel(begin, end, *arguments)` over range(count) on the threads."""
        share(kernel, count, *arguments, threads=self.threads)


def bin_layer(layer: Layer) -> BinnedSplats:
    """Give the entries of each splat adjacent slots."""
    slots, slot_start = tiles.number_slots(layer.entries, len(layer.splats))
    return BinnedSplats(layer, slots, slot_start)


def find_touched_tiles(layer: Layer) -> Int64[ndarray, "touched"]:
    """Find the tiles in which a layer has entries."""
    return np.flatnonzero(np.diff(layer.tile_start))


def order_by_use(layer: Layer) -> tuple[Layer, Int32[ndarray, "splats"]]:
    """Reorder splats by first use and drop unused ones, for locality; also return their order."""
    order, entries = tiles.number_by_use(layer.entries, len(layer.splats))
    used = Layer(
        layer.splats[order], layer.opacities[order], layer.boxes[order], layer.tile_start, entries
    )
    return used, order


def check_lengths(gaussians: GaussianArrays) -> int:
    """Return the number of Gaussians; raise ValueError if the arrays differ in length."""
    lengths = {len(array) for array in gaussians}
    if len(lengths) > 1:
        raise ValueError(f"the fields of Gaussians have different lengths: {sorted(lengths)}")
    return lengths.pop()


def to_float32(values: Tensor) -> Float32[ndarray, "..."]:
    """Convert a tensor to a contiguous array, without copying if it is one already."""
    return values.detach().to("cpu", torch.float32).contiguous().numpy()
