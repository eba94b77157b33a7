"""Scores averaged and written as text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from statistics import fmean

MIN_MASKED = 0.1
"""Share of photographs that masks hide from which it is said beside their scores."""


def average(values: Iterable[float | None]) -> float | None:
    """Average the scores that there are; None without any."""
    known = [value for value in values if value is not None]
    return fmean(known) if known else None


def format_number(value: float | None, digits: int = 2) -> str:
    """Format a number, with a dash for None or an infinite one."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def format_percent(share: float | None, digits: int = 1) -> str:
    """Format a fraction as a percentage."""
    return "–" if share is None or not math.isfinite(share) else f"{100 * share:.{digits}f} %"


def format_change(before: float | None, after: float | None, digits: int = 2) -> str:
    """Format the change of a score with its sign."""
    if before is None or after is None or not math.isfinite(after - before):
        return "–"
    # Adding 0.0 turns -0.0 into 0.0, so that no change is "+0.00" and never "-0.00".
    return f"{round(after - before, digits) + 0.0:+.{digits}f}"


def describe_measured(unmasked: Sequence[float]) -> str:
    """Say in a clause how much of each picture was measured, if masks hide much; empty if not.

    `unmasked` are the shares that masks leave.
    """
    left = fmean(unmasked)
    if left > 1 - MIN_MASKED:
        return ""
    return f", over the {format_percent(left, 0)} of the picture that masks leave"
