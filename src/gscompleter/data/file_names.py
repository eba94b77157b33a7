r"""Files by the names that other programs and machines wrote.

Programs and users vary the case of folders and endings, Windows separates folders by `\`, and
absolute paths stay behind when a scene is copied to another machine.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path, PurePosixPath, PureWindowsPath


class FolderListings:
    """Names in folders, each folder read once, so that thousands of look-ups stay quick.

    It belongs to one opening of a scene, because folders change between two.
    """

    def __init__(self) -> None:
        """Create it without any folder."""
        self._names: dict[Path, dict[str, str]] = {}

    def find(self, folder: Path, relative: str) -> Path | None:
        """Find `relative` below `folder`, as written or else in any case; None without it."""
        exact = folder / relative
        if os.path.exists(exact):
            return exact
        for part in PurePosixPath(relative).parts:
            if part in ("..", "/"):  # names that no listing has
                folder = folder / part
                continue
            name = self._list(folder).get(part.casefold())
            if name is None:
                return None
            folder = folder / name
        return folder

    def _list(self, folder: Path) -> dict[str, str]:
        if folder not in self._names:
            names = sorted(os.listdir(folder), reverse=True) if os.path.isdir(folder) else []
            # Of names that differ in case only the first in order counts.
            self._names[folder] = {name.casefold(): name for name in names}
        return self._names[folder]


def list_endings(written: str) -> list[str]:
    r"""List the relative paths that a written path may mean here, the longest first.

    A relative path with `/` means itself. One with `\`, with a drive or from the root may be of
    another machine, of which any end may exist here.
    """
    is_foreign = "\\" in written or PureWindowsPath(written).drive or written.startswith("/")
    if not is_foreign:
        return [written]
    parts = [part for part in re.split(r"[\\/]+", written) if part not in ("", ".")]
    if parts and re.fullmatch("[A-Za-z]:", parts[0]):
        parts = parts[1:]
    return ["/".join(parts[start:]) for start in range(len(parts))]


def locate(root: Path, written: str, find: Callable[[Path], Path | None]) -> Path:
    """Find the file that a program in `root` meant by a path; as written if it is not there.

    `find` returns the file at a path, or None: a photograph may lack its ending.
    """
    as_written = root / written
    candidates = (as_written, *(root / ending for ending in list_endings(written)))
    return next((file for path in candidates if (file := find(path)) is not None), as_written)
