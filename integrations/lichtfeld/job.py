"""A run of gscompleter as a program of its own, beside LichtFeld Studio.

It needs torch and numba, which the Python inside LichtFeld Studio neither has nor should get.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import threading
import time
from pathlib import Path

COMMAND = "GSCOMPLETER"
"""Variable of the environment with the command, if it is not on the path."""


def find_command() -> str:
    """Return the words that start gscompleter on this machine, or nothing."""
    return os.environ.get(COMMAND) or shutil.which("gscompleter") or ""


def make_environment() -> dict[str, str]:
    """Return the environment without what makes another Python look into this program's."""
    names = ("PYTHONHOME", "PYTHONPATH", "PYTHONEXECUTABLE", "VIRTUAL_ENV")
    return {key: value for key, value in os.environ.items() if key not in names}


class Job:
    """A running command: the last line that it said, and what came of it."""

    def __init__(
        self, command: str, words: list[str], environment: dict[str, str] | None = None
    ) -> None:
        self.line = "starting gscompleter"
        self.began = time.monotonic()
        self._lines: list[str] = []
        # Nothing is asked on the standard input, and a window of a console would flash on Windows.
        self._process = subprocess.Popen(
            [*shlex.split(command, posix=os.name != "nt"), *words, "--json"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            env=make_environment() if environment is None else environment,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
        self._readers = [
            threading.Thread(target=self._follow, daemon=True),
            threading.Thread(target=self._collect, daemon=True),
        ]
        self._answer = ""
        for reader in self._readers:
            reader.start()

    def _follow(self) -> None:
        """Keep the last line of progress."""
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if line.strip():
                self._lines.append(line.strip())
                self.line = line.strip()

    def _collect(self) -> None:
        """Keep the answer."""
        assert self._process.stdout is not None
        self._answer = self._process.stdout.read()

    @property
    def seconds(self) -> int:
        """Seconds since the start."""
        return int(time.monotonic() - self.began)

    def is_running(self) -> bool:
        """Return True until the command has ended and all of it was read."""
        return self._process.poll() is None or any(t.is_alive() for t in self._readers)

    def cancel(self) -> None:
        """End the command; it leaves no unfinished result."""
        if self._process.poll() is None:
            self._process.terminate()

    def get_error(self) -> str:
        """Return what went wrong in one sentence, or nothing."""
        code = self._process.returncode
        if code == 0:
            return ""
        # An error is the last line, after those of the progress.
        said = self._lines[-1].removeprefix("gscompleter: ") if self._lines else ""
        return said or f"gscompleter ended with code {code}."

    def get_headline(self) -> str:
        """Return what the command says of its result."""
        try:
            outcome = json.loads(self._answer).get("outcome", {})
        except (ValueError, AttributeError):
            return ""
        return str(outcome.get("headline", "")) if isinstance(outcome, dict) else ""


def is_missing(command: str) -> bool:
    """Return True if the command names no program of this machine."""
    words = shlex.split(command, posix=os.name != "nt")
    return not words or (shutil.which(words[0]) is None and not Path(words[0]).is_file())
