"""A renderer for NVIDIA GPUs through gsplat 1.5.

Everything here avoids to wait for the GPU: the host runs ahead of it and queues work, and each
value that it reads, or each copy that it has to see finished, stops it for some 30 µs. What waits
inevitably is the number of tile intersections, which gsplat reads to allocate memory.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor

from gscompleter.numerics.geometry import move_to_depths
from gscompleter.render.device import choose_device
from gscompleter.render.padding import compute_covariances
from gscompleter.render.protocols import ColorErrors, ColorSums, DepthRender, OpacityRender
from gscompleter.render.redraw import make_empty_render
from gscompleter.render.spherical_harmonics import evaluate_colors
from gscompleter.types import Camera, Gaussians, Render, merge, sh_from_rgb

MIN_DIVIDING_ALPHA = 1e-10
"""Smallest alpha that gsplat divides a depth by."""
TILE_SIZE = 16
"""Side of a tile in pixels, gsplat's default."""
GAUSSIAN_BLOCK = 2**18
"""Gaussians of which colours, or covariances in padded images, are computed at a time: harmonics of
degree 3 take 500 bytes each with the basis that they are summed with, and covariances 300."""

T = TypeVar("T")


class LastView:
    """Keep what was computed of the frozen scene that was used last.

    The same of all frozen scenes at once would be most of the memory of a GPU, and several steps in
    turn use it of one.
    """

    def __init__(self) -> None:
        self._owner: weakref.ref[CudaFrozenScene] | None = None
        self._values: dict[str, object] = {}

    def compute(self, owner: CudaFrozenScene, name: str, make: Callable[[], T]) -> T:
        """Return what `make` computes of a frozen scene, or what it computed before."""
        if self._owner is None or self._owner() is not owner:
            # What is known of another one is freed before more is made.
            self._values = {}
            self._owner = weakref.ref(owner, self._forget)
        values = self._values
        if name not in values:
            values[name] = make()
        return values[name]  # type: ignore[return-value]

    def _forget(self, gone: weakref.ref[CudaFrozenScene]) -> None:
        """Free what was computed of a frozen scene that is gone."""
        if self._owner is gone:
            self._owner = None
            self._values = {}


@dataclass(frozen=True)
class CudaRenderer:
    """Renders on the device of the Gaussians, which must be a CUDA device."""

    last_view: LastView = field(default_factory=LastView, compare=False, repr=False)

    def __post_init__(self) -> None:
        choose_device("cuda")

    def render(self, gaussians: Gaussians, camera: Camera) -> Render:
        """Render `gaussians` from `camera`."""
        (render,) = self.render_together(gaussians, [camera])
        return render

    def render_together(self, gaussians: Gaussians, cameras: Sequence[Camera]) -> list[Render]:
        """Render `gaussians` from all cameras at once; the host waits once for all of them."""
        if len(gaussians) == 0:
            return [make_empty_render(camera, gaussians.means.device) for camera in cameras]
        colors = torch.stack([compute_colors(gaussians, camera) for camera in cameras])
        return project_and_bin(drop_colors(gaussians), cameras).render(colors)

    def freeze(self, context: Gaussians, camera: Camera) -> CudaFrozenScene:
        """Prepare `context` for many renders from `camera`."""
        return CudaFrozenScene(self, camera, (self.show_from(context, camera),))

    def show_from(self, gaussians: Gaussians, camera: Camera) -> SeenPart:
        """Find the Gaussians that a camera sees, in the colours that it sees.

        Colours of one camera are fixed, so that harmonics need not be kept and evaluated again.
        """
        rows = self.find_visible(gaussians, camera).nonzero()[:, 0]
        center = camera.center.to(gaussians.means.device)
        colors = [
            evaluate_colors(gaussians.sh[block], gaussians.means[block], center)
            for block in rows.split(GAUSSIAN_BLOCK)
        ]
        return SeenPart(drop_colors(gaussians), rows, sh_from_rgb(torch.cat(colors)))

    @torch.no_grad()
    def find_visible(self, gaussians: Gaussians, camera: Camera) -> Bool[Tensor, "n"]:
        """Return True for Gaussians whose box touches the image: gsplat gives them a radius."""
        if len(gaussians) == 0:
            return torch.zeros_like(gaussians.generated, dtype=torch.bool)
        radii, *_ = project_with_gsplat(gaussians, [camera])
        return (radii[0] > 0).all(dim=-1)

    @torch.no_grad()
    def bin_gaussians(self, gaussians: Gaussians, camera: Camera) -> BinnedGaussians:
        """Project Gaussians, sort them by depth and bin them into the tiles of an image."""
        if len(gaussians) == 0:
            return BinnedGaussians.empty(camera, gaussians.means.device)
        return project_and_bin(gaussians, [camera])


