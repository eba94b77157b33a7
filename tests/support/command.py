"""The command line, run in this process."""

import sys

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
