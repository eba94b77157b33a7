"""Data sets of many scenes, and the selection that benchmarks use."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from gscompleter.data.cases import holds_cases, open_cases
from gscompleter.data.ego_vehicle import looking_for_vehicle
from gscompleter.data.formats import FORMATS, format_of, recognised
from gscompleter.data.photographs import Photographs, PosedPhotographs

P = TypeVar("P", bound=PosedPhotographs)


@dataclass(frozen=True)
class Skipped:
    """A scene that was left out, and why."""

    name: str
    reason: str


def open_clips(path: Path | str) -> Iterator[Photographs]:
    """Open the scenes in a file or folder of any format, a folder of such, or a `cases.json`.

    For a vehicle with several cameras only the front camera is used. Scenes are read one at a time,
    so damage raises an InputError while iterating.
    """
    path = Path(path)
    if holds_cases(path):
        return open_cases(path)
    inside = [] if recognised(path) or not os.path.isdir(path) else sorted(path.iterdir())
    folders = [child for child in inside if child.is_dir() and recognised(child)]
    scenes = [(FORMATS[format_of(place)], place) for place in folders or [path]]
    clips = (looking_ahead(clip) for format, place in scenes for clip in format.open(place))
    return (replace(clip, frames=looking_for_vehicle(clip.frames)) for clip in clips)


def looking_ahead(clip: Photographs) -> Photographs:
    """Keep the frames of the front camera if a vehicle has several cameras."""
    if clip.front is None:
        return clip
    ahead = tuple(frame for frame in clip.frames if frame.sensor == clip.front)
    return replace(clip, frames=ahead)


def usable(clips: Iterable[P], skipped: list[Skipped]) -> Iterator[P]:
    """Yield the scenes that benchmarks keep, and append the others to `skipped`."""
    for clip in clips:
        reason = clip.reason_to_skip()
        if reason is None:
            yield clip
        else:
            skipped.append(Skipped(clip.name, reason))
