"""Compilation of all kernels in advance, in two processes.

numba compiles one kernel at a time in a process. Every command imports this module, so it imports
slow packages only where it needs them.
"""

from __future__ import annotations

import atexit
import gc
import subprocess
import sys
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager

from gscompleter.cpu_threads import get_thread_count

SPLAT_PART = "brought"
"""Part that only input splats need."""
RENDERING_PARTS = "cpu", SPLAT_PART
MODEL_PARTS = "warp-inpaint", "plane-sweep"
"""Parts that another process compiles meanwhile, if there are several threads."""
PARTS = *RENDERING_PARTS, *MODEL_PARTS
"""All parts with kernels, in the order of compilation."""

REHEARSAL_PROGRAM = """
import sys
from gscompleter.apps.warmup.compilation import freeze_objects
with freeze_objects():
    from gscompleter.apps.warmup.rehearsal import rehearse
    for part in sys.argv[1:]:
        rehearse(part)
"""
"""Program of the second process. numba compiles a tenth faster in the block."""

COMPILING_STAGE = "compiling kernels for this machine, once"
COMPILING_SECONDS = 30
"""Approximate seconds for all parts on one core."""

Process = subprocess.Popen[bytes]
_started: dict[str, Process] = {}


@contextmanager
def freeze_objects() -> Iterator[None]:
    """Exclude all objects that exist after the block from garbage collection.

    Such objects are imported modules and compiled kernels. Each search of torch alone takes 0.2 s.
    Inside the block nothing is collected.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if enabled:
            gc.enable()


def begin_compilation(names: Iterable[str]) -> None:
    """Start to compile missing kernels of these models in another process.

    `compile_kernels` waits for it. It ends with this process at the latest.
    """
    wanted = [part for part in MODEL_PARTS if part in names and part not in _started]
    if not wanted or get_thread_count() == 1:
        return
    from gscompleter.kernels.compiled import is_compiled

    lacking = [part for part in wanted if not is_compiled(part)]
    if lacking:
        process = start_rehearsal(lacking)
        atexit.register(kill_process, process)
        _started.update(dict.fromkeys(lacking, process))


def compile_kernels(names: Collection[str]) -> float | None:
    """Compile the missing kernels of these parts; return the seconds, or None if there are none."""
    from gscompleter.kernels.compiled import is_compiled
    from gscompleter.progress import expect_stages, stage

    missing = [name for name in PARTS if name in names and not is_compiled(name)]
    if not missing:
        return None
    if any(name in RENDERING_PARTS for name in missing):
        begin_compilation(missing)
    apart = {name: _started.pop(name) for name in missing if name in _started}
    here = [name for name in missing if name not in apart]
    expected = COMPILING_SECONDS * len(missing) / len(PARTS) / (2 if here and apart else 1)
    start = time.perf_counter()
    with (
        expect_stages([(COMPILING_STAGE, expected)]),
        stage(COMPILING_STAGE),
        wait_for(set(apart.values())),
        freeze_objects(),
    ):
        from gscompleter.apps.warmup.rehearsal import rehearse

        for name in here:
            rehearse(name)
    return time.perf_counter() - start


@contextmanager
def wait_for(processes: Collection[Process]) -> Iterator[None]:
    """Wait at the end of the block for the success of processes."""
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