def drop_colors(gaussians: Gaussians) -> Gaussians:
    """Drop harmonics, and what a writer needs; the rest is shared, and one zero stands for all."""
    zero = gaussians.means.new_zeros((1, 1, 3))
    return replace(gaussians, sh=zero.expand(len(gaussians), 1, 3), encoded=None)


def project_with_gsplat(
    gaussians: Gaussians, cameras: Sequence[Camera]
) -> tuple[
    Int[Tensor, "c n 2"],
    Float[Tensor, "c n 2"],
    Float[Tensor, "c n"],
    Float[Tensor, "c n 3"],
    Float[Tensor, "c n"],
]:
    """Project at least one Gaussian into images of one size, with one near plane and one blur.

    An image with padding has to be the only one.

    Returns radii [c, n, 2] in pixels, which are 0 outside of the image, centres [c, n, 2], z-depths
    [c, n], inverse covariances [c, n, 3], and the factors [c, n] by which antialiasing lowers
    opacities. Gsplat's kernels take float32 alone.
    """
    from gsplat import fully_fused_projection

    cameras = [camera.to(gaussians.means.device) for camera in cameras]
    # Covariances, or quaternions and scales in their place
    shapes: tuple[Tensor | None, ...]
    shapes = (None, gaussians.quats.float(), gaussians.scales.float())
    if cameras[0].padding != (0, 0):
        (camera,) = cameras
        parts = [
            compute_covariances(gaussians[start : start + GAUSSIAN_BLOCK], camera).float()
            for start in range(0, len(gaussians), GAUSSIAN_BLOCK)
        ]
        shapes = (parts[0] if len(parts) == 1 else torch.cat(parts), None, None)
    radii, means2d, depths, conics, antialiasing = fully_fused_projection(
        gaussians.means.float(),
        *shapes,
        torch.stack([camera.viewmat for camera in cameras]).float(),
        torch.stack([camera.K for camera in cameras]).float(),
        cameras[0].width,
        cameras[0].height,
        eps2d=cameras[0].blur,
        near_plane=cameras[0].near_plane,
        calc_compensations=gaussians.is_antialiased,
        opacities=gaussians.opacities.float(),
    )
    if antialiasing is None:
        antialiasing = depths.new_ones(()).expand_as(depths)
    return radii, means2d, depths, conics, antialiasing


