"""The file of cases, `cases.json`: its keys, and one sentence for each mistake in it.

{"resolution": [h, w], "cases": [{"scene", "context", "target", "near", "far", "neighbours"}, ...]}.
Scenes are folders, and frames are numbers of photographs from 0; near and far are z-depths in scene
units. "ignore" of a case is a list of polygons or the path of a mask: parts of its photographs that
do not count. Paths are relative to the file, and may name variables of the environment.

With "apart", true or a list of names of scenes, all cases or those of these scenes are kept apart
(`apart.py`). The name of a scene is the last part of its path.

A file of scenes, {"scenes": [folder, ...], "apart": [name, ...]}, names those of a data set for the
protocols, which choose frames themselves.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any

from gscompleter.data.ignored_regions import IgnoredRegions
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_json
from gscompleter.system.tensor_checks import is_number
from gscompleter.types import MAX_IMAGE_SIDE

FILE_KEYS = ("resolution", "cases", "about", "apart")
"""Keys of the file; `about` is a remark for people."""
SCENE_KEYS = ("scenes", "about", "apart")
"""Keys of a file of scenes."""
CASE_KEYS = ("scene", "context", "target", "neighbours", "near", "far", "ignore", "about")
"""Keys of a case."""
MAX_FRAME = 10**9
"""Largest number of a frame; a time stamp is no frame."""
MIN_CONTEXT = 2
"""Fewest context frames: a single photograph has no stereo."""
MIN_CORNERS = 3
"""Fewest corners of a polygon."""


@dataclass(frozen=True)
class CaseRow:
    """A case as its file has it."""

    scene: str
    """Path of the scene as the file has it; see `locate_named`."""
    context: tuple[int, ...]
    """At least `MIN_CONTEXT` different frames."""
    target: int
    """Frame that is completed, and none of the context."""
    neighbours: tuple[int, ...] = ()
    """Further frames, beside the target, for scoring only."""
    near: float | None = None
    """Smallest z-depth in scene units; None for that of the data, as of `far`."""
    far: float | None = None
    ignore: IgnoredRegions | None = None
    """What does not count in its photographs; None for nothing."""
    is_apart: bool = False
    """True if the file keeps the case apart."""


@dataclass(frozen=True)
class SceneRow:
    """A scene as a file of scenes has it."""

    scene: str
    """Path of the scene as the file has it; see `locate_named`."""
    is_apart: bool = False
    """True if the file keeps the scene apart."""


@dataclass(frozen=True)
class CaseFile:
    """The content of a file of cases."""

    resolution: tuple[int, int]
    """Height and width, in pixels."""
    rows: tuple[CaseRow, ...]
    """At least one case."""


def read_case_file(path: Path) -> CaseFile:
    """Read a file of cases; raise InputError with one sentence about its first mistake."""
    content = read_json(path, "name a file of cases")
    name = f"{quote_value(path)} is no file of cases"
    if not isinstance(content, dict):
        raise InputError(f"{name}: it has to be an object with resolution and cases.")
    if "scenes" in content:
        raise InputError(
            f"{name}: it names scenes, of which a protocol chooses the frames; give one.",
            "protocol",
        )
    refuse_unknown(content, FILE_KEYS, f"{name}: it")

    size = content.get("resolution")
    sides = size if isinstance(size, list) else []
    if len(sides) != 2 or not all(type(s) is int and 1 <= s <= MAX_IMAGE_SIDE for s in sides):
        raise InputError(
            f"{name}: resolution has to be height and width in pixels, as in [256, 256], and is "
            f"{quote_json(size)}."
        )
    rows = content.get("cases")
    if not isinstance(rows, list) or not rows:
        raise InputError(f"{name}: cases has to be a list of cases, and is {quote_json(rows)}.")
    parsed = [parse_case_row(row, f"{name}: case {n}", path) for n, row in enumerate(rows, start=1)]

    # A run refuses two cases of one name as well, but can no longer say which rows they are. Two
    # spellings of a path are one scene.
    numbers: dict[tuple[str, tuple[int, ...], int], int] = {}
    for number, row in enumerate(parsed, start=1):
        place = os.path.abspath(locate_named(path, row.scene))
        first = numbers.setdefault((place, row.context, row.target), number)
        if first < number:
            raise InputError(
                f"{name}: case {number} has the scene, context and target of case {first}; leave "
                "one of them out."
            )
    is_apart = parse_apart(content.get("apart"), [row.scene for row in parsed], name)
    height, width = sides
    return CaseFile(
        (height, width),
        tuple(replace(row, is_apart=apart) for row, apart in zip(parsed, is_apart, strict=True)),
    )


def is_scene_file(path: Path) -> bool:
    """Check whether a path is a file of scenes; cameras of a scene can be a .json, too."""
    if path.suffix != ".json" or not os.path.isfile(path):
        return False
    with suppress(InputError):
        content = read_json(path, "name a file of scenes")
        return isinstance(content, dict) and "scenes" in content
    return False


def read_scene_file(path: Path) -> tuple[SceneRow, ...]:
    """Read a file of scenes; raise InputError with one sentence about its first mistake."""
    content = read_json(path, "name a file of scenes")
    name = f"{quote_value(path)} is no file of scenes"
    if not isinstance(content, dict):
        raise InputError(f"{name}: it has to be an object with scenes.")
    refuse_unknown(content, SCENE_KEYS, f"{name}: it")
    scenes = content.get("scenes")
    if not isinstance(scenes, list) or not scenes:
        raise InputError(
            f"{name}: scenes has to be a list of folders, and is {quote_json(scenes)}."
        )
    places: set[str] = set()
    for number, scene in enumerate(scenes, start=1):
        is_path = isinstance(scene, str) and scene != ""
        place = os.path.abspath(locate_named(path, scene)) if is_path else ""
        if not is_path or place in places:
            raise InputError(
                f"{name}: scene {number} is {quote_json(scene)}; name different folders, relative "
                "to the file."
            )
        places.add(place)
    is_apart = parse_apart(content.get("apart"), scenes, name)
    return tuple(SceneRow(scene, apart) for scene, apart in zip(scenes, is_apart, strict=True))


def locate_named(file: Path, path: str) -> Path:
    """Locate what a file names by a path: relative to the file, with variables replaced."""
    return file.parent / os.path.expandvars(path)


def parse_apart(apart: Any, scenes: Sequence[str], name: str) -> list[bool]:
    """Parse which of `scenes` are kept apart, in their order: all, or those that a list names.

    `name` begins the sentences about mistakes.
    """
    known = [PurePath(scene).name for scene in scenes]
    if isinstance(apart, bool) or apart is None:
        return [bool(apart)] * len(known)
    if not isinstance(apart, list) or not all(isinstance(scene, str) for scene in apart):
        raise InputError(
            f"{name}: apart has to be true or a list of names of scenes, and is "
            f"{quote_json(apart)}."
        )
    # A misspelt name would leave its scene in every measurement.
    unknown = [scene for scene in apart if scene not in known]
    if unknown:
        raise InputError(
            f"{name}: apart names {quote_json(unknown[0])}, which is none of its scenes "
            f"({', '.join(dict.fromkeys(known))}); correct or remove it."
        )
    return [scene in apart for scene in known]


def parse_case_row(row: Any, name: str, file: Path) -> CaseRow:
    """Parse a case of a file; sentences about mistakes begin with the `name` of the case."""
    if not isinstance(row, dict):
        raise InputError(f"{name} has to be an object with scene, context and target.")
    refuse_unknown(row, CASE_KEYS, name)
    scene = row.get("scene")
    if not isinstance(scene, str) or not scene:
        raise InputError(
            f"{name} needs scene, a folder relative to the file; it has {quote_json(scene)}."
        )
    context = parse_frames(row.get("context"), "context", name)
    if len(context) < MIN_CONTEXT:
        raise InputError(
            f"{name} needs context, a list of at least two frames; it has {quote_json(context)}."
        )
    target = row.get("target")
    if type(target) is not int or not is_frame(target):
        raise InputError(
            f"{name} needs target, the number of a frame counted from 0; it has "
            f"{quote_json(target)}."
        )
    if target in context:
        raise InputError(
            f"{name} has its target {target} in the context, which would show the answer; name "
            "another frame."
        )
    neighbours = parse_frames(row.get("neighbours", []), "neighbours", name)
    used = sorted({*neighbours} & {target, *context})
    if used:
        raise InputError(
            f"{name} has frame {used[0]} among its neighbours, which is its target or context; "
            "name frames beside them."
        )
    near = parse_plane(row.get("near"), "near", name)
    far = parse_plane(row.get("far"), "far", name)
    if near is not None and far is not None and near >= far:
        raise InputError(
            f"{name} has near {near:g}, which is not before far {far:g}; correct them."
        )
    ignore = parse_ignored(row.get("ignore"), name, file)
    return CaseRow(scene, context, target, neighbours, near, far, ignore)


def parse_ignored(value: Any, name: str, file: Path) -> IgnoredRegions | None:
    """Parse what does not count: polygons, or the path of a mask; None if it is not given."""
    if value is None:
        return None
    if isinstance(value, str) and value:
        mask = locate_named(file, value)
        if not os.path.isfile(mask):
            raise InputError(
                f"{name} has ignore {quote_json(value)}, and there is no such file; name a mask "
                "relative to the file of cases."
            )
        return IgnoredRegions(mask=mask)
    if not isinstance(value, list) or not value or not all(map(is_polygon, value)):
        raise InputError(
            f"{name} has ignore {quote_json(value)}, and a list of polygons is needed, each of "
            "three corners [x, y] or more in shares of width and height from 0 to 1, or the path "
            "of a mask."
        )
    return IgnoredRegions(tuple(tuple((float(x), float(y)) for x, y in one) for one in value))


def is_polygon(value: Any) -> bool:
    """Check whether a value is a list of corners, as shares of an image."""
    return isinstance(value, list) and len(value) >= MIN_CORNERS and all(map(is_corner, value))


def is_corner(value: Any) -> bool:
    """Check whether a value is a point [x, y], as shares of an image."""
    return (
        isinstance(value, list)
        and len(value) == 2
        and all(is_number(v) and 0 <= v <= 1 for v in value)
    )


def refuse_unknown(content: Mapping[str, Any], known: Sequence[str], name: str) -> None:
    """Refuse keys that nothing reads, such as misspelt ones; `name` begins the sentence."""
    unknown = [key for key in content if key not in known]
    if unknown:
        raise InputError(
            f"{name} has the key '{quote_value(unknown[0])}', which is none of {', '.join(known)}; "
            "correct or remove it."
        )


def parse_frames(frames: Any, key: str, name: str) -> tuple[int, ...]:
    """Parse a list of different frames."""
    if not isinstance(frames, list) or not all(is_frame(frame) for frame in frames):
        raise InputError(
            f"{name} has {key} {quote_json(frames)}, and a list of numbers of frames counted from "
            "0 is needed."
        )
    twice = [frame for number, frame in enumerate(frames) if frame in frames[:number]]
    if twice:
        raise InputError(f"{name} has frame {twice[0]} twice in {key}; name different frames.")
    return tuple(frames)


def is_frame(value: Any) -> bool:
    """Check whether a value is the number of a frame."""
    return type(value) is int and 0 <= value <= MAX_FRAME


def parse_plane(value: Any, key: str, name: str) -> float | None:
    """Parse a z-depth in scene units; None if it is not given."""
    if value is None:
        return None
    if not is_number(value) or not 0 < value < float("inf"):
        raise InputError(
            f"{name} has {key} {quote_json(value)}, and a positive z-depth in scene units is "
            "needed."
        )
    return float(value)


def quote_json(value: Any) -> str:
    """Write a value of the file for a sentence, as JSON; `nothing` for a key that is not there."""
    return "nothing" if value is None else quote_value(json.dumps(value))
