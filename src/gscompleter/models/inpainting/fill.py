"""Φ by an inpainting network: photographs are kept, and holes are filled window by window."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Shaped
from numpy import ndarray
from torch import Tensor

from gscompleter.generators.warp import BORDER_WIDTH, complete_warp
from gscompleter.models.onnx_network import ADVICE, OnnxNetwork
from gscompleter.numerics.image_ops import dilate
from gscompleter.numerics.smooth import fit_membrane
from gscompleter.system.errors import InputError
from gscompleter.types import Camera, GeneratorInput, View

WINDOW = 512
"""Side in pixels of the windows in which larger images are filled; networks are trained at it."""

Fill = Callable[[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]], Float[Tensor, "h w 3"]]
"""Network: image in [0, 1] and hole, True where it is filled -> image, of the same size. Of the
answer, `fill_windows` takes only the hole, and limits its colours to [0, 1]."""


@dataclass(frozen=True)
class InpaintingGenerator:
    """Generator Φ that fills the holes of warped photographs by a network."""

    fill: Fill

    def __call__(
        self, nearest: View, target: Camera, context: GeneratorInput
    ) -> Float[Tensor, "h w 3"]:
        """Synthesize the image at `target`; pixels outside the hole are warped photographs."""
        warped = complete_warp(nearest, target, context).to("cpu")
        # The rim of the hole is filled too: there, both colours are known and are compared.
        hole = dilate(~warped.known, BORDER_WIDTH)
        filled = fill_windows(warped.image, hole, self.fill)
        # Outside the hole the photographs stay; on its rim the filling is fitted to them.
        toned = match_tone(filled, warped.image, warped.known & hole)
        image = torch.where(warped.known[..., None], warped.image, toned)
        return image.clamp(0, 1).to(nearest.image.device)


def fill_windows(
    image: Float[Tensor, "h w 3"], hole: Bool[Tensor, "h w"], fill: Fill
) -> Float[Tensor, "h w 3"]:
    """Fill a hole window by window, those with the smallest share of it first.

    An image that is larger than the network's own size needs not be reduced: what was filled in one
    window is known in the next, which continues it. All colours that the network sees, and those
    that are returned, are in [0, 1].

    Raises InputError if the network fills the hole with a number that is not finite.
    """
    # A copy, which the windows change.
    image = image.clamp(0, 1)
    unfilled = hole.clone()
    # Windows that know most of their surroundings first: they continue it inwards.
    waiting = sorted(place_windows(*hole.shape), key=lambda at: hole[at].float().mean().item())
    while waiting:
        # One in which nothing is known waits for its neighbours, whatever side they are on.
        at = next((at for at in waiting if not unfilled[at].all()), waiting[0])
        waiting.remove(at)
        if unfilled[at].any():
            painted = fill(image[at], unfilled[at])[unfilled[at]]
            # Before colours are limited, which would turn infinity into white.
            if not painted.isfinite().all():
                raise InputError(
                    "The generator painted no finite image; check that its weights are correct, or "
                    "choose another generator."
                )
            image[at][unfilled[at]] = painted.clamp(0, 1)
            unfilled[at] = False
    return image


def place_windows(height: int, width: int) -> Iterator[tuple[slice, slice]]:
    """Cover an image by windows that overlap by at least half, in equal distances.

    Where the image is smaller than a window, the slices reach beyond it, and are cut by indexing.
    """

    def place(length: int) -> list[slice]:
        # Steps of half a window at most; rounded up, as -(-a // b) does.
        steps = -(-2 * max(length - WINDOW, 0) // WINDOW)
        starts = [0]
        if steps:
            starts = [round(i * (length - WINDOW) / steps) for i in range(steps + 1)]
        return [slice(start, start + WINDOW) for start in starts]

    return ((rows, columns) for rows in place(height) for columns in place(width))


def match_tone(
    filled: Float[Tensor, "h w 3"], observed: Float[Tensor, "h w 3"], ring: Bool[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """Add a smooth difference of colours, so that `filled` continues `observed` in the ring.

    The difference goes on from the ring over the whole image, as a membrane. Results may leave
    [0, 1].
    """
    if not ring.any():
        return filled
    return filled + fit_membrane(observed - filled, ring.float())


def run_inpainting_network(
    network: OnnxNetwork, image: Shaped[ndarray, "1 3 h w"], mask: Shaped[ndarray, "1 1 h w"]
) -> Shaped[ndarray, "1 3 h w"]:
    """Run a network on an image and a mask; raise InputError if its answer is of another size.

    Types, and the ranges of colours and masks, are those of the network.
    """
    (result,) = network(image=image, mask=mask)
    if result.shape != image.shape:
        raise InputError(
            f"The network answered an image of shape {image.shape} by {result.shape}; {ADVICE}."
        )
    return result