def project_and_bin(
    gaussians: Gaussians, cameras: Sequence[Camera], num_only_first: int = 0
) -> BinnedGaussians:
    """Project at least one Gaussian, sort them by depth and bin them into the tiles of images.

    Images of several sizes share one that holds all of them. The first `num_only_first` Gaussians
    are in the first image alone.
    """
    from gsplat import isect_offset_encode, isect_tiles

    # Not as parts of a larger image: how much a Gaussian outside is distorted depends on the size.
    forms = {(c.width, c.height, c.near_plane, c.padding, c.blur) for c in cameras}
    are_alike = len(forms) == 1 and cameras[0].padding == (0, 0)
    groups = [cameras] if are_alike else [[camera] for camera in cameras]
    projected = [project_with_gsplat(gaussians, group) for group in groups]
    radii, means2d, depths, conics, antialiasing = (
        parts[0] if len(parts) == 1 else torch.cat(parts) for parts in zip(*projected, strict=True)
    )
    if num_only_first > 0:
        radii = radii.clone()
        radii[1:, :num_only_first] = 0
    sizes = [(camera.width, camera.height) for camera in cameras]
    num_tiles = tuple(-(-max(sides) // TILE_SIZE) for sides in zip(*sizes, strict=True))
    _, entries, rows = isect_tiles(
        means2d, radii, depths, TILE_SIZE, *num_tiles, n_images=len(cameras)
    )
    return BinnedGaussians(
        means2d=means2d,
        conics=conics,
        depths=depths,
        opacities=gaussians.opacities.float() * antialiasing,
        antialiasing=antialiasing,
        tile_offsets=isect_offset_encode(entries, len(cameras), *num_tiles),
        rows=rows,
        sizes=sizes,
    )


def compact(values: Int[Tensor, "n"], is_kept: Bool[Tensor, "n"], count: int) -> Int[Tensor, "m"]:
    """List the values to keep, which are `count`; the host, which knows it, waits for nothing."""
    place = is_kept.cumsum(0, dtype=torch.int32) - 1
    # All others go to one place behind them.
    place = place.where(is_kept, count).long()
    return values.new_empty(count + 1).scatter_(0, place, values)[:count]


def compute_colors(gaussians: Gaussians, camera: Camera) -> Float[Tensor, "n 3"]:
    """Compute the colours that `camera` sees, in one kernel of gsplat for all harmonics."""
    center = camera.center.to(gaussians.means)
    if gaussians.sh_degree == 0:
        return evaluate_colors(gaussians.sh, gaussians.means, center).float()
    from gsplat import spherical_harmonics

    directions = (gaussians.means - center).float()  # the kernel normalizes them
    colors = spherical_harmonics(gaussians.sh_degree, directions, gaussians.sh.float())
    return (colors + 0.5).clamp_min(0)


@dataclass(frozen=True)
class BinnedGaussians:
    """Gaussians that are projected, sorted and binned into the tiles of the images of c cameras.

    As long as neither they nor the cameras move, images in other colours and opacities need no more
    than to composite them. Rows of Gaussians that an image does not show are unset memory, which no
    tile names.
    """

    means2d: Float[Tensor, "c n 2"]
    conics: Float[Tensor, "c n 3"]
    """Inverse covariances in the image, upper triangles, in 1/px²."""
    depths: Float[Tensor, "c n"]
    """z-depths in scene units."""
    opacities: Float[Tensor, "c n"]
    """Opacities as they are composited, lowered if antialiased."""
    antialiasing: Float[Tensor, "c n"]
    """Factor by which antialiasing lowers each opacity; 1 without it."""
    tile_offsets: Int[Tensor, "c tile_h tile_w"]
    """Index in `rows` of the first Gaussian of each tile."""
    rows: Int[Tensor, "intersections"]
    """Gaussians of the tiles, one tile after the other, the nearest first."""
    sizes: Sequence[tuple[int, int]]
    """Width and height of each image, which is the upper left part of a shared one."""

    @staticmethod
    def empty(camera: Camera, device: torch.device) -> BinnedGaussians:
        """Return no Gaussians, in an image without tiles."""
        none = torch.zeros(1, 0, device=device)
        rows = torch.zeros(0, dtype=torch.int32, device=device)
        return BinnedGaussians(
            means2d=none[..., None].expand(-1, -1, 2),
            conics=none[..., None].expand(-1, -1, 3),
            depths=none,
            opacities=none,
            antialiasing=none,
            tile_offsets=rows[None, None],
            rows=rows,
            sizes=[(camera.width, camera.height)],
        )

    def select_tiles(self, num_context: int) -> TileSelection:
        """Select the tiles of one image that show any but the first `num_context` Gaussians.

        Other tiles do not change with these. They, and Gaussians of the first that no selected tile
        shows, are dropped.
        """
        ((width, height),) = self.sizes
        starts = self.tile_offsets.flatten()
        if num_context == 0:
            everything = starts.new_ones((height, width), dtype=torch.bool)
            return TileSelection(self, starts.new_empty(0, dtype=torch.int64), everything)
        counts = torch.cat([starts[1:], starts.new_full((1,), len(self.rows))]) - starts
        is_selected, is_kept = self.find_tiles_behind(num_context, counts)
        count = self.depths.shape[1]
        # Entries of other tiles mark a row behind the last one.
        is_used = torch.zeros(count + 1, dtype=torch.bool, device=starts.device)
        is_used.index_fill_(0, self.rows.where(is_kept, count).long(), True)
        is_used = is_used[:count]
        is_used[num_context:] = True
        # The host waits once, for both numbers.
        num_kept, num_used = torch.stack([is_kept.sum(), is_used.sum()]).tolist()
        rows = compact(self.rows, is_kept, num_kept).long()
        used = compact(torch.arange(count, device=starts.device), is_used, num_used)
        place = is_used.cumsum(0, dtype=torch.int32) - 1
        counts = counts * is_selected
        offsets = (counts.cumsum(0, dtype=torch.int32) - counts).to(starts.dtype)
        antialiasing = self.antialiasing
        # Without antialiasing one number stands for all factors.
        is_plain = antialiasing.stride()[-1] == 0
        binned = replace(
            self,
            means2d=self.means2d.index_select(1, used),
            conics=self.conics.index_select(1, used),
            depths=self.depths.index_select(1, used),
            opacities=self.opacities.index_select(1, used),
            antialiasing=antialiasing[:, :num_used]
            if is_plain
            else antialiasing.index_select(1, used),
            tile_offsets=offsets.view(self.tile_offsets.shape),
            rows=place[rows].to(self.rows.dtype),
        )
        _, tall, wide = self.tile_offsets.shape
        # Each tile is repeated over its pixels, of which those at the border lie outside.
        squares = is_selected.view(tall, 1, wide, 1).expand(tall, TILE_SIZE, wide, TILE_SIZE)
        pixels = squares.reshape(tall * TILE_SIZE, wide * TILE_SIZE)[:height, :width]
        num_new = count - num_context
        return TileSelection(binned, used[: num_used - num_new].clone(), pixels)

    def find_tiles_behind(
        self, num_context: int, counts: Int[Tensor, "tiles"]
    ) -> tuple[Bool[Tensor, "tiles"], Bool[Tensor, "intersections"]]:
        """Find the tiles that show any but the first Gaussians, and the entries of these tiles.

        `counts` are those of the entries of all tiles.
        """
        numbers = torch.arange(len(counts), dtype=torch.int32, device=counts.device)
        tiles = numbers.repeat_interleave(counts, output_size=len(self.rows))
        new_entries = (self.rows >= num_context).to(counts.dtype)
        is_selected = torch.zeros_like(counts).index_add_(0, tiles, new_entries) > 0
        return is_selected, is_selected[tiles]

    def render(
        self, colors: Float[Tensor, "c n 3"], opacities: Float[Tensor, "c n"] | None = None
    ) -> list[Render]:
        """Render in these colours, and opacities at most those of the Gaussians."""
        # The depth is composited as a fourth colour, and divided by alpha as in "RGB+ED".
        sums, alpha = self.composite(torch.cat([colors, self.depths[..., None]], dim=-1), opacities)
        depth = sums[..., 3] / alpha.clamp_min(MIN_DIVIDING_ALPHA)
        return [
            Render(
                sums[i, :height, :width, :3], depth[i, :height, :width], alpha[i, :height, :width]
            )
            for i, (width, height) in enumerate(self.sizes)
        ]

    def composite(
        self, values: Float[Tensor, "c n v"], opacities: Float[Tensor, "c n"] | None = None
    ) -> tuple[Float[Tensor, "c h w v"], Float[Tensor, "c h w"]]:
        """Composite values over zero: Σ_i w_ip value_i, and alpha; differentiable in both inputs.

        `opacities` are those to composite with, at most `self.opacities`, which are the default.
        """
        width = max(width for width, _ in self.sizes)
        height = max(height for _, height in self.sizes)
        if values.shape[1] == 0:
            empty = values.new_zeros(len(self.sizes), height, width)
            return empty[..., None].expand(-1, -1, -1, values.shape[2]), empty
        from gsplat import rasterize_to_pixels

        sums, alphas = rasterize_to_pixels(
            self.means2d,
            self.conics,
            values,
            self.opacities if opacities is None else opacities,
            width,
            height,
            TILE_SIZE,
            self.tile_offsets,
            self.rows,
        )
        return sums, alphas[..., 0]

    def backproject(
        self, values: Float[Tensor, "n v"], image: Float[Tensor, "h w v"]
    ) -> Float[Tensor, "n v"]:
        """Sum an image over the compositing weights of each Gaussian: Σ_p w_ip image_p.

        A compositing weight is the derivative of a pixel in the value of the Gaussian, whatever
        the `values` are. There is one camera.
        """
        with torch.enable_grad():
            leaf = values.detach().requires_grad_()
            sums, _ = self.composite(leaf[None])
        (gradient,) = torch.autograd.grad(sums, leaf, image[None])
        return gradient


@dataclass(frozen=True)
class TileSelection:
    """Some tiles of an image, and the Gaussians that they show."""

    binned: BinnedGaussians
    """These Gaussians, in these tiles; all other tiles are empty."""
    context: Int64[Tensor, "used_context"]
    """Rows of those that do not change; after them come all that do."""
    pixels: Bool[Tensor, "h w"]
    """True in the tiles."""

    def paste(self, drawn: Render, around: Render) -> Render:
        """Put what is drawn in the tiles into a render of those that do not change."""
        return Render(
            torch.where(self.pixels[..., None], drawn.image, around.image),
            torch.where(self.pixels, drawn.depth, around.depth),
            torch.where(self.pixels, drawn.alpha, around.alpha),
        )


@dataclass(frozen=True)
class SeenPart:
    """Hold what a camera sees of a part of a scene; all but the colours is shared with that."""

    geometry: Gaussians
    """The whole part, without colours."""
    rows: Int64[Tensor, "seen"]
    """Rows of the visible ones."""
    sh: Float[Tensor, "seen 1 3"]
    """Their colours, as harmonics of degree 0."""

    def gather(self) -> Gaussians:
        """Copy the visible ones."""
        return replace(self.geometry[self.rows], sh=self.sh)


@dataclass(frozen=True)
class CudaFrozenScene:
    """A frozen scene that holds which Gaussians its camera sees, and in which colours.

    Each composite still projects and sorts all of them, since new ones may lie anywhere in between.
    What varies in opacity or colour alone is drawn only in the tiles that show it.
    """

    renderer: CudaRenderer
    camera: Camera
    parts: tuple[SeenPart, ...]

    @property
    def count(self) -> int:
        """Number of Gaussians of the scene, visible or not."""
        return sum(len(part.geometry) for part in self.parts)

    @property
    def rows(self) -> Int64[Tensor, "seen"]:
        """Row of each Gaussian of `scene` in all of the frozen ones."""
        start = 0
        rows = []
        for part in self.parts:
            rows.append(start + part.rows)
            start += len(part.geometry)
        return torch.cat(rows)

    @property
    def num_seen(self) -> int:
        """Number of visible Gaussians."""
        return sum(len(part.rows) for part in self.parts)

    @property
    def scene(self) -> Gaussians:
        """The visible Gaussians, in the colours that the camera sees."""
        return self.renderer.last_view.compute(
            self, "scene", lambda: merge([part.gather() for part in self.parts])
        )

    @property
    def bins(self) -> BinnedGaussians:
        """The visible Gaussians, binned for images in other colours."""
        return self.renderer.last_view.compute(
            self, "bins", lambda: self.renderer.bin_gaussians(self.scene, self.camera)
        )

    @cached_property
    def render(self) -> Render:
        """The render of the scene alone."""
        with torch.no_grad():
            return self.renderer.render(self.scene, self.camera)

    def extend(self, new: Gaussians) -> CudaFrozenScene:
        """Add those of `new` that are visible."""
        return replace(self, parts=(*self.parts, self.renderer.show_from(new, self.camera)))

    def freeze_occluders(self, others: Gaussians) -> CudaFrozenScene:
        """Freeze those of `others` that are visible."""
        return self.renderer.freeze(others, self.camera)

    def repaint(self, rows: Int64[Tensor, "m"], painted: Gaussians) -> CudaFrozenScene:
        """Give the visible ones among the Gaussians at `rows` new colours."""
        place = rows.new_full((self.count,), -1)
        place[rows] = torch.arange(len(rows), device=rows.device)
        sources = place[self.rows]
        painted_here = (sources >= 0).nonzero()[:, 0]
        new = painted[sources[painted_here]]
        center = self.camera.center.to(new.means.device)
        colors = sh_from_rgb(evaluate_colors(new.sh, new.means, center))
        sh = torch.cat([part.sh for part in self.parts]).index_copy(0, painted_here, colors)
        of_parts = sh.split([len(part.rows) for part in self.parts])
        # Copied: a part of a tensor would hold all of it.
        parts = [
            replace(part, sh=own.clone()) for part, own in zip(self.parts, of_parts, strict=True)
        ]
        return replace(self, parts=tuple(parts))

    def backproject(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        """Sum `image` over the compositing weights; they are 0 for invisible Gaussians."""
        sums = image.new_zeros((self.count, 3))
        if self.num_seen == 0:
            return sums
        seen = self.bins.backproject(sums.new_zeros((self.num_seen, 3)), image)
        return sums.index_copy(0, self.rows, seen)

    def splat(self, values: Float[Tensor, "n"]) -> Float[Tensor, "h w"]:
        """Render the visible Gaussians with the values as grey."""
        seen = values[self.rows]
        sums, _ = self.bins.composite(seen[None, :, None])
        return sums[0, ..., 0]

    def composite(self, new: Gaussians) -> Render:
        """Render the visible Gaussians and `new`."""
        both, colors = self.join(new, [self.camera])
        if len(both) == 0:
            return make_empty_render(self.camera, new.means.device)
        (render,) = project_and_bin(both, [self.camera]).render(colors)
        return render

    def composite_beside(self, new: Gaussians, other: Camera) -> tuple[Render, Render]:
        """Render the visible Gaussians and `new`, and at once `new` alone from another camera."""
        cameras = [self.camera, other]
        both, colors = self.join(new, cameras)
        if len(both) == 0:
            here, there = (make_empty_render(camera, new.means.device) for camera in cameras)
        else:
            here, there = project_and_bin(both, cameras, self.num_seen).render(colors)
        return here, there

    def join(
        self, new: Gaussians, cameras: Sequence[Camera]
    ) -> tuple[Gaussians, Float[Tensor, "c n 3"]]:
        """Join the visible Gaussians and `new`, and their colours at cameras.

        Without harmonics: of the visible ones, too, those of degree 3 would be joined.
        """
        context = compute_colors(self.scene, self.camera)
        colors = [torch.cat([context, compute_colors(new, camera)]) for camera in cameras]
        return merge([drop_colors(self.scene), drop_colors(new)]), torch.stack(colors)

    def vary_opacities(self, new: Gaussians, is_fading: bool = False) -> OpacityRender:
        """Fix all of `new` but the opacities, with boxes that hold for every opacity to come.

        Fainter Gaussians render the same in the larger box, where alpha 1/255 drops the rest.
        """
        with torch.no_grad():
            colors = compute_colors(new, self.camera)
        new = drop_colors(new)
        rows = None
        if is_fading:
            rows = new.opacities.nonzero()[:, 0]
            new = new[rows]
            colors = colors[rows]
        else:
            new = replace(new, opacities=torch.ones_like(new.opacities))
        selection = self.select_tiles(new)
        context = selection.context
        fixed = self.scene.opacities[context]
        shown = compute_colors(self.scene, self.camera)[context]
        binned = selection.binned
        drawn_colors = torch.cat([shown, colors])[None]

        def render(opacities: Float[Tensor, "n"]) -> Render:
            varied = opacities if rows is None else opacities[rows]
            drawn_opacities = binned.antialiasing * torch.cat([fixed, varied]).float()
            (drawn,) = binned.render(drawn_colors, drawn_opacities)
            return selection.paste(drawn, self.render)

        return render

    def vary_colors(self, new: Gaussians) -> ColorErrors:
        """Fix all of `new` but its colours, in one forward and one backward pass per call."""
        selection = self.select_tiles(drop_colors(new))
        binned = selection.binned
        shown = compute_colors(self.scene, self.camera)[selection.context]

        def measure_errors(
            colors: Float[Tensor, "n 3"], photograph: Float[Tensor, "h w 3"]
        ) -> ColorSums:
            if len(new) == 0:
                return colors.new_zeros(0, 3), colors.new_zeros(0)
            with torch.enable_grad():
                # The fourth channel is not drawn: its gradient sums the weights alone.
                leaf = torch.nn.functional.pad(colors.clamp_min(0), (0, 1)).requires_grad_()
                drawn = torch.nn.functional.pad(shown, (0, 1))
                sums, _ = binned.composite(torch.cat([drawn, leaf])[None])
            # The gradient of Σ image · drawn in a colour is Σ_p w_ip image_p; ones in the fourth
            # channel give Σ_p w_ip. Beside the tiles nothing new has a weight.
            missing = photograph - sums[0, ..., :3].detach()
            image = torch.nn.functional.pad(missing, (0, 1), value=1.0)
            (gradient,) = torch.autograd.grad(sums, leaf, image[None])
            return gradient[:, :3], gradient[:, 3]

        return measure_errors

    def select_tiles(self, new: Gaussians) -> TileSelection:
        """Bin the visible Gaussians and `new`, and select the tiles that show any of these."""
        both = merge([drop_colors(self.scene), new])
        return self.renderer.bin_gaussians(both, self.camera).select_tiles(self.num_seen)

    def vary_depths(self, new: Gaussians) -> DepthRender:
        """Fix all of `new` but its depths."""
        return lambda depths: self.composite(move_to_depths(new, self.camera, depths))
