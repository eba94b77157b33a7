"""The renderer on the GPU of a Mac: the kernels of metal-gauss (MIT), behind our protocol.

The scene stays where it is, as torch on a Mac has no float64 and much of a completion needs it:
each call moves float32 copies to the GPU, and images and gradients back. metal-gauss has a slow
twin in plain PyTorch that runs anywhere, which its kernels and this adapter are tested against.
"""

from __future__ import annotations

import importlib.util
import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from gscompleter.numerics.geometry import compute_z_depths, remove_padding, resize_camera
from gscompleter.render.redraw import RedrawnScene, make_empty_render
from gscompleter.render.spherical_harmonics import evaluate_colors
from gscompleter.system.errors import InputError
from gscompleter.types import BLUR, Camera, Gaussians, Render

METAL_PACKAGE = "metal_gauss"


@dataclass(frozen=True)
class MetalRenderer:
    """Renders on `device`, whatever device the Gaussians lie on."""

    backend: Literal["metal", "torch_ref"] = "metal"
    """Kernels of metal-gauss, or its twin in PyTorch."""
    device: str = "mps"

    def __post_init__(self) -> None:
        """Raise InputError where it cannot draw."""
        missing = explain_missing_metal(self.device)
        if missing is not None:
            raise InputError(
                f"The device mps cannot draw: {missing}; choose the renderer cpu.",
                "renderer-device",
            )

    def render(self, gaussians: Gaussians, camera: Camera) -> Render:
        """Render `gaussians` from `camera`."""
        if camera.blur != BLUR:
            return self._draw_larger(gaussians, camera)
        drawn = self._draw(gaussians, camera)
        if camera.padding == (0, 0):
            return drawn
        # metal-gauss clamps tangents by the size of the image that it draws, and takes no
        # covariances. So the image within the padding is drawn by itself and put in its place.
        pair = remove_padding(camera)
        inner = self._draw(gaussians, pair.target)
        return Render(
            pair.paste(inner.image, drawn.image),
            pair.paste(inner.depth, drawn.depth),
            pair.paste(inner.alpha, drawn.alpha),
        )

    def _draw(self, gaussians: Gaussians, camera: Camera) -> Render:
        """Render with tangents that end beside the whole image."""
        home = gaussians.means.device
        if len(gaussians) == 0:
            return make_empty_render(camera, home)
        there = gaussians.to(self.device)
        viewer = camera.to(self.device)
        colors = evaluate_colors(there.sh.float(), there.means.float(), viewer.center.float())
        image, alpha = self._composite(there, viewer, colors)

        # Depths are composited like colours, and divided by alpha. The inner `where` keeps the
        # gradient of a division by 0 out of the graph.
        depths = compute_z_depths(there.means.float(), viewer)
        sums, _ = self._composite(there, viewer, depths[:, None].expand(-1, 3))
        is_seen = alpha > 0
        depth = torch.where(is_seen, sums[..., 0] / torch.where(is_seen, alpha, 1.0), 0.0)
        return Render(image.to(home), depth.to(home), alpha.to(home))

    def _draw_larger(self, gaussians: Gaussians, camera: Camera) -> Render:
        """Render the larger image that the pixels of `camera` are parts of, and average these.

        metal-gauss widens Gaussians by `BLUR` in any image.
        """
        factor = math.sqrt(BLUR / camera.blur)
        sides = [max(round(factor * side), 1) for side in (camera.width, camera.height)]
        large = self.render(gaussians, replace(resize_camera(camera, *sides), blur=BLUR))
        size = camera.height, camera.width
        # Depths count by alpha, as they are composited.
        maps = [large.image, (large.depth * large.alpha)[..., None], large.alpha[..., None]]
        means = adaptive_avg_pool2d(torch.cat(maps, dim=-1).permute(2, 0, 1), size).permute(1, 2, 0)
        image, depths, alpha = means[..., :3], means[..., 3], means[..., 4]
        is_seen = alpha > 0
        depth = torch.where(is_seen, depths / torch.where(is_seen, alpha, 1.0), 0.0)
        return Render(image, depth, alpha)

    def freeze(self, context: Gaussians, camera: Camera) -> RedrawnScene:
        """Prepare `context` for many renders from `camera`."""
        return RedrawnScene(self, context, camera)

    def _composite(
        self, gaussians: Gaussians, camera: Camera, colors: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
        """Composite colours over black, and return the image and alpha."""
        from metal_gauss import render

        image, alpha, _ = render(
            gaussians.means.float(),
            gaussians.quats.float(),
            gaussians.scales.float(),
            gaussians.opacities.float(),
            None,  # harmonics: colours stand for them
            camera.K.float(),
            camera.viewmat.float(),
            camera.width,
            camera.height,
            backend=self.backend,
            near=camera.near_plane,
            # Nothing is left out that other renderers draw: neither far nor large Gaussians.
            far=float("inf"),
            max_radius_frac=float("inf"),
            background=None,
            colors=colors,
            antialias=gaussians.is_antialiased,
        )
        return image, alpha


def explain_missing_metal(device: str = "mps") -> str | None:
    """Explain why metal-gauss cannot draw on a device; None if nothing is known to be missing."""
    if device == "mps" and not torch.backends.mps.is_available():
        return "torch sees no GPU of a Mac"
    if importlib.util.find_spec(METAL_PACKAGE) is None:
        return "metal-gauss is not installed (pip install 'gscompleter[metal]')"
    return None
