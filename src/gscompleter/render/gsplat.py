"""A renderer for NVIDIA GPUs through gsplat 1.5.

Everything here avoids to wait for the GPU: the host runs ahead of it and queues work, and each
value that it reads, or each copy that it has to see finished, stops it for some 30 µs. What waits
inevitably is the number of tile intersections, which gsplat reads to allocate memory.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor

from gscompleter.render.device import choose_device
from gscompleter.render.protocols import ColorErrors, ColorSums, OpacityRender
from gscompleter.render.redraw import RedrawnScene, set_colors
from gscompleter.render.spherical_harmonics import evaluate_colors
from gscompleter.types import Camera, Gaussians, Render, merge

EPS_2D = 0.3
"""Low-pass of 3DGS: pixels² that are added to the variances of each footprint."""
MIN_ALPHA = 1e-10
"""Smallest alpha that gsplat divides a depth by."""


@dataclass(frozen=True)
class CudaRenderer:
    """Renders on the device of the Gaussians, which must be a CUDA device."""

    def __post_init__(self) -> None:
        choose_device("cuda")

    def render(self, gaussians: Gaussians, camera: Camera) -> Render:
        """Render `gaussians` from `camera`."""
        if len(gaussians) == 0:
            empty = torch.zeros(camera.height, camera.width, device=gaussians.means.device)
            return Render(empty[..., None].expand(-1, -1, 3), empty, empty)
        color_and_depth, alpha, _ = self.rasterize(gaussians, camera)
        return Render(color_and_depth[0, ..., :3], color_and_depth[0, ..., 3], alpha[0, ..., 0])

    def freeze(self, context: Gaussians, camera: Camera) -> CudaFrozenScene:
        """Prepare `context` for many renders from `camera`."""
        rows = torch.arange(len(context), device=context.means.device)
        return CudaFrozenScene(self, context, camera, rows, len(context))

    @torch.no_grad()
    def find_visible(self, gaussians: Gaussians, camera: Camera) -> Bool[Tensor, "n"]:
        """Return True for Gaussians whose box touches the image: gsplat gives them a radius."""
        if len(gaussians) == 0:
            return torch.zeros_like(gaussians.generated, dtype=torch.bool)
        from gsplat import fully_fused_projection

        camera = camera.to(gaussians.means.device)
        radii, *_ = fully_fused_projection(
            gaussians.means.float(),
            None,  # covariances: quaternions and scales stand for them
            gaussians.quats.float(),
            gaussians.scales.float(),
            camera.viewmat[None].float(),
            camera.K[None].float(),
            camera.width,
            camera.height,
            eps2d=EPS_2D,
            near_plane=camera.near_plane,
            opacities=gaussians.opacities.float(),
        )
        return (radii[0] > 0).all(dim=-1)

    @torch.no_grad()
    def bin_gaussians(self, gaussians: Gaussians, camera: Camera) -> BinnedGaussians:
        """Project Gaussians, sort them by depth and bin them into the tiles of an image."""
        if len(gaussians) == 0:
            return BinnedGaussians.empty(camera, gaussians.means.device)
        # Rasterizing also returns what gsplat projected and sorted; the image is not used.
        _, _, projected = self.rasterize(gaussians, camera)
        before = gaussians.opacities.float()
        after = projected["opacities"].reshape(-1)
        return BinnedGaussians(
            means2d=projected["means2d"],
            conics=projected["conics"],
            depths=projected["depths"],
            opacities=after[None],
            antialiasing=torch.where(before > 0, after / before, 0.0),
            tile_size=projected["tile_size"],
            tile_offsets=projected["isect_offsets"],
            rows=projected["flatten_ids"],
            width=camera.width,
            height=camera.height,
        )

    def vary_opacities(self, gaussians: Gaussians, camera: Camera) -> OpacityRender:
        """Project, sort and bin once; the opacities [n] must not exceed those of `gaussians`.

        Fainter Gaussians render the same in the larger box, where alpha 1/255 drops the rest.
        """
        binned = self.bin_gaussians(gaussians, camera)
        # The depth is composited as a fourth colour, and divided by alpha as in "RGB+ED".
        with torch.no_grad():
            colors = compute_colors(gaussians, camera)
            values = torch.cat([colors, binned.depths[0, :, None]], dim=-1)

        def render(opacities: Float[Tensor, "n"]) -> Render:
            sums, alpha = binned.composite(values, binned.antialiasing * opacities)
            return Render(sums[..., :3], sums[..., 3] / alpha.clamp_min(MIN_ALPHA), alpha)

        return render

    def rasterize(
        self, gaussians: Gaussians, camera: Camera
    ) -> tuple[Float[Tensor, "1 h w 4"], Float[Tensor, "1 h w 1"], dict[str, Any]]:
        """Rasterize at least one Gaussian: colour and depth, alpha, and gsplat's metadata.

        gsplat's kernels take float32 alone. Colours are computed here: given harmonics, gsplat
        inverts the view matrix to find the camera's centre, and the host waits for that.
        """
        from gsplat import rasterization

        camera = camera.to(gaussians.means.device)
        color_and_depth, alpha, metadata = rasterization(
            means=gaussians.means.float(),
            quats=gaussians.quats.float(),
            scales=gaussians.scales.float(),
            opacities=gaussians.opacities.float(),
            colors=compute_colors(gaussians, camera),
            viewmats=camera.viewmat[None].float(),
            Ks=camera.K[None].float(),
            width=camera.width,
            height=camera.height,
            near_plane=camera.near_plane,
            eps2d=EPS_2D,
            sh_degree=None,
            packed=False,
            render_mode="RGB+ED",  # the depth is already divided by alpha
            rasterize_mode="antialiased" if gaussians.is_antialiased else "classic",
        )
        return color_and_depth, alpha, metadata


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
    """Gaussians that are projected, sorted and binned into the tiles of one camera's image.

    As long as neither they nor the camera move, images in other colours and opacities need no more
    than to composite them. Rows of Gaussians that the image does not show are unset memory, which
    no tile names.
    """

    means2d: Float[Tensor, "1 n 2"]
    conics: Float[Tensor, "1 n 3"]
    """Inverse covariances in the image, upper triangles, in 1/px²."""
    depths: Float[Tensor, "1 n"]
    """z-depths in scene units."""
    opacities: Float[Tensor, "1 n"]
    """Opacities as they are composited, lowered if antialiased."""
    antialiasing: Float[Tensor, "n"]
    """Factor by which antialiasing lowers each opacity; 1 without it."""
    tile_size: int
    tile_offsets: Int[Tensor, "1 tile_h tile_w"]
    """Index in `rows` of the first Gaussian of each tile."""
    rows: Int[Tensor, "intersections"]
    """Gaussians of the tiles, one tile after the other, the nearest first."""
    width: int
    height: int

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
            antialiasing=none[0],
            tile_size=16,
            tile_offsets=rows[None, None],
            rows=rows,
            width=camera.width,
            height=camera.height,
        )

    def composite(
        self, values: Float[Tensor, "n c"], opacities: Float[Tensor, "n"] | None = None
    ) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
        """Composite values over zero: Σ_i w_ip value_i, and alpha; differentiable in both inputs.

        `opacities` are those to composite with, at most `self.opacities`, which are the default.
        """
        if values.shape[0] == 0:
            empty = values.new_zeros(self.height, self.width)
            return empty[..., None].expand(-1, -1, values.shape[1]), empty
        from gsplat import rasterize_to_pixels

        sums, alphas = rasterize_to_pixels(
            self.means2d,
            self.conics,
            values[None],
            self.opacities if opacities is None else opacities[None],
            self.width,
            self.height,
            self.tile_size,
            self.tile_offsets,
            self.rows,
        )
        return sums[0], alphas[0, ..., 0]

    def backproject(
        self, values: Float[Tensor, "n c"], image: Float[Tensor, "h w c"]
    ) -> Float[Tensor, "n c"]:
        """Sum an image over the compositing weights of each Gaussian: Σ_p w_ip image_p.

        A compositing weight is the derivative of a pixel in the value of the Gaussian, whatever
        the `values` are.
        """
        with torch.enable_grad():
            leaf = values.detach().requires_grad_()
            sums, _ = self.composite(leaf)
        (gradient,) = torch.autograd.grad(sums, leaf, image)
        return gradient


@dataclass(frozen=True)
class CudaFrozenScene(RedrawnScene):
    """A frozen scene that keeps only Gaussians visible to its camera.

    Each composite still projects and sorts all of them, since new ones may lie anywhere in between.
    """

    renderer: CudaRenderer
    rows: Int64[Tensor, "m"]
    """Index in the context of each Gaussian of `scene`."""
    count: int
    """Number of Gaussians of the context."""

    @cached_property
    def visible_rows(self) -> Int64[Tensor, "seen"]:
        """Indices in `scene` of the Gaussians that reach the image."""
        return self.renderer.find_visible(self.scene, self.camera).nonzero()[:, 0]

    @cached_property
    def visible_scene(self) -> Gaussians:
        """The visible Gaussians, with their colours as this camera sees them."""
        # Colours of one camera are fixed, so that harmonics need not be evaluated in each render.
        kept = self.scene[self.visible_rows]
        center = self.camera.center.to(kept.means.device)
        colors = evaluate_colors(kept.sh, kept.means, center)
        return set_colors(kept, colors)

    @cached_property
    def visible_bins(self) -> BinnedGaussians:
        """The visible Gaussians, binned for images in other colours."""
        return self.renderer.bin_gaussians(self.visible_scene, self.camera)

    def extend(self, new: Gaussians) -> CudaFrozenScene:
        """Add `new` to the visible Gaussians."""
        # Rows count all Gaussians that were ever added, visible or not, as their owner does.
        numbers = self.count + torch.arange(len(new), device=self.rows.device)
        rows = torch.cat([self.rows[self.visible_rows], numbers])
        count = self.count + len(new)
        return replace(self, scene=merge([self.visible_scene, new]), rows=rows, count=count)

    def backproject(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        """Sum `image` over the compositing weights; they are 0 for invisible Gaussians."""
        sums = image.new_zeros((self.count, 3))
        if len(self.visible_rows) == 0:
            return sums
        values = torch.zeros_like(self.visible_scene.means)
        seen = self.visible_bins.backproject(values, image)
        return sums.index_copy(0, self.rows[self.visible_rows], seen)

    def splat(self, values: Float[Tensor, "n"]) -> Float[Tensor, "h w"]:
        """Render the visible Gaussians with the values as grey."""
        seen = values[self.rows[self.visible_rows]]
        sums, _ = self.visible_bins.composite(seen[:, None])
        return sums[..., 0]

    def vary_opacities(self, new: Gaussians) -> OpacityRender:
        """Fix all of `new` but the opacities, with boxes that hold for every opacity."""
        opaque = replace(new, opacities=torch.ones_like(new.opacities))
        render = self.renderer.vary_opacities(merge([self.visible_scene, opaque]), self.camera)
        return lambda opacities: render(torch.cat([self.visible_scene.opacities, opacities]))

    def vary_colors(self, new: Gaussians) -> ColorErrors:
        """Fix all of `new` but its colours, in one forward and one backward pass per call."""
        binned = self.renderer.bin_gaussians(merge([self.visible_scene, new]), self.camera)
        context = compute_colors(self.visible_scene, self.camera)

        def measure_errors(
            colors: Float[Tensor, "n 3"], photograph: Float[Tensor, "h w 3"]
        ) -> ColorSums:
            if len(new) == 0:
                return colors.new_zeros(0, 3), colors.new_zeros(0)
            with torch.enable_grad():
                # The fourth channel is not drawn: its gradient sums the weights alone.
                leaf = torch.nn.functional.pad(colors.clamp_min(0), (0, 1)).requires_grad_()
                drawn = torch.nn.functional.pad(context, (0, 1))
                sums, _ = binned.composite(torch.cat([drawn, leaf]))
            # The gradient of Σ image · drawn in a colour is Σ_p w_ip image_p; ones in the fourth
            # channel give Σ_p w_ip.
            missing = photograph - sums[..., :3].detach()
            image = torch.nn.functional.pad(missing, (0, 1), value=1.0)
            (gradient,) = torch.autograd.grad(sums, leaf, image)
            return gradient[:, :3], gradient[:, 3]

        return measure_errors
