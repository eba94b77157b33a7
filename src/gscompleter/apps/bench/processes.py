"""A command in its own process, with its time and memory."""

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
    from gscompleter.evaluation.memory import read_process_peak
    peak.write_text(str(read_process_peak() or ""))
"""
"""Program of the process. It reports its own peak, because a child inherits its parent's."""


@dataclass(frozen=True)
class ProcessResult:
    """Result of a process that succeeded."""

    seconds: float
    """Wall time with start-up and imports."""
    peak_bytes: int | None
    """Peak resident memory, or None if the system does not report it."""


def run_command(arguments: Sequence[str]) -> ProcessResult:
    """Run `gscompleter` with these arguments; raise InputError if it rejects its input."""
    with TemporaryDirectory() as folder:
        peak = Path(folder) / "peak"
        start = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", ENTRY, str(peak), *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        seconds = time.perf_counter() - start
        if done.returncode == 2:
            raise InputError(done.stderr.strip().removeprefix("gscompleter: "))
        if done.returncode != 0:
            raise RuntimeError(f"gscompleter {' '.join(arguments)} failed:\n{done.stderr}")
        peak_bytes = peak.read_text()
    return ProcessResult(seconds, int(peak_bytes) if peak_bytes else None)
