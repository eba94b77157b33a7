"""Rows of `summary.json` that a verdict reads, and the verdict itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from gscompleter.data.photograph_names import name_photograph

NO_USE = "not used"
"""Use of a photograph that only scores the result, in words."""
CHECK_USE = "used in a small copy"
"""Use of a photograph of which a small copy checked the input splat, in words."""


@dataclass(frozen=True)
class ScoreRow:
    """PSNR (dB) and SSIM of a camera against its photograph; None without one."""

    frame: int | None
    psnr_before: float | None
    psnr_after: float | None
    ssim_before: float | None
    ssim_after: float | None
    file: str | None = field(default=None, kw_only=True)
    """File of the photograph, below the folder of all; None if it is not known."""

    @property
    def photograph(self) -> str:
        """Number and file of the photograph."""
        return name_photograph(self.frame, self.file)


@dataclass(frozen=True)
class HeldOutRow(ScoreRow):
    """A photograph that only scores the result, where the completed scene covers it.

    The scores before are of the same pixels as those after, so that their difference is a gain. The
    pixels that stay empty count in the covered shares alone.
    """

    is_check: bool = False
    unmasked: float = 1.0
    """Share of the photograph that masks leave, which alone is scored."""
    covered_before: float = 0.0
    """Share of the valid pixels that the scene covers before the completion."""
    covered_after: float = 0.0
    above_color: float | None = None
    """PSNR in dB by which the scene before the completion is nearer to the photograph than a single
    colour, in a small image; None if it covers too little of it."""
    above_photograph: float | None = None
    """The same beyond the nearest of the photographs that were used, left as they are."""

    @property
    def use(self) -> str:
        """Say in words what the completion used it for."""
        return CHECK_USE if self.is_check else NO_USE


@dataclass(frozen=True)
class OutcomeRow:
    """The verdict on a completion."""

    status: Literal["completed", "nothing-gained", "not-reconstructed"]
    headline: str
    """First line of the report and of what the terminal shows."""
