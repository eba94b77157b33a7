"""Decisions of the commands that run many cases."""

from __future__ import annotations

import os
from collections.abc import Sequence

from gscompleter.apps.commands.shared_options import EngineOptions
from gscompleter.apps.requests.batch import EngineRequest
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.jobs.jobs import parse_shard


def decide_engine(options: EngineOptions) -> EngineRequest:
    """Decide what runs the cases, and which share of them."""
    return EngineRequest(
        name=options.engine,
        workers=options.workers,
        threads=options.threads,
        address=options.address,
        gpus=options.gpus,
        slurm=parse_pairs(options.slurm, "slurm"),
        share=parse_shard(options.shard, os.environ),
    )


def parse_pairs(words: Sequence[str], option: str) -> dict[str, str]:
    """Parse `NAME=VALUE` words; `option`, which has them, is for errors."""
    pairs = {}
    for word in words:
        name, sign, value = word.partition("=")
        if not name or not sign:
            raise InputError(
                f"'{quote_value(word)}' is not NAME=VALUE, as in resolution=256.", option
            )
        if name in pairs:
            raise InputError(f"{quote_value(name)} is given twice; give it once.", option)
        pairs[name] = value
    return pairs
