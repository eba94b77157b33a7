"""Requests for many cases, on several processes or machines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from gscompleter.apps.requests.answer import AnswerRequest
from gscompleter.system.jobs.engine_names import EngineName


@dataclass(frozen=True, kw_only=True)
class EngineRequest:
    """What runs the cases, and which share of them."""

    name: EngineName | None = None
    """Processes of this machine, Ray, or SLURM (`submitit`); None for this process alone, which
    follows nothing below but `share`."""
    workers: int | None = None
    """Number of workers; None for as many as fit, or one with SLURM."""
    threads: int | None = None
    """CPU threads of each worker; None for an equal share of this machine's cores, or one
    elsewhere."""
    address: str | None = None
    """Address of a running Ray cluster; None to start one here. Of Ray alone."""
    gpus: float = 0.0
    """GPUs per worker, of Ray and SLURM."""
    slurm: Mapping[str, str] = field(default_factory=dict)
    """Parameters for SLURM."""
    share: tuple[int, int] = (0, 1)
    """Number of this share, from 0, and the number of shares."""


@dataclass(frozen=True, kw_only=True)
class BatchRequest:
    """Complete the scenes of a manifest."""

    manifest: Path
    """File with a row per scene, or a folder of scenes."""
    out: Path
    """Folder of the results; those of an earlier run are continued."""
    common: Mapping[str, str] = field(default_factory=dict)
    """Options of `complete` for every row that does not set them."""
    engine: EngineRequest
    retries: int = 2
    """Further attempts for a job that was killed or that failed unexpectedly."""
    repeats_failures: bool = False
    """True to repeat jobs that failed in an earlier run."""
    answer: AnswerRequest = AnswerRequest()
