"""Renderers: colour, z-depth and alpha of Gaussians seen from a camera.

All of them draw the 3DGS image formation of gsplat's classic mode: perspective EWA splatting with
0.3 px² added to the 2D covariance, contributions under alpha 1/255 dropped, alpha capped at 0.999,
compositing stopped when transmittance falls to 1e-4, colour over black. Antialiased Gaussians are
drawn as in gsplat's antialiased mode: what that addition makes larger, it makes fainter.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.errors import InputError, quoted
from gscompleter.kernels.sharing import many_at_once
from gscompleter.types import Camera, Gaussians, Render

OpacityRender = Callable[[Float[Tensor, "n"]], Render]
"""Renders a frozen scene plus Gaussians of which only the opacities [n] may change."""

OpacityImage = Callable[[Float[Tensor, "n"]], Float[Tensor, "h w 3"]]
"""The image of it."""


def image_of(plan: OpacityRender) -> OpacityImage:
    """The image of what a plan renders."""
    return lambda opacities: plan(opacities).image


DepthRender = Callable[[Float[Tensor, "n"]], Render]
"""Renders a frozen scene plus Gaussians of which only the z-depths [n] may change."""


LooksError = Callable[[Float[Tensor, "n"], Float[Tensor, "n k 3"]], Float[Tensor, ""]]
"""How far an image is from what is wanted with these opacities and spherical harmonics of something
in it; differentiable in both."""


@runtime_checkable
class AppearanceRender(Protocol):
    """Draws a frozen scene plus Gaussians of which only the opacities [n] and the spherical
    harmonics [n, k, 3] may change."""

    def __call__(
        self, opacities: Float[Tensor, "n"], sh: Float[Tensor, "n k 3"]
    ) -> Float[Tensor, "h w 3"]:
        """The image; differentiable."""

    def compared(self, wanted: Float[Tensor, "h w 3"], weights: Float[Tensor, "h w"]) -> LooksError:
        """The sum over the image of `weights`, from 0 up, times the squared differences from what
        is `wanted`, of all channels."""


def in_colours(plan: AppearanceRender, sh: Float[Tensor, "n k 3"]) -> OpacityImage:
    """The image that a plan draws in these colours."""
    return lambda opacities: plan(opacities, sh)


ColourSums = tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]
"""Of each Gaussian, the sums over an image of its compositing weight times three layers, and of the
weight itself."""


ColourErrors = Callable[[Float[Tensor, "n 3"], Float[Tensor, "h w 3"]], ColourSums]
"""Draws a frozen scene plus Gaussians of which only the colours [n, 3] may change, and sums what a
photograph [h, w, 3] has more than the image."""


def each_view(drawn: Gaussians) -> Callable[..., Iterable[Any]]:
    """`map`, for what is done to one view of `drawn` after the other: on a CPU several at a time,
    which then need not wait for each other's threads."""
    return many_at_once if drawn.means.device.type == "cpu" else map


@runtime_checkable
class FrozenView(Protocol):
    """A context scene that will not change, seen from a camera that will not move.

    Whatever depends on these two alone is computed once, so that the optimisations, which
    render the same context a hundred times, pay only for what they move.
    """

    @property
    def context(self) -> Render:
        """The context alone."""

    def extended(self, new: Gaussians) -> FrozenView:
        """The view of context and `new`, in that order, both frozen."""

    def sums(self, layers: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        """For each Gaussian of the context, the sum over the image of each layer times the
        Gaussian's compositing weight."""

    def blended(self, values: Float[Tensor, "n"]) -> Float[Tensor, "h w"]:
        """The sum over the Gaussians of the context of compositing weight times value, from 0
        up."""

    def composite(self, new: Gaussians) -> Render:
        """Context and `new` together; differentiable in `new`."""

    def plan(self, new: Gaussians) -> OpacityRender:
        """Fix all of `new` but the opacities; the function it returns is differentiable."""

    def plan_appearance(self, new: Gaussians, where: Bool[Tensor, "h w"]) -> AppearanceRender:
        """Fix all of `new` but the opacities and spherical harmonics, and draw it at least `where`
        it is asked for; the function it returns is differentiable in both. It takes longer to make
        than `plan`, and then draws faster."""

    def plan_colours(self, new: Gaussians) -> ColourErrors:
        """Fix all of `new` but its colours, which the camera sees as they are given, from 0 up."""

    def plan_depths(self, new: Gaussians, where: Bool[Tensor, "h w"]) -> DepthRender:
        """Fix all of `new` but how far along the rays of the camera it stands, and draw it at least
        `where` it is asked for. Sizes follow, so that its image stays: what changes is which of two
        is in front, and the depth, which is differentiable."""


@runtime_checkable
class Renderer(Protocol):
    """Draws Gaussians; differentiable in means, quats, scales, opacities and sh."""

    def render(self, gaussians: Gaussians, camera: Camera) -> Render: ...

    def freeze(self, context: Gaussians, camera: Camera) -> FrozenView: ...


def load_renderer(name: str) -> Renderer:
    """The renderer called `name`: reference, cpu or cuda.

    Raises:
        InputError: where the name is unknown, or `cuda` lacks a GPU or gsplat.
    """
    if name == "cpu":
        from gscompleter.render.cpu import CpuRenderer

        return CpuRenderer()
    if name == "reference":
        from gscompleter.render.reference import ReferenceRenderer

        return ReferenceRenderer()
    if name == "cuda":
        from gscompleter.render.cuda import CudaRenderer

        return CudaRenderer()
    raise InputError(f"There is no renderer '{quoted(name)}'; choose reference, cpu or cuda.")


def choose_device(device: Literal["auto", "cpu", "cuda"] = "auto") -> Literal["cpu", "cuda"]:
    """The device to run on: `auto` takes a GPU where torch sees one and gsplat is installed.

    Raises:
        InputError: where `cuda` is asked for and there is none.
    """
    has_gpu = torch.cuda.is_available()
    has_gsplat = importlib.util.find_spec("gsplat") is not None
    if device == "auto":
        return "cuda" if has_gpu and has_gsplat else "cpu"
    if device == "cuda" and not has_gpu:
        raise InputError(
            "The device cuda needs a GPU, and torch sees none here; choose the device cpu.",
            "device",
        )
    if device == "cuda" and not has_gsplat:
        raise InputError(
            "The device cuda renders through gsplat, which is not installed; "
            "run `pip install gscompleter[cuda]` or choose the device cpu.",
            "device",
        )
    return device
