"""The engine of commands that run many cases, and words of the form NAME=VALUE."""

from __future__ import annotations

import os
from collections.abc import Sequence

from gscompleter.apps.commands.shared_options import EngineOptions
from gscompleter.apps.requests.batch import EngineRequest
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.jobs.engine_names import EngineName
from gscompleter.system.jobs.jobs import parse_shard

ENGINES_THAT_FOLLOW: dict[str, tuple[EngineName, ...]] = {
    "workers": ("local", "ray", "submitit"),
    "address": ("ray",),
    "gpus": ("ray", "submitit"),
    "slurm": ("submitit",),
}
"""Engines that follow an option, by its name."""


def decide_engine(options: EngineOptions) -> EngineRequest:
    """Decide what runs the cases, and which share of them.

    Raise InputError for an option that the engine does not follow.
    """
    for name, engines in ENGINES_THAT_FOLLOW.items():
        if getattr(options, name) != getattr(EngineOptions, name) and options.engine not in engines:
            raise InputError(
                f"This option is for --engine {' or '.join(engines)}; choose it, or leave this "
                "option out.",
                name,
            )
    return EngineRequest(
        name=options.engine,
        workers=options.workers,
        threads=options.threads,
        address=options.address,
        gpus=options.gpus,
        slurm=parse_pairs(options.slurm, "slurm", "partition=gpu"),
        share=parse_shard(options.shard, os.environ),
    )


def parse_pairs(words: Sequence[str], option: str, example: str) -> dict[str, str]:
    """Parse `NAME=VALUE` words; `option`, which has them, and an `example` are for errors."""
    pairs = {}
    for word in words:
        name, sign, value = word.partition("=")
        if not name or not sign:
            raise InputError(f"'{quote_value(word)}' is not NAME=VALUE, as in {example}.", option)
        if name in pairs:
            raise InputError(f"{quote_value(name)} is given twice; give it once.", option)
        pairs[name] = value
    return pairs
