"""Results of versions that did not yet list their files: which command wrote them, and which files.

A summary of that time is known by its entries, and the files beside it by their names. Only names
that no user would choose count: other files in the folder stay.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gscompleter.system.files.result_names import COMPLETED_FILE, REMOVED_FILE, SUMMARY_FILE

COMPLETION_ENTRIES = frozenset(
    ("version", "settings", "seed", "device", "scene", "frame", "targets", "gaussians", "seconds")
)
CLEANING_ENTRIES = frozenset(("version", "settings", "gaussians", "seconds"))
CLEANING_COUNTS = frozenset(("given", "kept", "removed"))
"""Keys of the entry `gaussians` of a cleaning."""
POSES_ENTRIES = frozenset(("poses", "photographs"))

COMPLETION_FILES = re.compile(
    r"(completed|context|generated|removed)\.ply|(summary|targets|report)\.json|report\.html"
    r"|video\.mp4"
    r"|images/target\d+_(before|after|reference|hole_mask|truth)\.png|images/context\d+_ignored\.png"
)
MODEL_FILES = re.compile(r"sparse/0/(cameras|frames|images|points3D|rigs)\.bin")
FRAME_FILES = re.compile(r"images/frame_\d{6}\.jpg")
"""Frames of a film, which become its photographs."""
EARLY_FOLDERS = ("", "images", "sparse/0")
"""Folders that such a version wrote to."""


@dataclass(frozen=True)
class EarlyResults:
    """What a version that listed no files wrote to a folder."""

    command: str
    files: list[str]
    """Paths relative to the folder, of files that are there."""


def describe_early(folder: Path, content: Mapping[str, Any]) -> EarlyResults | None:
    """Describe the results of an early version by its summary; None if it is not of one."""
    entries = content.keys()
    gaussians = content.get("gaussians")
    counts = gaussians.keys() if isinstance(gaussians, dict) else frozenset()
    if "files" in entries:
        return None
    if counts and entries >= COMPLETION_ENTRIES:
        command = "complete"
        files = [name for name in _list_early_files(folder) if COMPLETION_FILES.fullmatch(name)]
    elif counts == CLEANING_COUNTS and entries >= CLEANING_ENTRIES:
        command = "clean"
        known = {COMPLETED_FILE, REMOVED_FILE, SUMMARY_FILE}
        files = [name for name in _list_early_files(folder) if name in known]
    elif entries == POSES_ENTRIES and isinstance(content["photographs"], dict):
        command = "poses"
        known = {SUMMARY_FILE, *_name_copies(content["photographs"])}
        files = [
            name
            for name in _list_early_files(folder)
            if name in known or MODEL_FILES.fullmatch(name) or FRAME_FILES.fullmatch(name)
        ]
    else:
        return None
    return EarlyResults(command, files)


def _list_early_files(folder: Path) -> Iterator[str]:
    """List the files of the folders that an early version wrote to."""
    for home in EARLY_FOLDERS:
        names = []
        with suppress(OSError):
            names = sorted(os.listdir(folder / home))
        for name in names:
            path = f"{home}/{name}" if home else name
            if os.path.isfile(folder / path):
                yield path


def _name_copies(photographs: Mapping[str, Any]) -> Iterator[str]:
    """Name the upright copies of photographs, which were named like them, some with .png added."""
    for name in photographs:
        copy = "images/" + re.sub(r"[\s#]", "_", name)
        yield from (copy, f"{copy}.png")
