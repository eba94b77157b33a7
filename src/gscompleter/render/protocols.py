"""Protocols of a renderer: it renders Gaussians, and freezes a scene for one camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gscompleter.types import Camera, Gaussians, Render

OpacityRender = Callable[[Float[Tensor, "n"]], Render]
"""Renders a frozen scene with Gaussians that vary in opacity [n] only."""
Backpropagation = Callable[[Float[Tensor, "images h w 3"]], Sequence[Float[Tensor, "n"]]]
"""Computes a gradient in the opacities from each of several gradients of an image."""
DepthRender = OpacityRender
"""Renders a frozen scene with Gaussians that vary in z-depth [n] only."""

ColorSums = tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]
"""Per Gaussian: compositing weight times an image [h, w, 3], and weight, summed over pixels."""

ColorErrors = Callable[[Float[Tensor, "n 3"], Float[Tensor, "h w 3"]], ColorSums]
"""Backprojects the residual of a photograph [h, w, 3]: photograph minus render of the frozen scene
with Gaussians that vary in colour only. Their colours [n, 3] are RGB as the camera sees them, in
place of SH; those below 0 count as 0. There is no gradient."""


@runtime_checkable
class JointOpacityRender(Protocol):
    """An `OpacityRender` that computes several gradients at once, in less time than one by one."""

    def begin(self, opacities: Float[Tensor, "n"]) -> tuple[Render, Backpropagation]:
        """Render, and prepare the gradients at these opacities."""


@runtime_checkable
class FrozenScene(Protocol):
    """A scene prepared for one camera: whatever depends on these two alone is computed once."""

    @property
    def render(self) -> Render:
        """The render of the scene alone."""

    def extend(self, new: Gaussians) -> FrozenScene:
        """Add `new` to the frozen scene, after its Gaussians."""

    def freeze_occluders(self, others: Gaussians) -> FrozenScene:
        """Freeze `others` alone; those that hide none of the frozen Gaussians may be left out."""

    def repaint(self, rows: Int64[Tensor, "m"], painted: Gaussians) -> FrozenScene:
        """Give the Gaussians at distinct `rows` the colours of `painted`, the same Gaussians."""

    def backproject(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        """Sum `image` over the compositing weights of each Gaussian: Σ_p w_ip image_p."""

    def splat(self, values: Float[Tensor, "n"]) -> Float[Tensor, "h w"]:
        """Splat a value >= 0 per Gaussian: Σ_i w_ip value_i."""

    def composite(self, new: Gaussians) -> Render:
        """Render the scene with `new`; differentiable in `new`."""

    def vary_opacities(self, new: Gaussians, is_fading: bool = False) -> OpacityRender:
        """Fix all of `new` but the opacities; the result is differentiable.

        If it is fading, no opacity will exceed that of `new`, and what is transparent stays so.
        """

    def vary_colors(self, new: Gaussians) -> ColorErrors:
        """Fix all of `new` but its colours; sums are over the Gaussians of `new`."""

    def vary_depths(self, new: Gaussians) -> DepthRender:
        """Fix all of `new` but its z-depths.

        Gaussians move along the camera's rays with constant footprint. The rendered depth is
        differentiable; image and alpha need not be, as only the order of Gaussians changes them.
        """


@runtime_checkable
class JointScene(Protocol):
    """A frozen scene that draws for two cameras at once, in nearly the time of one on a GPU."""

    def composite_beside(self, new: Gaussians, other: Camera) -> tuple[Render, Render]:
        """Render the scene with `new`, and `new` alone from `other`; differentiable in `new`."""


@runtime_checkable
class HidingScene(Protocol):
    """A frozen scene that is frozen again, without some Gaussians, only where it showed these."""

    def hide(self, hidden: Bool[Tensor, "n"], parts: Sequence[Gaussians]) -> FrozenScene:
        """Freeze all n Gaussians again: `parts`, in which the `hidden` ones are transparent."""


@runtime_checkable
class FilingScene(Protocol):
    """A frozen scene of which memory holds no more than what is read at the moment."""

    def move_beside(self, mapped: Tensor) -> FrozenScene:
        """Move what was frozen to files, beside the file in which `mapped` lies."""


@runtime_checkable
class Renderer(Protocol):
    """Renders Gaussians; differentiable in means, quats, scales, opacities and sh."""

    def render(self, gaussians: Gaussians, camera: Camera) -> Render:
        """Render `gaussians` from `camera`."""

    def freeze(self, context: Gaussians, camera: Camera) -> FrozenScene:
        """Prepare `context` for many renders from `camera`."""
