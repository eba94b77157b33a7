"""A renderer for GPUs through gsplat >= 1.5.

Not verified: this file was written without a GPU at hand and has never been run. Its tests carry
the marker `gpu` and compare it with the reference renderer; `make gpu` runs them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gscompleter.render import OpacityRender, choose_device
from gscompleter.render.redraw import RedrawnScene, set_colors
from gscompleter.render.spherical_harmonics import evaluate_colors
from gscompleter.types import Camera, Gaussians, Render, merge


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
        radii = self.rasterize(gaussians, camera)[2]["radii"]
        return (radii.reshape(len(gaussians), -1) > 0).all(dim=1)

    def vary_opacities(self, gaussians: Gaussians, camera: Camera) -> OpacityRender:
        """Project, sort and bin once; the opacities [n] must not exceed those of `gaussians`.

        Fainter Gaussians render the same in the larger box, where alpha 1/255 drops the rest.
        """
        from gsplat import rasterize_to_pixels

        with torch.no_grad():
            _, _, seen = self.rasterize(gaussians, camera)
            given, rendered = gaussians.opacities, seen["opacities"].reshape(-1)
            factors = torch.where(given > 0, rendered / given, 0.0)  # 1 unless antialiased
            center = camera.center.to(gaussians.means.device)
            colors = evaluate_colors(gaussians.sh, gaussians.means, center)
            values = torch.cat([colors[None], seen["depths"][..., None]], dim=-1)

        def render(opacities: Float[Tensor, "n"]) -> Render:
            drawn = seen["means2d"], seen["conics"], values, (factors * opacities)[None]
            tiles = seen["tile_size"], seen["isect_offsets"], seen["flatten_ids"]
            sums, alphas = rasterize_to_pixels(*drawn, camera.width, camera.height, *tiles)
            alpha = alphas[0, ..., 0]
            return Render(sums[0, ..., :3], sums[0, ..., 3] / alpha.clamp_min(1e-10), alpha)

        return render

    def rasterize(
        self, gaussians: Gaussians, camera: Camera
    ) -> tuple[Float[Tensor, "1 h w 4"], Float[Tensor, "1 h w 1"], dict[str, Any]]:
        """Rasterize at least one Gaussian: colour and depth, alpha, and gsplat's metadata."""
        from gsplat import rasterization

        camera = camera.to(gaussians.means.device)
        color_and_depth, alpha, found = rasterization(
            means=gaussians.means,
            quats=gaussians.quats,
            scales=gaussians.scales,
            opacities=gaussians.opacities,
            colors=gaussians.sh,
            viewmats=camera.viewmat[None],
            Ks=camera.K[None],
            width=camera.width,
            height=camera.height,
            near_plane=camera.near_plane,
            eps2d=0.3,
            sh_degree=gaussians.sh_degree,
            packed=False,
            render_mode="RGB+ED",  # the depth is already divided by alpha
            rasterize_mode="antialiased" if gaussians.is_antialiased else "classic",
        )
        return color_and_depth, alpha, found


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
        kept = self.scene[self.visible_rows]
        center = self.camera.center.to(kept.means.device)
        colors = evaluate_colors(kept.sh, kept.means, center)
        return set_colors(kept, colors)

    def extend(self, new: Gaussians) -> CudaFrozenScene:
        """Add `new` to the visible Gaussians."""
        numbers = self.count + torch.arange(len(new), device=self.rows.device)
        rows = torch.cat([self.rows[self.visible_rows], numbers])
        count = self.count + len(new)
        return replace(self, scene=merge([self.visible_scene, new]), rows=rows, count=count)

    def backproject(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        """Sum `image` over the compositing weights; they are 0 for invisible Gaussians."""
        sums = image.new_zeros((self.count, 3))
        return sums.index_copy(0, self.rows[self.visible_rows], super().backproject(image))

    def splat(self, values: Float[Tensor, "n"]) -> Float[Tensor, "h w"]:
        """Render the visible Gaussians with the values as grey."""
        return super().splat(values[self.rows[self.visible_rows]])

    def vary_opacities(self, new: Gaussians) -> OpacityRender:
        """Fix all of `new` but the opacities, with boxes that hold for every opacity."""
        opaque = replace(new, opacities=torch.ones_like(new.opacities))
        render = self.renderer.vary_opacities(merge([self.visible_scene, opaque]), self.camera)
        return lambda opacities: render(torch.cat([self.visible_scene.opacities, opacities]))
