"""Comparison of synthesized images with the photographs, and correction of colour shifts.

A network may paint the scene in other colours, or another scene. The colours that it gave to pixels
which the photographs show tell both: an affine shift of each channel is fitted to them and undone,
and what still differs decides whether the image shows the scene. All colours are in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.generators import GeneratorOutput
from gscompleter.generators.warp import WarpedImage
from gscompleter.numerics.image_ops import smooth_masked
from gscompleter.numerics.robust import fit_robust_affine
from gscompleter.system.errors import InputError

COMPARED_BLUR = 2
"""Radius in pixels of the mean before colours are compared; edges may be a pixel off."""
MAX_SHARE = 0.6
"""Largest residual of a consistent image, relative to that of an image of one colour."""
RESIDUAL_QUANTILE = 0.7
"""Quantile of the residuals; higher than the median, which may be a blank wall."""
MIN_LIMIT = 0.03
"""Residual that is always accepted."""
MAX_SHIFT_GAIN = 1.6
"""Largest gain of a colour shift; its inverse is the smallest."""
MAX_OFFSET = 0.25
"""Largest offset of a colour shift, either way."""
MIN_OBSERVED_PIXELS = 200
"""Fewest observed pixels for a comparison."""


@dataclass(frozen=True)
class Agreement:
    """Comparison of an image with the photographs: `photographed = gain * image + offset`."""

    gain: Float[Tensor, "3"]
    """Of each channel; 1 if a consistent image is not to be corrected, or was not compared."""
    offset: Float[Tensor, "3"]
    """Of each channel; likewise 0."""
    residual: float
    """Quantile of the colour differences that are left by the best shift, corrected or not."""
    limit: float
    """Largest residual of a consistent image."""
    is_consistent: bool
    """True if the image is consistent with the photographs, or cannot be compared."""
    image: Float[Tensor, "h w 3"]
    """The image; with the shift corrected if it is consistent and correction is asked for."""

    @property
    def is_finite(self) -> bool:
        """False if the image has NaN or infinity; it was not compared then."""
        return self.residual != float("inf")

    def describe_difference(self) -> str:
        """Describe in a clause why an image of finite colours is not consistent."""
        gains = ", ".join(f"{gain:.2f}" for gain in self.gain.tolist())
        if self.residual > self.limit:
            return (
                f"colours differ by {self.residual:.3f} ({self.limit:.3f} is the limit) after "
                f"scaling the channels by {gains}"
            )
        offsets = ", ".join(f"{offset:+.2f}" for offset in self.offset.tolist())
        return (
            f"colours fit only with channels scaled by {gains} (at most {MAX_SHIFT_GAIN} or its "
            f"inverse) and shifted by {offsets} (at most {MAX_OFFSET})"
        )


def paint_consistently(
    paint: Callable[[int], Float[Tensor, "h w 3"]],
    seed: int,
    observed: WarpedImage,
    retries: int = 0,
    correct_color: bool = True,
) -> GeneratorOutput:
    """Paint an image from a seed, compare it with the photographs and correct its colours.

    `paint` makes the image of a seed; `observed` are the photographs warped to its camera. While it
    is inconsistent, up to `retries` further seeds are tried, those after `seed`. The best image is
    kept, and a note tells if that is inconsistent, too.

    Raises:
        InputError: No seed gives finite colours.
    """
    attempts: list[Agreement] = []
    for attempt in range(retries + 1):
        image = paint(seed + attempt)
        agreement = compare_with_observed(image, observed.image, observed.known, correct_color)
        attempts.append(agreement)
        if agreement.is_consistent:
            break

    # A consistent image may have a larger residual than one that was refused for its gain.
    best = min(attempts, key=lambda agreement: (not agreement.is_consistent, agreement.residual))
    if not best.is_finite:
        raise InputError(
            f"The generator painted no finite image ({len(attempts)} seed(s) tried); check that "
            "its weights are correct, or choose another generator."
        )
    if best.is_consistent:
        return GeneratorOutput(best.image)

    seeds = "" if len(attempts) == 1 else f" (best of {len(attempts)} seeds)"
    note = (
        "The synthesized image disagrees with the photographs: over the "
        f"{observed.known.float().mean():.0%} of it that they show, {best.describe_difference()}"
        f"{seeds}."
    )
    return GeneratorOutput(best.image, (note,), is_inconsistent=True)


def compare_with_observed(
    image: Float[Tensor, "h w 3"],
    observed: Float[Tensor, "h w 3"],
    known: Bool[Tensor, "h w"],
    correct_color: bool = True,
) -> Agreement:
    """Fit the colour shift of `image` to the `known` pixels, and correct a consistent image.

    `observed` is what the photographs show there; its other pixels do not count. With
    `correct_color` off, a consistent image is not shifted. An image that the photographs show too
    little of is consistent, and one with NaN or infinity never.
    """
    ones = torch.ones(3).to(image)
    zeros = torch.zeros(3).to(image)
    if not image.isfinite().all():
        return Agreement(ones, zeros, float("inf"), MIN_LIMIT, False, image)
    if int(known.sum()) < MIN_OBSERVED_PIXELS:
        return Agreement(ones, zeros, 0.0, MIN_LIMIT, True, image)

    painted = smooth_masked(image, known, COMPARED_BLUR)[known]
    photographed = smooth_masked(observed, known, COMPARED_BLUR)[known]
    gain, offset = fit_robust_affine(painted, photographed)
    differences = (gain * painted + offset - photographed).abs().mean(dim=-1)
    residual = compute_quantile(differences, RESIDUAL_QUANTILE)

    # How well an image has to agree depends on the contrast of the photographs: it has to be
    # clearly better than an image of their median colour alone.
    median = photographed.median(dim=0).values
    contrast = compute_quantile((photographed - median).abs().mean(dim=-1), RESIDUAL_QUANTILE)
    limit = max(MIN_LIMIT, MAX_SHARE * contrast)

    # With any gain and offset, an image of another scene could be fitted, too.
    is_gain_plausible = bool(((gain >= 1 / MAX_SHIFT_GAIN) & (gain <= MAX_SHIFT_GAIN)).all())
    is_offset_plausible = bool((offset.abs() <= MAX_OFFSET).all())
    agrees = is_gain_plausible and is_offset_plausible and residual <= limit
    if agrees and not correct_color:
        gain = ones
        offset = zeros
    corrected = (gain * image + offset).clamp(0, 1) if agrees else image
    return Agreement(gain, offset, residual, limit, agrees, corrected)


def compute_quantile(values: Float[Tensor, "n"], share: float) -> float:
    """Return the value below which a fraction `share` of the values lies; there is at least one."""
    # `torch.quantile` refuses more than 16 million values.
    return values.kthvalue(1 + int(share * (len(values) - 1))).values.item()
