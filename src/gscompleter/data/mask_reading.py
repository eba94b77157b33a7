"""How the user wants masks to be read. Nothing here needs torch."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MaskReading:
    """How masks are read."""

    is_inverted: bool = False
    """True to read white as black, and black as white."""
    may_be_large: bool = False
    """True to take masks that look as if they were the other way round as they are."""
    is_turned_by_option: bool = True
    """False if `--invert-masks` is for the masks of another option."""
