"""Completion cases: which frames are context, target and neighbours.

A case has two or more context frames, a target frame whose photograph no stage sees, and frames
beside the target ("neighbours"), which a flat billboard in front of the target cannot satisfy. A
file of cases is JSON: `{"resolution": [h, w], "cases": [{"scene", "context", "target", "near",
"far", "neighbours"}, ...]}`. Scene folders are relative to the file, and may name variables of the
environment (`$GSCOMPLETER_DATA/data/fox`).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gscompleter.data.ego_vehicle import attach_vehicle_detector
from gscompleter.data.formats import SCENE_FORMATS, detect_format, find_format, open_photographs
from gscompleter.data.frame import describe_moved
from gscompleter.data.masks import attach_masks
from gscompleter.data.photographs import MAX_TRANSLATION, Photographs, Resolution
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_folder import holds_results
from gscompleter.system.files.reading import read_json
from gscompleter.types import View


@dataclass(frozen=True)
class Case:
    """One completion task."""

    scene: Path
    context: tuple[int, ...]
    target: int
    neighbours: tuple[int, ...]
    """Frames beside the target, for scoring only."""
    resolution: Resolution
    near: float | None = None
    far: float | None = None
    masks: bool = True
    """True if pixels that masks and alpha channels hide are ignored."""
    ignore_moving: bool = False
    """True if pixels in boxes of moving objects are ignored."""
    ego_mask: bool = True
    """True if pixels of the vehicle that carries the camera are ignored."""

    @property
    def name(self) -> str:
        """Scene, context frames and target in one line."""
        frames = "+".join(str(frame) for frame in self.context)
        return f"{self.scene.name} {frames}>{self.target}"

    def load(self, frames: tuple[int, ...]) -> list[View]:
        """Load the photographs of `frames`."""
        scene = open_photographs(self.scene, near=self.near, far=self.far)
        scene = scene if self.ego_mask else scene.keep_ego_vehicle()
        scene = scene if self.masks else scene.leave_out_masks()
        scene = scene.ignore_moving() if self.ignore_moving else scene
        return scene.views(frames, self.resolution)


def read_cases(path: Path) -> list[Case]:
    """Read the cases of a file."""
    content = read_json(path, "name a file of cases")
    try:
        height, width = (_check_whole(side) for side in content["resolution"])
        return [_parse_case(row, (height, width), path) for row in content["cases"]]
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(
            f"{path} is no file of cases ({type(error).__name__}: {quote_value(str(error))}); it "
            "needs resolution and cases, each with scene, context and target."
        ) from error


def _parse_case(row: Any, resolution: tuple[int, int], path: Path) -> Case:
    def get_plane(key: str) -> float | None:
        return None if row.get(key) is None else float(row[key])

    return Case(
        path.parent / os.path.expandvars(row["scene"]),
        _check_whole_numbers(row["context"]),
        _check_whole(row["target"]),
        _check_whole_numbers(row.get("neighbours", ())),
        resolution,
        get_plane("near"),
        get_plane("far"),
    )


def _check_whole_numbers(values: Any) -> tuple[int, ...]:
    return tuple(_check_whole(value) for value in values)


def _check_whole(value: Any) -> int:
    if type(value) is not int:
        raise TypeError(f"{quote_value(value)} is no whole number")
    return value


@dataclass(frozen=True)
class SkippedScene:
    """A scene that was left out, and why."""

    name: str
    reason: str


def list_scenes(path: Path) -> list[Path]:
    """List the scenes in a folder of scenes, without results of ours; else the path itself."""
    inside = [] if find_format(path) or not os.path.isdir(path) else sorted(path.iterdir())
    folders = [
        child
        for child in inside
        if child.is_dir() and find_format(child) and not holds_results(child)
    ]
    return folders or [path]


def open_clips(path: Path | str) -> Iterator[Photographs]:
    """Open the scenes in a file or folder of any format, or a folder of such, one at a time.

    For a vehicle with several cameras only the front camera is used.
    """
    scenes = [(SCENE_FORMATS[detect_format(place)], place) for place in list_scenes(Path(path))]
    for format, place in scenes:
        for clip in format.open(place):
            ahead = [frame for frame in clip.frames if clip.front in (None, frame.sensor)]
            frames = attach_vehicle_detector(attach_masks(ahead))
            notes = (*clip.notes, *describe_moved(ahead, clip.title))
            yield replace(clip, frames=frames, notes=notes)


def filter_usable(
    clips: Iterable[Photographs],
    skipped: list[SkippedScene],
    max_translation: float | None = MAX_TRANSLATION,
) -> Iterator[Photographs]:
    """Yield the scenes that benchmarks keep, and append the others to `skipped`.

    `max_translation` is the largest camera coordinate, in scene units; None for any.
    """
    for clip in clips:
        reason = clip.find_skip_reason(max_translation)
        if reason is None:
            yield clip
        else:
            skipped.append(SkippedScene(clip.name, reason))
