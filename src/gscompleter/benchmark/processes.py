"""A command in a process of its own, with its time and memory."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from gscompleter.errors import InputError

ENTRY = """
import sys
from pathlib import Path
from gscompleter.cli import run
peak = Path(sys.argv.pop(1))
try:
    run()
finally:
    from gscompleter.runs.memory import peak_of_process
    peak.write_text(str(peak_of_process() or ""))
"""
"""What the process runs. It tells its peak itself: what the system tells of a child counts its
parent's memory, too, which the child shares until it becomes another program."""


@dataclass(frozen=True)
class Ended:
    """A process that did its work."""

    seconds: float
    """Wall time from its start to its end, start-up and imports included."""
    peak_bytes: int | None
    """The most resident memory it held; None where the system does not tell."""


def run_alone(words: Sequence[str]) -> Ended:
    """Run `gscompleter` with these words.

    Raises:
        InputError: with the sentence of the command, where it refuses its input.
        RuntimeError: where it fails otherwise.
    """
    with TemporaryDirectory() as folder:
        peak = Path(folder) / "peak"
        start = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", ENTRY, str(peak), *words],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        seconds = time.perf_counter() - start
        if done.returncode == 2:
            raise InputError(done.stderr.strip().removeprefix("gscompleter: "))
        if done.returncode != 0:
            raise RuntimeError(f"gscompleter {' '.join(words)} failed:\n{done.stderr}")
        told = peak.read_text()
    return Ended(seconds, int(told) if told else None)
