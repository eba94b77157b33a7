"""Start processes of Python that import nothing from the working folder.

The working folder may hold what strangers made, such as photographs with a `numpy.py` beside them.
The command itself does not import from there, but Python puts that folder first on the path of
processes that it starts with `-c` or `-m`, and of multiprocessing.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from gscompleter.system.environment import set_variables

SAFE_PATH = {"PYTHONSAFEPATH": "1"}
"""Environment in which Python 3.11 and later keep the working folder off the path."""
BEGINNING = """\
import sys
# Python 3.10 does not know PYTHONSAFEPATH; `sys` is built in, so nothing was imported before.
if not getattr(sys.flags, "safe_path", False):
    del sys.path[0]
sys.path += [folder for folder in {folders!r} if folder not in sys.path]
"""
"""First lines of every program of `run_python`."""


def run_python(
    program: str, words: Sequence[str] = (), text: str | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a program in a process of its own, and return its code, output and errors.

    It can import what this process can. Its arguments are `words`, and `text` is its standard
    input; without one it has that of this process.
    """
    return subprocess.run(
        make_command(program, words),
        input=text,
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        env={**os.environ, **SAFE_PATH},
        check=False,
    )


def start_python(program: str, words: Sequence[str] = ()) -> subprocess.Popen[bytes]:
    """Start a program in a process of its own, as `run_python` does, without input and output."""
    return subprocess.Popen(
        make_command(program, words),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, **SAFE_PATH},
    )


def make_command(program: str, words: Sequence[str]) -> list[str]:
    """Make the command line of a program that can import what this process can."""
    package_root = str(Path(__file__).parents[2])
    # A script's own folder is on the path of this process only. Relative entries, among them that
    # of an interactive Python, stand for the working folder.
    folders = [folder for folder in (*sys.path, package_root) if os.path.isabs(folder)]
    return [sys.executable, "-c", BEGINNING.format(folders=folders) + program, *words]


def run_module(module: str, text: str) -> subprocess.CompletedProcess[str]:
    """Run a module as `python -m` does, in a process of its own; `text` is its standard input."""
    program = f"from runpy import run_module\nrun_module({module!r}, run_name='__main__')"
    return run_python(program, text=text)


@contextmanager
def hide_working_folder() -> Iterator[None]:
    """Keep the working folder off the path of processes that libraries start in the block.

    They begin in the folder of Python's own modules, so each has to change to its folder itself.
    No other thread may rely on the working folder meanwhile.
    """
    here = os.getcwd()
    with set_variables(SAFE_PATH):
        # Python 3.10 does not know the variable, and Ray names the working folder to its workers.
        os.chdir(Path(os.__file__).parent)
        try:
            yield
        finally:
            os.chdir(here)
