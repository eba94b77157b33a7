"""How well a splat fits photographs: it is drawn at their cameras and compared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.coverage import COVERED
from gscompleter.render import Renderer
from gscompleter.types import Camera, Gaussians, Render, View

GAINS = (0.5, 2.0)
"""Contrasts between which a photograph's exposure may differ from the splat's."""
MIN_COVERED = 0.05
"""Share of an image that must be covered for it to tell anything."""
MIN_MARGIN = 3.0
"""dB above a flat image from which a render shows what the photograph shows: half of its
variance is explained."""
MIN_PSNR = 30.0
"""dB from which even a flat photograph is shown as it is."""


@dataclass(frozen=True)
class FrameFit:
    """Of the better half of the photographs; a splat need not have been trained on all."""

    psnr: float
    """Median in dB over the covered pixels, after the exposures were evened out."""
    margin: float
    """Median of how far that is above the best flat image, in dB."""
    covered: float
    """Median share of the pixels that the splat covers."""

    @property
    def fits(self) -> bool:
        """Whether the splat shows what the photographs show."""
        shown = self.margin >= MIN_MARGIN or self.psnr >= MIN_PSNR
        return shown and self.covered >= MIN_COVERED


NO_FIT = FrameFit(0.0, 0.0, 0.0)
"""Of a splat that no photograph shows."""


def frame_fit(scene: Gaussians, views: Sequence[View], renderer: Renderer) -> FrameFit:
    """How well `scene` fits the photographs at their cameras, which are in its frame."""
    found = [compared(seen_from(scene, view.camera, renderer), view.image) for view in views]
    found = sorted(found, key=lambda fit: fit.margin, reverse=True)[: math.ceil(len(views) / 2)]
    middle = found[len(found) // 2] if found else NO_FIT
    psnr = sorted(fit.psnr for fit in found)[len(found) // 2] if found else 0.0
    covered = sorted(fit.covered for fit in found)[len(found) // 2] if found else 0.0
    return FrameFit(psnr, middle.margin, covered)


def seen_from(scene: Gaussians, camera: Camera, renderer: Renderer) -> Render:
    """The render of `scene`, in the unit of its own depths, which no camera need know yet."""
    z = (scene.means - camera.center) @ camera.forward
    unit = z[z > 0].median().item() if (z > 0).any() else 1.0
    with torch.no_grad():
        return renderer.render(scene, replace(camera, near=0.1 * unit))


def compared(render: Render, photograph: Float[Tensor, "h w 3"]) -> FrameFit:
    """The fit of one image."""
    where = render.alpha >= COVERED
    covered = where.float().mean().item()
    if covered < MIN_COVERED:
        return NO_FIT
    drawn, truth = render.image[where].double(), photograph[where].double()
    psnr = decibels((evened_out(drawn, truth) - truth).square().mean())
    return FrameFit(psnr, psnr - decibels((truth - truth.mean()).square().mean()), covered)


def evened_out(drawn: Float[Tensor, "n 3"], truth: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """`drawn` in the exposure of `truth`: one gain and one offset, by least squares."""
    centred = drawn - drawn.mean()
    gain = (centred * (truth - truth.mean())).sum() / centred.square().sum().clamp_min(1e-12)
    return gain.clamp(*GAINS) * centred + truth.mean()


def decibels(error: Float[Tensor, ""]) -> float:
    """PSNR of a mean squared error, at most 100 dB."""
    return -10 * math.log10(max(error.item(), 1e-10))
