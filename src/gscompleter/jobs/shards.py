"""Shards: every n-th job, so that independent processes share a batch."""

from __future__ import annotations

import re
from collections.abc import Mapping

from gscompleter.errors import InputError, quote_value

Shard = tuple[int, int]
"""(i, n) stands for the jobs i, i + n, i + 2n, …; i starts at 0."""

SLURM_VARIABLES = ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_MIN", "SLURM_ARRAY_TASK_COUNT")
"""SLURM variables: number of this task of an array, of the first task, and of tasks."""


def parse_shard(text: str | None, environment: Mapping[str, str]) -> Shard:
    """Parse `i/n`, or `auto` for a task of a SLURM array; None means all jobs."""
    if text is None:
        return 0, 1
    if text == "auto":
        return parse_slurm_shard(environment)
    match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if match is None:
        raise InputError(
            f"The shard is '{quote_value(text)}'; give it as i/n, as in 0/4 for the first of "
            "four, or "
            "auto in an array of SLURM.",
            "shard",
        )
    return check_shard((int(match[1]), int(match[2])))


def parse_slurm_shard(environment: Mapping[str, str]) -> Shard:
    """Return the shard of a SLURM task; the numbers of the array have to be consecutive."""
    numbers = [environment.get(name, "") for name in SLURM_VARIABLES]
    if not all(number.isdecimal() for number in numbers):
        raise InputError(
            f"{SLURM_VARIABLES[0]} and {SLURM_VARIABLES[2]} are not set, so this is no SLURM "
            "array; give the shard as "
            "i/n.",
            "shard",
        )
    task, first, count = map(int, numbers)
    return check_shard((task - first, count))


def check_shard(shard: Shard) -> Shard:
    """Return the shard, or raise InputError if it is impossible."""
    number, count = shard
    if not 0 <= number < count:
        raise InputError(
            f"There is no shard {number}/{count}; of n shards the first is 0/n, the last (n-1)/n."
        )
    return shard
