"""Compilation of all kernels in advance, in two processes.

numba compiles one kernel at a time in a process. Every command imports this module, so it imports
slow packages only where it needs them.
"""

from __future__ import annotations

import atexit
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from gscompleter.apps.warmup.garbage import freeze_objects
from gscompleter.cpu_threads import get_thread_count

SPLAT_PART = "brought"
"""Part that only input splats need."""
RENDERING_PARTS = "cpu", SPLAT_PART
"""Parts that one process compiles while another compiles the rest."""
MODEL_PARTS = "warp-inpaint", "plane-sweep"
PARTS = *RENDERING_PARTS, *MODEL_PARTS
"""All parts with kernels, in the order of compilation."""

REHEARSAL_PROGRAM = """
import sys
from gscompleter.apps.warmup.garbage import freeze_objects
with freeze_objects():
    from gscompleter.apps.warmup.rehearsal import rehearse
    for part in sys.argv[1:]:
        rehearse(part)
"""
"""Program of the second process. numba compiles a tenth faster in the block."""

COMPILING_STAGE = "compiling kernels for this machine, once"

Process = subprocess.Popen[bytes]
_started: dict[str, Process] = {}


def begin_compilation(names: Iterable[str]) -> None:
    """Start to compile missing kernels of these models in another process.

    `compile_kernels` waits for it. It ends with this process at the latest.
    """
    wanted = [part for part in MODEL_PARTS if part in names]
    if not wanted or get_thread_count() == 1:
        return
    from gscompleter.kernels.compiled import is_compiled

    lacking = [part for part in wanted if part not in _started and not is_compiled(part)]
    if lacking:
        process = start_rehearsal(lacking)
        atexit.register(kill_process, process)
        _started.update(dict.fromkeys(lacking, process))


def compile_kernels(names: Sequence[str]) -> float | None:
    """Compile the missing kernels of these parts; return the seconds, or None if there are none."""
    from gscompleter.kernels.compiled import is_compiled
    from gscompleter.progress import stage

    missing = [name for name in PARTS if name in names and not is_compiled(name)]
    if not missing:
        return None
    own, apart = split_parts(missing, get_thread_count())
    start = time.perf_counter()
    with (
        stage(COMPILING_STAGE),
        rehearse_in_subprocess(apart),
        freeze_objects(),
    ):
        from gscompleter.apps.warmup.rehearsal import rehearse

        for name in own:
            rehearse(name)
    return time.perf_counter() - start


def split_parts(names: Sequence[str], count: int) -> tuple[list[str], list[str]]:
    """Split the parts between this process and another, if there are several threads."""
    own = [name for name in names if name in RENDERING_PARTS]
    rest = [name for name in names if name in MODEL_PARTS]
    if any(name in _started for name in rest) or (own and count > 1):
        return own, rest
    return [*own, *rest], []


@contextmanager
def rehearse_in_subprocess(names: Sequence[str]) -> Iterator[None]:
    """Compile parts in another process during the block, or wait for those started early."""
    new = [name for name in names if name not in _started]
    processes = {_started.pop(name) for name in names if name in _started}
    if new:
        processes.add(start_rehearsal(new))
    try:
        yield
        for process in processes:
            if process.wait() != 0:
                raise subprocess.CalledProcessError(process.returncode, process.args)
    finally:
        for process in processes:
            kill_process(process)


def start_rehearsal(names: Sequence[str]) -> Process:
    """Start a process that compiles parts. It ignores Ctrl-C; this process stops it."""
    command = [sys.executable, "-c", REHEARSAL_PROGRAM, *names]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)


def kill_process(process: Process) -> None:
    """Kill a process and wait for its end."""
    process.kill()
    process.wait()
