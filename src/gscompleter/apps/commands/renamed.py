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
    """Replace old option names in the words of a command line, and warn of each."""
    return [use_new_name(word) if word.startswith("--") else word for word in words]


def use_new_name(word: str) -> str:
    """Replace an old option name such as `--film` or `--rerun=failures`, and warn of it."""
    old, equals, value = word.partition("=")
    return f"--{translate_name(old[2:])}{equals}{value}"


def translate_name(name: str) -> str:
    """Return today's name of an option without dashes, and warn of an old one."""
    new = RENAMED.get(name.replace("_", "-"))
    if new is None:
        return name
    warn_renamed(name.replace("_", "-"), new)
    return new


@cache
def warn_renamed(old: str, new: str) -> None:
    """Print once per process that an option has a new name."""
    print(
        f"{PROGRAM}--{old} is now called --{new}; the old name stops working in the next release.",
        file=sys.stderr,
    )
