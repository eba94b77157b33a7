"""Draws on a GPU through gsplat >= 1.5.

Not verified: this file was written without a GPU at hand and has never been run. Its tests carry
the marker `gpu` and compare it with the reference renderer; run `pytest -m gpu` on a machine that
has a GPU and gsplat before relying on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.render import OpacityRender
from gscompleter.types import Camera, Gaussians, Render, merge


@dataclass(frozen=True)
class CudaRenderer:
    """Draws where the Gaussians lie, which must be a CUDA device.

    Raises:
        InputError: where torch sees no GPU, or gsplat is not installed.
    """

    def __post_init__(self) -> None:
        if not torch.cuda.is_available():
            raise InputError("The cuda renderer needs a GPU, and torch sees none; use cpu.")
        try:
            import gsplat  # noqa: F401
        except ImportError as error:
            raise InputError(
                "The cuda renderer draws through gsplat, which is not installed; "
                "run `pip install gscompleter[cuda]`."
            ) from error

    def render(self, gaussians: Gaussians, camera: Camera) -> Render:
        from gsplat import rasterization

        if len(gaussians) == 0:
            empty = torch.zeros(camera.height, camera.width, device=gaussians.means.device)
            return Render(empty[..., None].expand(-1, -1, 3), empty, empty)
        camera = camera.to(gaussians.means.device)
        colour_and_depth, alpha, _ = rasterization(
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
            rasterize_mode="classic",
        )
        return Render(colour_and_depth[0, ..., :3], colour_and_depth[0, ..., 3], alpha[0, ..., 0])

    def freeze(self, context: Gaussians, camera: Camera) -> CudaView:
        return CudaView(self, context, camera)


@dataclass(frozen=True)
class CudaView:
    """A frozen view that draws everything anew each time."""

    renderer: CudaRenderer
    scene: Gaussians
    camera: Camera

    @cached_property
    def context(self) -> Render:
        """The context alone."""
        with torch.no_grad():
            return self.renderer.render(self.scene, self.camera)

    def composite(self, new: Gaussians) -> Render:
        """Context and `new` together."""
        return self.renderer.render(merge([self.scene, new]), self.camera)

    def plan(self, new: Gaussians) -> OpacityRender:
        """Context and `new` with other opacities."""

        def render(opacities: Float[Tensor, "n"]) -> Render:
            return self.composite(replace(new, opacities=opacities))

        return render
