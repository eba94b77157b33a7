"""Likeness of a scene to photographs that it was not made from.

A reconstruction from wrong poses can reproduce every photograph that it was made from: each one is
explained by Gaussians on its own rays. From a camera in between, the same Gaussians are shards.
Photographs that were not used therefore decide about a reconstruction. What they are compared with
besides the render is what needs no reconstruction: a photograph that was used, as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import shrink_camera
from gscompleter.splats.alignment.fit import convert_to_psnr, match_render
from gscompleter.types import Render, View

JUDGED_SIDE = 160
"""Longer side of the compared images, in pixels: what is off by a pixel or two of the full size,
as by the noise of good poses, still agrees, and a wrong pose is off by many."""
MIN_COVERED = 0.2
"""Smallest share of a photograph that the scene has to cover for it to be compared."""


@dataclass(frozen=True)
class Likeness:
    """Likeness of a render to an unused photograph, in dB over the covered pixels.

    The exposure of the render and of each photograph in use is fitted, so that only the content
    counts.
    """

    above_color: float
    """PSNR above that of the best single colour, the mean of the covered pixels."""
    above_photograph: float
    """PSNR above that of the best photograph that was used, seen from its own camera."""


def shrink_view(view: View, side: int = JUDGED_SIDE) -> View:
    """Shrink a photograph and its camera to a longer side of `side` pixels, by areas.

    Its depths and the mask of what moves are left out, as nothing that is judged at this size reads
    them. A photograph that is not larger is returned as it is.
    """
    camera = shrink_camera(view.camera, side)
    size = camera.width, camera.height
    if size == (view.camera.width, view.camera.height):
        return view
    # A pixel of the small image is ignored if any part of it is. The share that is ignored tells
    # that exactly: averages of zeros are 0, and those of ones are not always 1 in float32.
    ignored_share = resize_by_area((~view.valid_mask).float(), size)
    image = resize_by_area(view.image, size)
    return View(image, camera, view.frame, ignore_mask=ignored_share > 0)


def resize_by_area(pixels: Float[Tensor, "h w *c"], size: tuple[int, int]) -> Float[Tensor, "..."]:
    """Resize an image or a mask to a width and height, averaging over areas.

    The proportions may change. An image that is not larger is interpolated.
    """
    resized = cv2.resize(pixels.cpu().numpy(), size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(resized).to(pixels)


def measure_likeness(
    render: Render, photograph: View, used: Sequence[Float[Tensor, "_h _w 3"]]
) -> Likeness | None:
    """Measure the likeness of a render to a photograph, beside that of photographs in use.

    The render has the size of the photograph. `used` are images of any size, at least about as
    large; each is stretched to that of the photograph. Returns None if less than `MIN_COVERED` is
    covered.
    """
    covered = (render.alpha >= COVERED) & photograph.valid_mask
    if covered.float().mean().item() < MIN_COVERED:
        return None
    truth = photograph.image
    size = photograph.camera.width, photograph.camera.height
    shown = compute_fitted_psnr(render.image, truth, covered)
    # The best single colour has the mean of each channel, which no fit of an exposure gives it.
    colors = truth[covered].double()
    plain = convert_to_psnr((colors - colors.mean(dim=0)).square().mean())
    # Not rendered from the camera of the unused photograph: what two photographs of the same place
    # have in common anyway.
    as_they_are = [
        compute_fitted_psnr(resize_by_area(image, size), truth, covered) for image in used
    ]
    return Likeness(shown - plain, shown - max(as_they_are, default=plain))


def compute_fitted_psnr(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], where: Bool[Tensor, "h w"]
) -> float:
    """Compute PSNR in dB over the pixels of `where`, after matching the exposure."""
    wanted = truth[where].double()
    fitted = match_render(image[where].double(), wanted)
    return convert_to_psnr((fitted - wanted).square().mean())
