"""Does a synthesized image agree with what the photographs show of the target?

A model that paints the whole image anew shifts its colours, and may paint something else. The
shift is measured and taken back; a painting of something else is told.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.generators import Synthesis
from gscompleter.generators.robust import robust_affine
from gscompleter.generators.warp import Warped
from gscompleter.interpolation import smoothed

BLUR = 2
"""Radius, in pixels, over which colours are averaged before they are compared: a painted edge may
lie a pixel beside the photographed one."""
MAX_SHARE = 0.6
"""Difference of colours, once the shift is taken back, from which an image counts as another scene:
as a share of what a single colour would leave."""
QUANTILE = 0.7
"""Which pixel's difference counts, from the least to the largest. The median would be that of a
blank wall where this fills half of what is seen."""
LEAST = 0.03
"""A difference that counts as none, however dull the scene. Colours are in [0, 1]."""
MAX_GAIN = 1.6
"""Largest factor of a channel, and its inverse the smallest, that counts as a colour shift."""
MAX_OFFSET = 0.25
"""Largest number added to a channel that counts as a colour shift."""
MIN_PIXELS = 200
"""Fewest observed pixels that say anything."""


@dataclass(frozen=True)
class Agreement:
    """How an image compares with the photographs: `observed = gain * image + offset`."""

    gain: Float[Tensor, "3"]
    offset: Float[Tensor, "3"]
    residual: float
    """Difference of colours after the shift was taken back, a quantile over the observed pixels."""
    limit: float
    """The largest one at which the image counts as one of the same scene."""
    share: float
    """Share of the image that was observed."""
    agrees: bool
    """Whether it shows the same scene, as far as there is anything to compare."""
    image: Float[Tensor, "h w 3"]
    """The image with the shift taken back where it agrees, else as it was."""

    @property
    def shift(self) -> float:
        """Largest change of a mid-grey by the colour shift."""
        return float((0.5 * self.gain + self.offset - 0.5).abs().max())


def checked(
    paint: Callable[[int], Float[Tensor, "h w 3"]],
    seed: int,
    observed: Warped,
    retries: int = 0,
    correct_color: bool = True,
) -> Synthesis:
    """An image painted from a seed, its colours brought to those observed, and notes on it.

    Args:
        paint: Seed -> image in [0, 1].
        seed: The first to try.
        observed: What the photographs show of the target.
        retries: How many further seeds are tried while the image disagrees. The best one is kept.
        correct_color: Whether a colour shift is taken back.

    Raises:
        InputError: where no seed gives finite colours.
    """
    found: list[Agreement] = []
    for attempt in range(retries + 1):
        image = paint(seed + attempt)
        found.append(compare(image, observed.image, observed.known, correct_color))
        if found[-1].agrees:
            break
    best = min(found, key=lambda one: (not one.agrees, one.residual))
    if best.residual == float("inf"):
        raise InputError(
            f"The generator painted no finite image ({len(found)} seed(s) tried); see that its "
            "weights are sound, or choose another generator."
        )
    return Synthesis(best.image, notes_on(best, len(found)), not best.agrees)


def compare(
    image: Float[Tensor, "h w 3"],
    observed: Float[Tensor, "h w 3"],
    known: Bool[Tensor, "h w"],
    correct_color: bool = True,
) -> Agreement:
    """Measure the colour shift of `image` against `observed` where that is `known`, and take it
    back if the image agrees and its colours are to be corrected."""
    ones, zeros = torch.ones(3).to(image), torch.zeros(3).to(image)
    share = known.float().mean().item()
    if not image.isfinite().all():
        return Agreement(ones, zeros, float("inf"), LEAST, share, False, image)
    if int(known.sum()) < MIN_PIXELS:
        return Agreement(ones, zeros, 0.0, LEAST, share, True, image)
    ours = smoothed(image, known, BLUR)[known]
    theirs = smoothed(observed, known, BLUR)[known]
    gain, offset = robust_affine(ours, theirs)
    residual = quantile((gain * ours + offset - theirs).abs().mean(dim=-1), QUANTILE)
    plain = theirs - theirs.median(dim=0).values
    contrast = quantile(plain.abs().mean(dim=-1), QUANTILE)
    limit = max(LEAST, MAX_SHARE * contrast)
    plausible = bool(
        ((gain >= 1 / MAX_GAIN) & (gain <= MAX_GAIN)).all() and (offset.abs() <= MAX_OFFSET).all()
    )
    agrees = plausible and residual <= limit
    if agrees and not correct_color:
        gain, offset = ones, zeros
    corrected = (gain * image + offset).clamp(0, 1) if agrees else image
    return Agreement(gain, offset, residual, limit, share, agrees, corrected)


def quantile(values: Float[Tensor, "n"], share: float) -> float:
    """The value below which `share` of all lie."""
    return values.kthvalue(1 + int(share * (len(values) - 1))).values.item()


def notes_on(found: Agreement, tried: int) -> tuple[str, ...]:
    """What a reader of the results should know of it."""
    if not found.agrees:
        seeds = "" if tried == 1 else f" (best of {tried} seeds)"
        if found.residual > found.limit:
            reason = f"colours differ by {found.residual:.3f}"
            limit = f"{found.limit:.3f} is the limit"
        else:
            worst = int(((found.gain - 1).abs() + found.offset.abs()).argmax())
            gain, offset = found.gain[worst].item(), found.offset[worst].item()
            reason = f"a channel matches only as {gain:.2f} of itself {offset:+.2f}"
            limit = "that is no shift of colours"
        return (
            f"The synthesized image disagrees with the photographs: over the {found.share:.0%} of "
            f"it that they show, {reason}{seeds}, and {limit}.",
        )
    notes = []
    if found.shift > 0.5 / 255:
        notes.append(
            "The colours of the synthesized image were brought to those of the photographs "
            f"(mid-grey moved by {255 * found.shift:.1f} of 255)."
        )
    if tried > 1:
        notes.append(f"{tried} seeds were tried before the synthesized image agreed.")
    return tuple(notes)
