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

from gscompleter.garbage import staying
from gscompleter.threads import threads

BROUGHT = "brought"
"""Part that only input splats need."""
DRAWING = "cpu", BROUGHT
"""Parts that one process compiles while another compiles the rest."""
MODELS = "warp-inpaint", "plane-sweep"
PARTS = *DRAWING, *MODELS
"""All parts with kernels, in the order of compilation."""

APART = """
import sys
from gscompleter.garbage import staying
with staying():
    from gscompleter.rehearsal import rehearse
    for part in sys.argv[1:]:
        rehearse(part)
"""
"""Program of the second process. numba compiles a tenth faster in the block."""

COMPILING = "compiling kernels for this machine, once"
SECONDS = 30
"""Approximate seconds for all parts on one core."""

Process = subprocess.Popen[bytes]
_begun: dict[str, Process] = {}


def begin(names: Iterable[str]) -> None:
    """Start to compile missing kernels of these models in another process.

    `compile_kernels` waits for it. It ends with this process at the latest.
    """
    wanted = [part for part in MODELS if part in names]
    if not wanted or threads() == 1:
        return
    from gscompleter.kernels.compiled import is_compiled

    lacking = [part for part in wanted if part not in _begun and not is_compiled(part)]
    if lacking:
        process = begun_apart(lacking)
        atexit.register(stopped, process)
        _begun.update(dict.fromkeys(lacking, process))


def compile_kernels(names: Sequence[str]) -> float | None:
    """Compile the missing kernels of these parts; return the seconds, or None if there are none."""
    from gscompleter.kernels.compiled import is_compiled
    from gscompleter.progress import expecting, stage

    missing = [name for name in PARTS if name in names and not is_compiled(name)]
    if not missing:
        return None
    own, apart = shares_of(missing, threads())
    expected = SECONDS * len(missing) / len(PARTS) / (2 if own and apart else 1)
    start = time.perf_counter()
    with expecting([(COMPILING, expected)]), stage(COMPILING), rehearsed_apart(apart), staying():
        from gscompleter.rehearsal import rehearse

        for name in own:
            rehearse(name)
    return time.perf_counter() - start


def shares_of(names: Sequence[str], count: int) -> tuple[list[str], list[str]]:
    """Split the parts between this process and another, if there are several threads."""
    own = [name for name in names if name in DRAWING]
    rest = [name for name in names if name in MODELS]
    if any(name in _begun for name in rest) or (own and count > 1):
        return own, rest
    return [*own, *rest], []


@contextmanager
def rehearsed_apart(names: Sequence[str]) -> Iterator[None]:
    """Compile parts in another process during the block, or wait for those started early."""
    new = [name for name in names if name not in _begun]
    processes = {_begun.pop(name) for name in names if name in _begun}
    if new:
        processes.add(begun_apart(new))
    try:
        yield
        for process in processes:
            if process.wait() != 0:
                raise subprocess.CalledProcessError(process.returncode, process.args)
    finally:
        for process in processes:
            stopped(process)


def begun_apart(names: Sequence[str]) -> Process:
    """Start a process that compiles parts. It ignores Ctrl-C; this process stops it."""
    command = [sys.executable, "-c", APART, *names]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)


def stopped(process: Process) -> None:
    """Kill a process and wait for its end."""
    process.kill()
    process.wait()
