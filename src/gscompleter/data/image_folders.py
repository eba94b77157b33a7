"""Search for the photographs and masks that a camera file names.

Programs and users vary the case of folders and endings, so names are tried as written first, then
in any case.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from gscompleter.data.frame import DOWNSCALE_FACTORS, ENDINGS, Frame
from gscompleter.errors import InputError, join_names, quote_value

ORIGINALS = "input"
"""Folder of photographs before undistortion, as in the scripts of 3DGS."""
FOLDERS = ("images", *(f"images_{n}" for n in DOWNSCALE_FACTORS), ORIGINALS)
"""Usual folders of photographs, in search order."""
MASKS = "masks"
MAX_NAMED = 3
"""Missing photographs that a note names."""


def find_path(folder: Path, relative: str) -> Path | None:
    """Find `relative` below `folder`, ignoring case; None if it does not exist."""
    if os.path.exists(folder / relative):
        return folder / relative
    for part in PurePosixPath(relative).parts:
        names = sorted(os.listdir(folder)) if os.path.isdir(folder) else []
        same = [name for name in names if name.casefold() == part.casefold()]
        if not same:
            return None
        folder = folder / same[0]
    return folder


class ImageFinder:
    """Finder of the photographs and masks of one scene.

    `roots` are the nearest first, and `order` are the folders in them, the likeliest first.
    """

    def __init__(self, roots: Sequence[Path], order: Sequence[str] = FOLDERS) -> None:
        masks = [find_path(root, MASKS) for root in roots]
        folders = [find_path(root, name) for root in roots for name in order]
        self.folders = [folder for folder in folders if folder is not None and folder.is_dir()]
        self.folders += roots
        self.masks = [folder for folder in masks if folder is not None]

    def locate(self, frame: Frame) -> Frame:
        """Return the frame with the paths of its photograph and mask, if they exist."""
        name = PurePosixPath(frame.name)
        masks = (f"{name}.png", f"{name.parent / name.stem}.png")
        photographs = [frame.name + ending for ending in ENDINGS]
        image, mask = _find_file(self.folders, photographs), _find_file(self.masks, masks)
        return replace(frame, image=image, mask=mask)


def _find_file(folders: Sequence[Path], names: Sequence[str]) -> Path | None:
    found = (find_path(folder, name) for folder in folders for name in names)
    return next((path for path in found if path is not None and os.path.isfile(path)), None)


def keep_existing(frames: Sequence[Frame], title: str) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """Keep the frames whose photograph exists, sorted by name, and note the missing ones."""
    there = sorted((frame for frame in frames if frame.image), key=lambda frame: frame.name)
    missing = sorted(frame.name for frame in frames if not frame.image)
    if not there:
        example = f" under names such as {quote_value(missing[0])}" if missing else ""
        raise InputError(
            f"None of the {len(frames)} photographs of {title} is there; put them into a folder "
            f"`{FOLDERS[0]}` beside it{example}."
        )
    if not missing:
        return tuple(there), ()
    note = (
        f"{len(missing)} of {len(frames)} photographs of {title} are missing and left out: "
        f"{join_names(missing, MAX_NAMED)}."
    )
    return tuple(there), (note,)
