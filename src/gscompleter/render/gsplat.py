"""A renderer for NVIDIA GPUs through gsplat 1.5.

Everything here avoids to wait for the GPU: the host runs ahead of it and queues work, and each
value that it reads, or each copy that it has to see finished, stops it for some 30 µs. What waits
inevitably is the number of tile intersections, which gsplat reads to allocate memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor

from gscompleter.render.device import choose_device
from gscompleter.render.padding import compute_covariances
from gscompleter.render.protocols import ColorErrors, ColorSums, OpacityRender
from gscompleter.render.redraw import RedrawnScene, make_empty_render, set_colors
from gscompleter.render.spherical_harmonics import evaluate_colors
from gscompleter.types import Camera, Gaussians, Render, merge, sh_from_rgb

MIN_DIVIDING_ALPHA = 1e-10
"""Smallest alpha that gsplat divides a depth by."""
TILE_SIZE = 16
"""Side of a tile in pixels, gsplat's default."""


@dataclass(frozen=True)
class CudaRenderer:
    """Renders on the device of the Gaussians, which must be a CUDA device."""

    def __post_init__(self) -> None:
        choose_device("cuda")

    def render(self, gaussians: Gaussians, camera: Camera) -> Render:
        """Render `gaussians` from `camera`."""
        (render,) = self.render_together(gaussians, [camera])
        return render

    def render_together(
        self, gaussians: Gaussians, cameras: Sequence[Camera], num_only_first: int = 0
    ) -> list[Render]:
        """Render `gaussians` from all cameras at once; the host waits once for all of them.

        The first `num_only_first` Gaussians show in the image of the first camera alone.
        """
        if len(gaussians) == 0:
            return [make_empty_render(camera, gaussians.means.device) for camera in cameras]
        binned = project_and_bin(gaussians, cameras, num_only_first)
        colors = torch.stack([compute_colors(gaussians, camera) for camera in cameras])
        return binned.render(colors)

    def freeze(self, context: Gaussians, camera: Camera) -> CudaFrozenScene:
        """Prepare `context` for many renders from `camera`."""
        rows, seen = self.show_from(context, camera)
        return CudaFrozenScene(self, seen, camera, rows, len(context))

    def show_from(
        self, gaussians: Gaussians, camera: Camera
    ) -> tuple[Int64[Tensor, "seen"], Gaussians]:
        """Return the Gaussians that a camera sees, in the colours that it sees, and their rows.

        Colours of one camera are fixed, so that harmonics need not be kept and evaluated again.
        """
        rows = self.find_visible(gaussians, camera).nonzero()[:, 0]
        # What a writer needs stays behind: a frozen scene is the most that a completion holds.
        seen = replace(gaussians, encoded=None)[rows]
        center = camera.center.to(seen.means.device)
        return rows, set_colors(seen, evaluate_colors(seen.sh, seen.means, center))

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

    def vary_opacities(self, gaussians: Gaussians, camera: Camera) -> OpacityRender:
        """Project, sort and bin once; the opacities [n] must not exceed those of `gaussians`.

        Fainter Gaussians render the same in the larger box, where alpha 1/255 drops the rest.
        """
        binned = self.bin_gaussians(gaussians, camera)
        with torch.no_grad():
            colors = compute_colors(gaussians, camera)[None]

        def render(opacities: Float[Tensor, "n"]) -> Render:
            (found,) = binned.render(colors, binned.antialiasing * opacities)
            return found

        return render


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
        shapes = (compute_covariances(gaussians, camera).float(), None, None)
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
class CudaFrozenScene(RedrawnScene):
    """A frozen scene that holds only Gaussians visible to its camera, in the colours it sees.

    Each composite still projects and sorts all of them, since new ones may lie anywhere in between.
    """

    renderer: CudaRenderer
    rows: Int64[Tensor, "seen"]
    """Row of each Gaussian of `scene` in the context and what was added to it since."""
    count: int
    """Number of Gaussians of the context and of what was added, visible or not."""

    @cached_property
    def bins(self) -> BinnedGaussians:
        """The Gaussians, binned for images in other colours."""
        return self.renderer.bin_gaussians(self.scene, self.camera)

    def extend(self, new: Gaussians) -> CudaFrozenScene:
        """Add those of `new` that are visible."""
        new_rows, seen = self.renderer.show_from(new, self.camera)
        rows = torch.cat([self.rows, self.count + new_rows])
        count = self.count + len(new)
        return replace(self, scene=merge([self.scene, seen]), rows=rows, count=count)

    def repaint(self, rows: Int64[Tensor, "m"], painted: Gaussians) -> CudaFrozenScene:
        """Give the visible ones among the Gaussians at `rows` new colours."""
        place = rows.new_full((self.count,), -1)
        place[rows] = torch.arange(len(rows), device=rows.device)
        sources = place[self.rows]
        painted_here = (sources >= 0).nonzero()[:, 0]
        new = painted[sources[painted_here]]
        center = self.camera.center.to(new.means.device)
        colors = sh_from_rgb(evaluate_colors(new.sh, new.means, center))
        sh = self.scene.sh.index_copy(0, painted_here, colors)
        return replace(self, scene=replace(self.scene, sh=sh))

    def backproject(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        """Sum `image` over the compositing weights; they are 0 for invisible Gaussians."""
        sums = image.new_zeros((self.count, 3))
        if len(self.rows) == 0:
            return sums
        seen = self.bins.backproject(torch.zeros_like(self.scene.means), image)
        return sums.index_copy(0, self.rows, seen)

    def splat(self, values: Float[Tensor, "n"]) -> Float[Tensor, "h w"]:
        """Render the visible Gaussians with the values as grey."""
        seen = values[self.rows]
        sums, _ = self.bins.composite(seen[None, :, None])
        return sums[0, ..., 0]

    def composite_beside(self, new: Gaussians, other: Camera) -> tuple[Render, Render]:
        """Render the visible Gaussians and `new`, and at once `new` alone from another camera."""
        both = merge([self.scene, new])
        here, there = self.renderer.render_together(
            both, [self.camera, other], num_only_first=len(self.scene)
        )
        return here, there

    def vary_opacities(self, new: Gaussians, is_fading: bool = False) -> OpacityRender:
        """Fix all of `new` but the opacities, with boxes that hold for every opacity to come."""
        if is_fading:
            rows = new.opacities.nonzero()[:, 0]
            render = self.renderer.vary_opacities(merge([self.scene, new[rows]]), self.camera)
            return lambda opacities: render(torch.cat([self.scene.opacities, opacities[rows]]))
        opaque = replace(new, opacities=torch.ones_like(new.opacities))
        render = self.renderer.vary_opacities(merge([self.scene, opaque]), self.camera)
        return lambda opacities: render(torch.cat([self.scene.opacities, opacities]))

    def vary_colors(self, new: Gaussians) -> ColorErrors:
        """Fix all of `new` but its colours, in one forward and one backward pass per call."""
        binned = self.renderer.bin_gaussians(merge([self.scene, new]), self.camera)
        context = compute_colors(self.scene, self.camera)

        def measure_errors(
            colors: Float[Tensor, "n 3"], photograph: Float[Tensor, "h w 3"]
        ) -> ColorSums:
            if len(new) == 0:
                return colors.new_zeros(0, 3), colors.new_zeros(0)
            with torch.enable_grad():
                # The fourth channel is not drawn: its gradient sums the weights alone.
                leaf = torch.nn.functional.pad(colors.clamp_min(0), (0, 1)).requires_grad_()
                drawn = torch.nn.functional.pad(context, (0, 1))
                sums, _ = binned.composite(torch.cat([drawn, leaf])[None])
            # The gradient of Σ image · drawn in a colour is Σ_p w_ip image_p; ones in the fourth
            # channel give Σ_p w_ip.
            missing = photograph - sums[0, ..., :3].detach()
            image = torch.nn.functional.pad(missing, (0, 1), value=1.0)
            (gradient,) = torch.autograd.grad(sums, leaf, image[None])
            return gradient[:, :3], gradient[:, 3]

        return measure_errors
