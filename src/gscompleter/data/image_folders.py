"""Where photographs and masks lie that a file of cameras names by less than their path.

Exporters and users spell folders and endings in any case, and rename neither when they move
between systems, so names are looked for as they are written first, then in any case.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
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
    if os.path.exists(folder / relative):
        return folder / relative
    found = folder
    for part in PurePosixPath(relative).parts:
        same = [entry for entry in _entries(found) if entry.casefold() == part.casefold()]
        if not same:
            return None
        found = found / min(same)
    return found


def image_folders(roots: Sequence[Path], order: Sequence[str] = FOLDERS) -> list[Path]:
    """The folders below `roots` that may hold photographs, the likeliest first.

    Args:
        roots: Folders, the nearest to the file of cameras first.
        order: Names of folders in them. Photographs may also lie in the roots themselves.
    """
    found = [find_path(root, name) for root in roots for name in order]
    return [folder for folder in found if folder is not None] + list(roots)


def find_photograph(folders: Iterable[Path], name: str) -> Path | None:
    """The photograph of that name, which may lack its ending; None where there is none."""
    candidates = (find_path(folder, name + ending) for folder in folders for ending in ENDINGS)
    return next((path for path in candidates if path is not None and os.path.isfile(path)), None)


def find_mask(roots: Iterable[Path], name: str) -> Path | None:
    """The mask of the photograph of that name: `masks/NAME.png`, with its ending or without."""
    folders = [find_path(root, MASKS) for root in roots]
    stem = str(PurePosixPath(name).with_suffix("")) if PurePosixPath(name).name else name
    names = (f"{name}.png", f"{stem}.png")
    candidates = (find_path(folder, n) for folder in folders if folder for n in names)
    return next((path for path in candidates if path is not None and os.path.isfile(path)), None)


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


def placed(frame: Frame, folders: Sequence[Path], roots: Sequence[Path]) -> Frame:
    """The frame with its photograph and its mask, as far as they are found."""
    image = find_photograph(folders, frame.name)
    return replace(frame, image=image, mask=find_mask(roots, frame.name))


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


def _entries(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError:
        return []
