"""Shards: every n-th of the jobs, so that processes that know nothing of each other share them."""

from __future__ import annotations

import re
from collections.abc import Mapping

from gscompleter.errors import InputError, quoted

Shard = tuple[int, int]
"""(i, n): the jobs i, i + n, i + 2n, …; n shards with i from 0 are all of them."""

ARRAY = ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_MIN", "SLURM_ARRAY_TASK_COUNT")
"""Where SLURM says which task of an array this is, the number of the first, and how many."""


def parse_shard(text: str | None, environment: Mapping[str, str]) -> Shard:
    """`i/n` as numbers; `auto` is what SLURM says of its array. Without a word it is all.

    Raises:
        InputError: where there is no such shard, or none is told of.
    """
    if text is None:
        return 0, 1
    if text == "auto":
        return shard_of_array(environment)
    match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if match is None:
        raise InputError(
            f"The shard is '{quoted(text)}'; give it as i/n, as in 0/4 for the first of four, or "
            "auto in an array of SLURM.",
            "shard",
        )
    return checked_shard((int(match[1]), int(match[2])))


def shard_of_array(environment: Mapping[str, str]) -> Shard:
    """The shard that a task of an array of SLURM is, whose numbers follow one another."""
    told = [environment.get(name, "") for name in ARRAY]
    if not all(number.isdecimal() for number in told):
        raise InputError(
            f"{ARRAY[0]} and {ARRAY[2]} are not set, as they are in an array of SLURM; give the "
            "shard as i/n.",
            "shard",
        )
    task, first, count = map(int, told)
    return checked_shard((task - first, count))


def checked_shard(shard: Shard) -> Shard:
    """`shard`; an InputError where there is no such one."""
    number, count = shard
    if not 0 <= number < count:
        raise InputError(
            f"There is no shard {number}/{count}; of n shards the first is 0/n, the last (n-1)/n."
        )
    return shard
