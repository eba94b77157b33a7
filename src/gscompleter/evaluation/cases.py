"""Completion cases: which frames are context, target and neighbours.

A case has two or more context frames, a target frame whose photograph no stage sees, and frames
beside the target ("neighbours"), which a flat billboard in front of the target cannot satisfy.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from gscompleter.data.ego_vehicle import attach_vehicle_detector
from gscompleter.data.formats import SCENE_FORMATS, detect_format, find_format, open_photographs
from gscompleter.data.frame import describe_moved
from gscompleter.data.ignored_regions import IgnoredRegions
from gscompleter.data.masks import attach_masks
from gscompleter.data.photographs import MAX_TRANSLATION, Photographs, Resolution
from gscompleter.evaluation.case_file import (
    CaseFile,
    is_scene_file,
    locate_named,
    read_case_file,
    read_scene_file,
)
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_folder import holds_results
from gscompleter.system.files.reading import list_entries
from gscompleter.types import View

REGION_SIDE = 512
"""Size of the square in which regions to ignore are checked, in pixels."""


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
    uses_masks: bool = True
    """True if pixels that masks and alpha channels hide are ignored."""
    has_inverted_masks: bool = False
    """True if white pixels of masks are ignored, not black ones."""
    ignore_moving: bool = False
    """True if pixels in boxes of moving objects are ignored."""
    ego_mask: bool = True
    """True if pixels of the vehicle that carries the camera are ignored."""
    ignore: IgnoredRegions | None = None
    """What does not count in any of the photographs, besides masks; None for nothing."""
    apart_by: Path | None = None
    """File of cases that keeps this one apart, or None."""

    @property
    def name(self) -> str:
        """Scene, context frames and target in one line."""
        frames = "+".join(str(frame) for frame in self.context)
        return f"{self.scene.name} {frames}>{self.target}"

    def open(self) -> Photographs:
        """Open the photographs of the scene."""
        scene = open_photographs(self.scene, near=self.near, far=self.far)
        scene = scene if self.ego_mask else scene.keep_ego_vehicle()
        scene = scene if self.uses_masks else scene.leave_out_masks()
        scene = scene.invert_masks() if self.has_inverted_masks else scene
        scene = scene.ignore_moving() if self.ignore_moving else scene
        return scene.ignore_regions(self.ignore)

    def load(self, frames: tuple[int, ...]) -> list[View]:
        """Load the photographs of `frames`."""
        return self.open().views(frames, self.resolution)


def read_cases(path: Path) -> list[Case]:
    """Read the cases of a file; raises as `read_case_file`."""
    content = read_case_file(path)
    check_regions(content, path)
    return [
        Case(
            scene=locate_named(path, row.scene),
            context=row.context,
            target=row.target,
            neighbours=row.neighbours,
            resolution=content.resolution,
            near=row.near,
            far=row.far,
            ignore=row.ignore,
            apart_by=path if row.is_apart else None,
        )
        for row in content.rows
    ]


def check_regions(content: CaseFile, path: Path) -> None:
    """Refuse regions to ignore whose mask cannot be read, or that leave nothing to score."""
    for number, row in enumerate(content.rows, start=1):
        if row.ignore is None:
            continue
        share = row.ignore.draw(REGION_SIDE, REGION_SIDE).mean()
        if share in (0, 1):
            what = "everything" if share else "nothing"
            raise InputError(
                f"{quote_value(path)}: case {number} has ignore with {what} in it; black pixels of "
                "a mask, and what polygons enclose, do not count."
            )


@dataclass(frozen=True)
class SkippedScene:
    """A scene that was left out, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class ScenePlace:
    """A file or folder of scenes that a protocol chooses frames of."""

    path: Path
    apart_by: Path | None = None
    """File of scenes that keeps it apart, or None."""


def list_places(path: Path) -> list[ScenePlace]:
    """List the scenes that a file of scenes names; else the path itself."""
    if not is_scene_file(path):
        return [ScenePlace(path)]
    return [
        ScenePlace(locate_named(path, row.scene), path if row.is_apart else None)
        for row in read_scene_file(path)
    ]


def list_scenes(path: Path) -> list[Path]:
    """List the scenes in a folder of scenes, without results of ours; else the path itself."""
    inside = [] if find_format(path) or not os.path.isdir(path) else list_entries(path)
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
