"""Renames that wait for other programs, as Windows needs it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

REFUSES_OPEN_FILES = os.name == "nt"
"""True where no file can be renamed or replaced while any program holds it open."""
PAUSES = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
"""Seconds between attempts: scanners for viruses and indexes hold new files for a moment."""


def rename(source: Path, destination: Path) -> None:
    """Rename a file or folder; on Windows, to a name that is not taken."""
    _wait_for_others(os.rename, source, destination)


def replace(source: Path, destination: Path) -> None:
    """Rename a file, in place of another one if there is one."""
    _wait_for_others(os.replace, source, destination)


def _wait_for_others(move: Callable[[Path, Path], None], source: Path, destination: Path) -> None:
    for pause in PAUSES if REFUSES_OPEN_FILES else ():
        try:
            move(source, destination)
        except PermissionError:
            time.sleep(pause)
        else:
            return
    move(source, destination)
