"""Wall time per stage."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch.autograd.profiler import record_function

from gscompleter.system.progress import stage

STAGES = ("context", "generate", "lift", "register", "integrate")
"""Stages whose wall time every completion records."""
STAGE_PREFIX = "gscompleter: "
"""A profile of torch shows each stage as a range of this and its name."""

_record: ContextVar[dict[str, float] | None] = ContextVar("record", default=None)
"""Seconds per stage of the innermost `record_seconds`; None inside a stage."""


@contextmanager
def record_seconds(stages: Sequence[str] = STAGES) -> Iterator[dict[str, float]]:
    """Record the wall time in seconds of each stage that runs inside, and of everything as `total`.

    What a GPU was given inside counts, with or without a stage around it.
    """
    seconds = dict.fromkeys(stages, 0.0)
    start = time.perf_counter()
    token = _record.set(seconds)
    try:
        yield seconds
    finally:
        _record.reset(token)
        wait_for_gpu()
        seconds["total"] = time.perf_counter() - start


@contextmanager
def timed_stage(name: str) -> Iterator[None]:
    """Show a stage as running and record its wall time; inside another stage, it counts there."""
    seconds = _record.get()
    start = time.perf_counter()
    # A stage inside this one finds no record, and so is not counted twice.
    token = _record.set(None)
    try:
        with stage(name), record_function(STAGE_PREFIX + name):
            yield
    finally:
        _record.reset(token)
        wait_for_gpu()
        if seconds is not None:
            seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start


def wait_for_gpu() -> None:
    """Wait until a GPU has done what it was given; it works on after calls have returned."""
    # Only if something ran on a GPU: asking CUDA itself would start it, for half a second and half
    # a gigabyte, even with `--device cpu`.
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def add_seconds(before: Mapping[str, float], more: Mapping[str, float]) -> dict[str, float]:
    """Add wall times stage by stage."""
    return {name: before.get(name, 0.0) + more.get(name, 0.0) for name in {**before, **more}}
