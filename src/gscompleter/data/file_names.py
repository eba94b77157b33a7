r"""Files by the names that other programs and machines wrote.

Programs and users vary the case of folders and endings, macOS splits letters with accents, Windows
separates folders by `\`, and absolute paths stay behind when a scene is copied to another machine.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path, PurePosixPath, PureWindowsPath

from gscompleter.system.files.names import fold_name, is_hidden_name, make_colmap_name

PHOTOGRAPH_ENDINGS = (
    ".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".heic", ".heif", ".avif",
)  # fmt: skip
"""Endings of photographs, in any case."""


class FolderListings:
    """Names in folders, each folder read once, so that a million look-ups stay quick.

    It belongs to one opening of a scene, because folders change between two.
    """

    def __init__(self) -> None:
        """Create it without any folder."""
        self._names: dict[Path, dict[str, str]] = {}

    def find(self, folder: Path, relative: str) -> Path | None:
        """Find `relative` below `folder`, as written or else in any case; None without it.

        A name with _ also finds a file that has blanks or # there: copies for COLMAP are named so.
        """
        if os.path.isabs(relative):
            return Path(relative) if _exists(Path(relative)) else None
        path = folder
        parts = PurePosixPath(relative).parts
        for number, part in enumerate(parts):
            if part == "..":  # which no listing has
                path = path / part
                continue
            names = self._list(path)
            # Names as they are come under their own key, others under the folded one.
            name = names.get(part) or names.get(fold_name(part))
            if name is None:
                # A folder may be entered but not listed.
                unlisted = path.joinpath(*parts[number:])
                return unlisted if not names and _exists(unlisted) else None
            path = path / name
        return path

    def _list(self, folder: Path) -> dict[str, str]:
        """Map each name to itself, and other spellings to the first name that has them."""
        if folder not in self._names:
            names: list[str] = []
            with suppress(OSError):
                # In reverse order, so that the first name of those that fold alike is written last
                # and stays.
                names = sorted(os.listdir(folder), reverse=True)
            folded = {fold_name(name): name for name in names}
            copies = {make_colmap_name(spelling): name for spelling, name in folded.items()}
            self._names[folder] = {**copies, **folded, **{name: name for name in names}}
        return self._names[folder]


def _exists(path: Path) -> bool:
    """Check whether a path exists; names that no file can have do not."""
    with suppress(OSError, ValueError):
        return os.path.exists(path)
    return False


def list_homes_of(file: Path) -> list[Path]:
    """List the folder of a file, and if it is a link also that of the file that it names.

    git-annex and DVC keep large files elsewhere, and links to them where users put them.
    """
    return list(dict.fromkeys([file.parent.resolve(), file.resolve().parent]))


def is_photograph_name(name: str) -> bool:
    """Check whether a file is named as a photograph, and not hidden."""
    return not is_hidden_name(name) and name.lower().endswith(PHOTOGRAPH_ENDINGS)


def list_stems(name: str) -> list[str]:
    """List the name of a photograph without its ending, and without that of what it is a copy of.

    COLMAP may not read `x.webp`, and its copy is called `x.webp.png`: both `x.webp` and `x`.
    """
    stem, _ = os.path.splitext(name)
    is_of_copy = stem.lower().endswith(PHOTOGRAPH_ENDINGS)
    return [stem, os.path.splitext(stem)[0]] if is_of_copy else [stem]


def list_endings(written: str) -> list[str]:
    r"""List the relative paths that a written path may mean here, the longest first.

    A relative path with `/` means itself. One with `\`, with a drive or from the root may be of
    another machine, of which any end may exist here.
    """
    is_foreign = "\\" in written or written.startswith("/") or PureWindowsPath(written).drive != ""
    if not is_foreign:
        return [written]
    parts = [part for part in re.split(r"[\\/]+", written) if part not in ("", ".")]
    # A drive letter has no meaning here.
    if parts and re.fullmatch("[A-Za-z]:", parts[0]):
        parts = parts[1:]
    return ["/".join(parts[start:]) for start in range(len(parts))]


def locate(root: Path, written: str, find: Callable[[Path], Path | None]) -> Path:
    """Find the file that a program in `root` meant by a path; as written if it is not there.

    `find` returns the file at a path, or None: a photograph may lack its ending.
    """
    as_written = root / written
    for path in dict.fromkeys([as_written, *(root / end for end in list_endings(written))]):
        file = find(path)
        if file is not None:
            return file
    return as_written
