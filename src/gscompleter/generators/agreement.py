"""Comparison of synthesized images with the photographs, and correction of colour shifts."""

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
"""Blur radius in pixels before colours are compared; edges may be a pixel off."""
MAX_SHARE = 0.6
"""Largest residual of a consistent image, relative to that of a constant colour."""
QUANTILE = 0.7
"""Quantile of the residuals; higher than the median, which may be a blank wall."""
LEAST = 0.03
"""Residual that is always accepted, for colours in [0, 1]."""
MAX_GAIN = 1.6
"""Largest gain of a colour shift; its inverse is the smallest."""
MAX_OFFSET = 0.25
"""Largest offset of a colour shift."""
MIN_PIXELS = 200
"""Fewest observed pixels for a comparison."""


@dataclass(frozen=True)
class Agreement:
    """Comparison of an image with the photographs: `observed = gain * image + offset`."""

    gain: Float[Tensor, "3"]
    offset: Float[Tensor, "3"]
    residual: float
    """Quantile of the colour difference after the correction."""
    limit: float
    """Largest residual of a consistent image."""
    share: float
    agrees: bool
    """True if the image is consistent with the photographs, or cannot be compared."""
    image: Float[Tensor, "h w 3"]
    """The image, corrected if it is consistent."""

    @property
    def shift(self) -> float:
        """Largest change of mid-grey by the correction."""
        return float((0.5 * self.gain + self.offset - 0.5).abs().max())


def checked(
    paint: Callable[[int], Float[Tensor, "h w 3"]],
    seed: int,
    observed: Warped,
    retries: int = 0,
    correct_color: bool = True,
) -> Synthesis:
    """Paint an image from a seed, compare it with the photographs and correct its colours.

    While it is inconsistent, up to `retries` further seeds are tried and the best image is kept.
    Raise InputError if no seed gives finite colours.
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
            f"The generator painted no finite image ({len(found)} seed(s) tried); check that its "
            "weights are correct, or choose another generator."
        )
    return Synthesis(best.image, notes_on(best, len(found)), not best.agrees)


def compare(
    image: Float[Tensor, "h w 3"],
    observed: Float[Tensor, "h w 3"],
    known: Bool[Tensor, "h w"],
    correct_color: bool = True,
) -> Agreement:
    """Fit the colour shift of `image` to the `known` pixels and correct it if consistent."""
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
    """Return the value below which a fraction `share` of the values lies."""
    return values.kthvalue(1 + int(share * (len(values) - 1))).values.item()


def notes_on(found: Agreement, tried: int) -> tuple[str, ...]:
    """Write notes on the comparison for a reader of the results."""
    if not found.agrees:
        seeds = "" if tried == 1 else f" (best of {tried} seeds)"
        if found.residual > found.limit:
            reason = f"colours differ by {found.residual:.3f}"
            limit = f"{found.limit:.3f} is the limit"
        else:
            worst = int(((found.gain - 1).abs() + found.offset.abs()).argmax())
            gain, offset = found.gain[worst].item(), found.offset[worst].item()
            reason = (
                f"a colour channel matches only with factor {gain:.2f} and offset {offset:+.2f}"
            )
            limit = "this is more than a colour shift"
        return (
            f"The synthesized image disagrees with the photographs: over the {found.share:.0%} of "
            f"it that they show, {reason}{seeds}, and {limit}.",
        )
    notes = []
    if found.shift > 0.5 / 255:
        notes.append(
            "The colours of the synthesized image were matched to those of the photographs "
            f"(mid-grey changed by {255 * found.shift:.1f} of 255)."
        )
    if tried > 1:
        notes.append(f"{tried} seeds were tried before the synthesized image agreed.")
    return tuple(notes)
