"""A frozen scene baked between new Gaussians that vary in appearance only.

A pixel keeps the fragments of new Gaussians, and one colour and transmittance between two of them.
So the cost of a render depends on the new Gaussians only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from numpy import ndarray
from torch import Tensor
from torch.autograd.function import once_differentiable

from gscompleter.kernels import rasterizer as kernels
from gscompleter.kernels.parallel import run, split_into_pieces
from gscompleter.kernels.rasterizer import Fragments, Layer, RasterFrame
from gscompleter.render.viewpoint import BinnedSplats, Viewpoint, to_float32

if TYPE_CHECKING:
    from gscompleter.render import AppearanceError


@dataclass(frozen=True)
class BakedScene:
    """A frozen scene with new Gaussians that vary in opacity and colour only."""

    viewpoint: Viewpoint
    image: Float32[ndarray, "h w 3"]
    """The frozen scene alone."""
    binned: BinnedSplats
    means: Float32[ndarray, "n 3"]
    fragments: Sequence[Fragments]
    """One item per group of tiles."""

    def __call__(
        self, opacities: Float[Tensor, "n"], sh: Float[Tensor, "n k 3"]
    ) -> Float[Tensor, "h w 3"]:
        """Render the image; differentiable."""
        image: Tensor = _ImageFunction.apply(self, opacities, sh)
        return image

    def make_error(
        self, wanted: Float[Tensor, "h w 3"], weights: Float[Tensor, "h w"]
    ) -> AppearanceError:
        """Make the error function, which evaluates only pixels that have fragments."""
        held = ImageComparison(self, to_float32(wanted), to_float32(weights))

        def error(opacities: Float[Tensor, "n"], sh: Float[Tensor, "n k 3"]) -> Float[Tensor, ""]:
            missed: Tensor = _ErrorFunction.apply(held, opacities, sh)
            return missed

        return error

    @cached_property
    def visible_rows(self) -> Int64[ndarray, "shown"]:
        """Indices of the Gaussians that have fragments."""
        named = np.zeros(len(self.means), np.bool_)
        for piece in self.fragments:
            named[piece.names[piece.names >= 0]] = True
        return np.flatnonzero(named)

    def shade(self, sh: Float32[ndarray, "n k 3"]) -> Float32[ndarray, "n 3"]:
        """Compute the colours seen by the camera; those of invisible Gaussians are undefined."""
        colors = np.empty((len(sh), 3), np.float32)
        seen = (self.visible_rows, self.viewpoint.pinhole.center, self.means)
        self.viewpoint.share(kernels.shade, len(self.visible_rows), *seen, sh, colors)
        return colors

    def render(
        self, opacities: Float32[ndarray, "n"], colors: Float32[ndarray, "n 3"]
    ) -> Float32[ndarray, "h w 3"]:
        """Render the frozen image with the pixels that have fragments."""
        image = self.image.copy()
        self.render_fragments(opacities, colors, image)
        return image

    def render_fragments(
        self,
        opacities: Float32[ndarray, "n"],
        colors: Float32[ndarray, "n 3"],
        image: Float32[ndarray, "h w 3"],
    ) -> None:
        """Write the pixels that have fragments."""
        calls = [(piece, opacities, colors, image) for piece in self.fragments]
        run(kernels.render_fragments, calls, self.viewpoint.threads)

    def compute_gradients(
        self,
        opacities: Float32[ndarray, "n"],
        colors: Float32[ndarray, "n 3"],
        image: Float32[ndarray, "h w 3"],
        d_image: Float32[ndarray, "h w 3"],
    ) -> Float32[ndarray, "n 4"]:
        """Compute gradients of opacities and colours from those of the image."""
        values = np.empty((len(self.binned.slots), 4), np.float32)
        written = np.zeros(len(values), np.bool_)
        arguments = (opacities, colors, image, d_image, values, written)
        pieces = [(piece, *arguments) for piece in self.fragments]
        run(kernels.render_fragments_backward, pieces, self.viewpoint.threads)
        return self.viewpoint.sum_by_gaussian(self.binned, (values, written))

    def compute_sh_gradients(
        self, colors: Float32[ndarray, "n 3"], d_colors: Float32[ndarray, "n 3"], bands: int
    ) -> Float32[ndarray, "n k 3"]:
        """Compute gradients of spherical harmonics from those of colours."""
        d_sh = np.zeros((len(colors), bands, 3), np.float32)
        seen = (self.visible_rows, self.viewpoint.pinhole.center, self.means)
        received = (colors, d_colors, d_sh)
        self.viewpoint.share(kernels.shade_backward, len(self.visible_rows), *seen, *received)
        return d_sh


@dataclass(frozen=True)
class ImageComparison:
    """A weighted target image for a `BakedScene`."""

    scene: BakedScene
    wanted: Float32[ndarray, "h w 3"]
    weights: Float32[ndarray, "h w"]

    def compute_error(
        self, image: Float32[ndarray, "h w 3"]
    ) -> tuple[float, Float32[ndarray, "h w 3"]]:
        """Compute the error of the pixels that have fragments, and its gradients in them."""
        d_image = np.empty_like(image)
        errors = np.zeros(self.scene.viewpoint.tiles)  # summed in one order on any threads
        seen = (image, self.wanted, self.weights, d_image, errors)
        pieces = [(piece, *seen) for piece in self.scene.fragments]
        run(kernels.compare_fragments, pieces, self.scene.viewpoint.threads)
        return float(errors.sum()), d_image

    @cached_property
    def frozen_error(self) -> float:
        """The constant error of all other pixels."""
        frozen = self.scene.image
        squares = np.square(frozen - self.wanted).sum(axis=2, dtype=np.float64)
        return float((self.weights * squares).sum()) - self.compute_error(frozen)[0]


class _ErrorFunction(torch.autograd.Function):
    """The error of the image of a `BakedScene`."""

    @staticmethod
    def forward(ctx: Any, held: ImageComparison, opacities: Tensor, sh: Tensor) -> Tensor:
        scene = held.scene
        colors, opaque = scene.shade(to_float32(sh)), to_float32(opacities)
        image = np.empty_like(scene.image)
        scene.render_fragments(opaque, colors, image)
        error, d_image = held.compute_error(image)
        ctx.scene = (scene, opaque, colors, image, d_image, sh.shape[1])
        return torch.tensor(held.frozen_error + error, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_error: Tensor) -> tuple[Tensor | None, ...]:
        scene, opacities, colors, image, d_image, bands = ctx.scene
        found = d_error.item() * scene.compute_gradients(opacities, colors, image, d_image)
        return None, *compute_appearance_gradients(
            scene, colors, found, bands, ctx.needs_input_grad[2]
        )


class _ImageFunction(torch.autograd.Function):
    """The image of a `BakedScene`."""

    @staticmethod
    def forward(ctx: Any, scene: BakedScene, opacities: Tensor, sh: Tensor) -> Tensor:
        colors, opaque = scene.shade(to_float32(sh)), to_float32(opacities)
        image = scene.render(opaque, colors)
        ctx.scene = (scene, opaque, colors, image, sh.shape[1])
        return torch.from_numpy(image)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_image: Tensor) -> tuple[Tensor | None, ...]:
        scene, opacities, colors, image, bands = ctx.scene
        found = scene.compute_gradients(opacities, colors, image, to_float32(d_image))
        return None, *compute_appearance_gradients(
            scene, colors, found, bands, ctx.needs_input_grad[2]
        )


def compute_appearance_gradients(
    scene: BakedScene,
    colors: Float32[ndarray, "n 3"],
    gradients: Float32[ndarray, "n 4"],
    bands: int,
    wants_sh: bool,
) -> tuple[Tensor, Tensor | None]:
    """Compute gradients of opacities and, if `wants_sh`, of spherical harmonics."""
    opacities = torch.from_numpy(np.ascontiguousarray(gradients[:, 0]))
    if not wants_sh:
        return opacities, None
    return opacities, torch.from_numpy(scene.compute_sh_gradients(colors, gradients[:, 1:], bands))


def bake_scene(
    viewpoint: Viewpoint,
    context: Layer,
    frame: RasterFrame,
    binned: BinnedSplats,
    means: Float32[ndarray, "n 3"],
    where: Bool[Tensor, "h w"],
) -> BakedScene:
    """Bake a frozen scene between the fragments of opaque splats in the mask `where`."""
    tiles = np.flatnonzero(np.diff(binned.layer.tile_start))
    behind = np.zeros_like(frame.image)
    known = (tiles, context, binned.layer, binned.slots, where.cpu().numpy(), behind)
    pieces = [(*piece, *known) for piece in split_into_pieces(len(tiles), viewpoint.threads)]
    fragments = run(kernels.find_fragments, pieces, viewpoint.threads)
    return BakedScene(viewpoint, frame.image, binned, means, fragments)
