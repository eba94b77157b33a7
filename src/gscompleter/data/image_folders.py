"""Where photographs and masks lie that a file of cameras names by less than their path.

Exporters and users spell folders and endings in any case, and rename neither when they move
between systems, so names are looked for as they are written first, then in any case.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from gscompleter.data.frame import DOWNSCALED, ENDINGS, Frame
from gscompleter.errors import InputError, quoted

ORIGINALS = "input"
"""The folder of photographs before their distortion was removed, as 3DGS's scripts call it."""
FOLDERS = ("images", *(f"images_{n}" for n in DOWNSCALED), ORIGINALS)
"""Of photographs, in the order in which they are looked through."""
MASKS = "masks"
MAX_NAMED = 3
"""Missing photographs that a note names."""


def find_path(folder: Path, relative: str) -> Path | None:
    """The file or folder `relative` below `folder`, in any case; None where there is none."""
    return _Listings().find(folder, relative)


def image_folders(roots: Sequence[Path], order: Sequence[str] = FOLDERS) -> list[Path]:
    """The folders below `roots` that may hold photographs, the likeliest first.

    Args:
        roots: Folders, the nearest to the file of cameras first.
        order: Names of folders in them. Photographs may also lie in the roots themselves.
    """
    found = [find_path(root, name) for root in roots for name in order]
    return [folder for folder in found if folder is not None and folder.is_dir()] + list(roots)


class ImageFinder:
    """Finds the photographs and masks of one scene. Each folder is listed once at most."""

    def __init__(self, roots: Sequence[Path], order: Sequence[str] = FOLDERS) -> None:
        """`roots` and `order` as in `image_folders`."""
        masks = [find_path(root, MASKS) for root in roots]
        self.folders = image_folders(roots, order)
        self.masks = [folder for folder in masks if folder is not None]
        self.listings = _Listings()

    def placed(self, frame: Frame) -> Frame:
        """The frame with its photograph and its mask, as far as they are found."""
        name = PurePosixPath(frame.name)
        masks = (f"{name}.png", f"{name.parent / name.stem}.png")
        photographs = [frame.name + ending for ending in ENDINGS]
        return replace(
            frame, image=self._file(self.folders, photographs), mask=self._file(self.masks, masks)
        )

    def _file(self, folders: Sequence[Path], names: Sequence[str]) -> Path | None:
        """The first of the files of these names in the folders."""
        found = (self.listings.find(folder, name) for folder in folders for name in names)
        return next((path for path in found if path is not None and os.path.isfile(path)), None)


def with_photographs(
    frames: Sequence[Frame], title: str
) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """The frames whose photograph is there, by name, and a note that names those left out.

    Raises:
        InputError: where no photograph is there.
    """
    there = sorted((frame for frame in frames if frame.image), key=lambda frame: frame.name)
    missing = sorted(frame.name for frame in frames if not frame.image)
    if not there:
        example = f" under names such as {quoted(missing[0])}" if missing else ""
        raise InputError(
            f"None of the {len(frames)} photographs of {title} is there; put them into a folder "
            f"`{FOLDERS[0]}` beside it{example}."
        )
    return tuple(there), _note(missing, len(frames), title)


def _note(missing: Sequence[str], total: int, title: str) -> tuple[str, ...]:
    if not missing:
        return ()
    names = ", ".join(quoted(name) for name in missing[:MAX_NAMED])
    rest = ", …" if len(missing) > MAX_NAMED else ""
    verb = "is" if len(missing) == 1 else "are"
    return (
        f"{len(missing)} of {total} photographs of {title} {verb} missing ({names}{rest}) and "
        f"{verb} left out.",
    )


class _Listings:
    """What lies in folders, by names in lower case, for as long as one scene is opened."""

    def __init__(self) -> None:
        self.known: dict[Path, dict[str, str]] = {}

    def find(self, folder: Path, relative: str) -> Path | None:
        """As `find_path`."""
        if os.path.exists(folder / relative):
            return folder / relative
        found = folder
        for part in PurePosixPath(relative).parts:
            name = self._entries(found).get(part.casefold())
            if name is None:
                return None
            found = found / name
        return found

    def _entries(self, folder: Path) -> dict[str, str]:
        if folder not in self.known:
            try:
                names = os.listdir(folder)
            except (OSError, ValueError):
                names = []
            self.known[folder] = {name.casefold(): name for name in sorted(names, reverse=True)}
        return self.known[folder]
