"""Options of the command line with a new name."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cache

from gscompleter.errors import PROGRAM

RENAMED = {
    "keep-unsupported": "no-prune",
    "generator-path": "generator-weights",
    "generator-at-once": "generator-batch-size",
    "film": "video",
    "again": "rerun",
    "ignore-masked": "use-masks",
}
"""Names of the last release with today's; they are accepted for one release."""


def use_new_names(words: Sequence[str]) -> list[str]:
    """Replace old names of options such as `--film` or `--rerun=failures`, and warn of each."""
    renamed = []
    for word in words:
        old, equals, value = word.partition("=")
        new = f"--{translate_name(old[2:])}" if old.startswith("--") else old
        renamed.append(f"{new}{equals}{value}")
    return renamed


def translate_name(name: str) -> str:
    """Return today's name of an option without dashes, and warn of an old one."""
    old = name.replace("_", "-")
    if old not in RENAMED:
        return name
    warn_renamed(old, RENAMED[old])
    return RENAMED[old]


@cache
def warn_renamed(old: str, new: str) -> None:
    """Print once per process that an option has a new name."""
    print(
        f"{PROGRAM}--{old} is now called --{new}; the old name stops working in the next release.",
        file=sys.stderr,
    )
