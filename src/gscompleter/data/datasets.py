"""Data sets of many scenes, and the selection that benchmarks use."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from gscompleter.data.cases import has_cases, open_cases
from gscompleter.data.ego_vehicle import attach_vehicle_detector
from gscompleter.data.formats import FORMATS, detect_format, find_format
from gscompleter.data.photographs import Photographs, PosedPhotographs

P = TypeVar("P", bound=PosedPhotographs)


@dataclass(frozen=True)
class SkippedScene:
    """A scene that was left out, and why."""

    name: str
    reason: str


def open_clips(path: Path | str) -> Iterator[Photographs]:
    """Open the scenes in a file or folder of any format, a folder of such, or a `cases.json`.

    For a vehicle with several cameras only the front camera is used. Scenes are read one at a time,
    so damage raises an InputError while iterating.
    """
    path = Path(path)
    if has_cases(path):
        return open_cases(path)
    inside = [] if find_format(path) or not os.path.isdir(path) else sorted(path.iterdir())
    folders = [child for child in inside if child.is_dir() and find_format(child)]
    scenes = [(FORMATS[detect_format(place)], place) for place in folders or [path]]
    clips = (select_front_camera(clip) for format, place in scenes for clip in format.open(place))
    return (replace(clip, frames=attach_vehicle_detector(clip.frames)) for clip in clips)


def select_front_camera(clip: Photographs) -> Photographs:
    """Keep the frames of the front camera if a vehicle has several cameras."""
    if clip.front is None:
        return clip
    ahead = tuple(frame for frame in clip.frames if frame.sensor == clip.front)
    return replace(clip, frames=ahead)


def filter_usable(clips: Iterable[P], skipped: list[SkippedScene]) -> Iterator[P]:
    """Yield the scenes that benchmarks keep, and append the others to `skipped`."""
    for clip in clips:
        reason = clip.find_skip_reason()
        if reason is None:
            yield clip
        else:
            skipped.append(SkippedScene(clip.name, reason))
