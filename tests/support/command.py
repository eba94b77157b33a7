"""The command line, run in this process or on a terminal."""

import os
import subprocess
import sys
from contextlib import suppress

import pytest

from gscompleter.cli import main


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """Run `gscompleter` with these arguments; return its exit code."""
    monkeypatch.setattr(sys, "argv", ["gscompleter", *map(str, arguments)])
    try:
        main()
    except SystemExit as stop:
        return stop.code or 0
    return 0


def run_on_terminal(*arguments: str) -> tuple[int, str]:
    """Run `gscompleter` on a terminal with colours; return its exit code and what that shows."""
    pty = pytest.importorskip("pty", reason="needs pseudo-terminals, which Windows lacks")
    ours, its = pty.openpty()
    command = [sys.executable, "-m", "gscompleter", *arguments]
    environment = {**os.environ, "TERM": "xterm-256color"}
    with subprocess.Popen(command, stdout=its, stderr=its, env=environment) as process:
        os.close(its)
        shown = b""
        # At its end Linux raises an error, and other systems return nothing.
        with suppress(OSError):
            while part := os.read(ours, 1 << 16):
                shown += part
        os.close(ours)
    return process.returncode, shown.decode()
