"""Renderers: colour, z-depth and alpha of Gaussians seen from a camera.

All implement the 3DGS image formation of gsplat's classic mode: perspective EWA splatting with 0.3
px² added to the 2D covariance, contributions under alpha 1/255 dropped, alpha capped at 0.999,
compositing stopped when transmittance falls to 1e-4, colour over black. Antialiased Gaussians are
rendered as in gsplat's antialiased mode, which lowers opacities to compensate for that addition.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError, quote_value
from gscompleter.kernels.parallel import map_small_tasks
from gscompleter.types import Camera, Gaussians, Render

OpacityRender = Callable[[Float[Tensor, "n"]], Render]
"""Renders a frozen scene with Gaussians that vary in opacity [n] only."""
DepthRender = OpacityRender
"""Renders a frozen scene with Gaussians that vary in z-depth [n] only."""

ColorSums = tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]
"""Per Gaussian: compositing weight times an image [h, w, 3], and weight, summed over pixels."""

ColorErrors = Callable[[Float[Tensor, "n 3"], Float[Tensor, "h w 3"]], ColorSums]
"""Backprojects the residual of a photograph [h, w, 3], at given colours [n, 3]."""


def get_view_map(values: Tensor) -> Callable[..., Iterable[Any]]:
    """Return a `map` over views: several at a time if `values` are on a CPU, else one by one."""
    return map_small_tasks if values.device.type == "cpu" else map


@runtime_checkable
class FrozenScene(Protocol):
    """A scene prepared for one camera: whatever depends on these two alone is computed once."""

    @property
    def render(self) -> Render:
        """The render of the scene alone."""

    def extend(self, new: Gaussians) -> FrozenScene:
        """Add `new` to the frozen scene, after its Gaussians."""

    def backproject(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        """Sum `image` over the compositing weights of each Gaussian: Σ_p w_ip image_p."""

    def splat(self, values: Float[Tensor, "n"]) -> Float[Tensor, "h w"]:
        """Splat a value >= 0 per Gaussian: Σ_i w_ip value_i."""

    def composite(self, new: Gaussians) -> Render:
        """Render the scene with `new`; differentiable in `new`."""

    def vary_opacities(self, new: Gaussians) -> OpacityRender:
        """Fix all of `new` but the opacities; the result is differentiable."""

    def vary_colors(self, new: Gaussians) -> ColorErrors:
        """Fix all of `new` but its colours, which the camera sees as given, from 0 up."""

    def vary_depths(self, new: Gaussians) -> DepthRender:
        """Fix all of `new` but its z-depths.

        Gaussians move along the camera's rays with constant footprint. The depth is differentiable.
        """


@runtime_checkable
class Renderer(Protocol):
    """Renders Gaussians; differentiable in means, quats, scales, opacities and sh."""

    def render(self, gaussians: Gaussians, camera: Camera) -> Render:
        """Render `gaussians` from `camera`."""

    def freeze(self, context: Gaussians, camera: Camera) -> FrozenScene:
        """Prepare `context` for many renders from `camera`."""


def load_renderer(name: str) -> Renderer:
    """Load the renderer called `name`: reference, cpu or cuda."""
    if not isinstance(name, str):
        raise InputError(
            f"A renderer is named by a str, got '{quote_value(name)}'; choose reference, cpu or "
            "cuda."
        )
    if name == "cpu":
        from gscompleter.render.cpu import CpuRenderer

        return CpuRenderer()
    if name == "reference":
        from gscompleter.render.reference import ReferenceRenderer

        return ReferenceRenderer()
    if name == "cuda":
        from gscompleter.render.gsplat import CudaRenderer

        return CudaRenderer()
    raise InputError(f"There is no renderer '{quote_value(name)}'; choose reference, cpu or cuda.")


def choose_device(device: Literal["auto", "cpu", "cuda"] = "auto") -> Literal["cpu", "cuda"]:
    """Choose the device; `auto` uses a GPU if torch finds one and gsplat is installed."""
    is_ready = torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None
    if device == "cuda" and not is_ready:
        raise InputError(
            "The device cuda needs a GPU that torch sees, and gsplat from "
            "`pip install gscompleter[cuda]`; without them, choose the device cpu.",
            "device",
        )
    if device == "auto":
        return "cuda" if is_ready else "cpu"
    return device
