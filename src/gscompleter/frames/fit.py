"""How well a splat fits photographs: it is drawn at their cameras and compared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.coverage import COVERED
from gscompleter.frames.drift import drift
from gscompleter.geometry import z_depths
from gscompleter.render import Renderer, each_view
from gscompleter.types import Camera, Gaussians, Render, View

GAINS = (0.5, 2.0)
"""Contrasts between which a photograph's exposure may differ from the splat's."""
MIN_COVERED = 0.05
"""Share of an image that must be covered for it to tell anything."""
MIN_MARGIN = 3.0
"""dB above a flat image from which a render shows what the photograph shows: half of its
variance is explained."""
MIN_PSNR = 30.0
"""dB from which even a flat photograph, most of it covered, is shown as it is."""
MAX_DRIFT = 0.25
"""Pixels, of small photographs, up to which things are where they belong. A good splat in its
frame has 0.1; one that is 0.5 % too large 0.5."""


@dataclass(frozen=True)
class ImageFit:
    """How well the splat shows one photograph."""

    psnr: float
    """In dB over the covered pixels, after the exposures were evened out."""
    margin: float
    """How far that is above the best flat image, in dB."""
    covered: float
    """Share of the pixels that the splat covers."""
    drift: float
    """Pixels from where the splat shows corners to where the photograph does; infinity where
    too few are recognised."""

    @property
    def shows(self) -> bool:
        """Whether the splat shows what the photograph shows."""
        flat = self.psnr >= MIN_PSNR and self.covered >= 0.5
        return self.covered >= MIN_COVERED and (self.margin >= MIN_MARGIN or flat)


@dataclass(frozen=True)
class FrameFit:
    """How well the splat shows photographs.

    Its figures are medians over the better half of those that see it, for a splat need not have
    been trained on all.
    """

    images: tuple[ImageFit, ...]

    @property
    def fits(self) -> bool:
        """Whether the splat shows what two of the photographs show, or the only one."""
        shown = sum(image.shows for image in self.images)
        return shown >= max(1, min(2, len(self.images)))

    @property
    def in_place(self) -> bool:
        """Whether it fits, and shows things where the photographs do."""
        return self.fits and self.drift <= MAX_DRIFT

    @property
    def psnr(self) -> float:
        """In dB; 0 where no photograph sees the splat."""
        return self._middle("psnr", 0.0)

    @property
    def margin(self) -> float:
        """In dB above the best flat image."""
        return self._middle("margin", 0.0)

    @property
    def drift(self) -> float:
        """In pixels; infinity where it is not known."""
        return self._middle("drift", math.inf)

    @property
    def covered(self) -> float:
        """Mean share of the pixels that the splat covers, over all photographs."""
        return sum(image.covered for image in self.images) / max(len(self.images), 1)

    def _middle(self, name: str, otherwise: float) -> float:
        seen = [image for image in self.images if image.covered >= MIN_COVERED]
        seen.sort(key=lambda image: image.margin, reverse=True)
        values = sorted(getattr(image, name) for image in seen[: math.ceil(len(seen) / 2)])
        return values[len(values) // 2] if values else otherwise


def frame_fit(scene: Gaussians, views: Sequence[View], renderer: Renderer) -> FrameFit:
    """How well `scene` fits the photographs at their cameras, which are in its frame."""

    def fit(view: View) -> ImageFit:
        return compared(seen_from(scene, view.camera, renderer), view.image)

    return FrameFit(tuple(each_view(scene)(fit, views)))


def seen_from(scene: Gaussians, camera: Camera, renderer: Renderer) -> Render:
    """The render of `scene`, in the unit of its own depths, which no camera need know yet."""
    z = z_depths(scene.means, camera)
    unit = z[z > 0].median().item() if (z > 0).any() else 1.0
    with torch.no_grad():
        return renderer.render(scene, replace(camera, near=0.1 * unit))


def compared(render: Render, photograph: Float[Tensor, "h w 3"]) -> ImageFit:
    """The fit of one image."""
    where = render.alpha >= COVERED
    covered = where.float().mean().item()
    if covered < MIN_COVERED:
        return ImageFit(0.0, 0.0, covered, math.inf)
    truth = photograph[where].double()
    drawn = evened_out(render.image[where].double(), truth)
    psnr = decibels((drawn - truth).square().mean())
    margin = psnr - decibels((truth - truth.mean()).square().mean())
    shown = photograph.double().index_put((where,), drawn)
    before, after = (i.mean(dim=-1).cpu().numpy() for i in (shown, photograph.double()))
    return ImageFit(psnr, margin, covered, drift(before, after, where.cpu().numpy()))


def evened_out(drawn: Float[Tensor, "n 3"], truth: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """`drawn` in the exposure of `truth`: one gain and one offset, by least squares."""
    centred = drawn - drawn.mean()
    gain = (centred * (truth - truth.mean())).sum() / centred.square().sum().clamp_min(1e-12)
    return gain.clamp(*GAINS) * centred + truth.mean()


def decibels(error: Float[Tensor, ""]) -> float:
    """PSNR of a mean squared error, at most 100 dB."""
    return -10 * math.log10(max(error.item(), 1e-10))
