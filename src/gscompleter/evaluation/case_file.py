"""The file of cases, `cases.json`: its keys, and one sentence for each mistake in it.

{"resolution": [h, w], "cases": [{"scene", "context", "target", "near", "far", "neighbours"}, ...]}.
Scenes are folders relative to the file, and may name variables of the environment.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_json
from gscompleter.system.tensor_checks import is_number
from gscompleter.types import MAX_SIDE

FILE_KEYS = ("resolution", "cases", "about", "apart")
"""Keys of the file; `about` and `apart` are remarks for people and programs of their own."""
CASE_KEYS = ("scene", "context", "target", "neighbours", "near", "far", "about")
MAX_FRAME = 10**9
MIN_CONTEXT = 2


@dataclass(frozen=True)
class CaseRow:
    """A case as its file has it."""

    scene: str
    context: tuple[int, ...]
    target: int
    neighbours: tuple[int, ...] = ()
    near: float | None = None
    far: float | None = None


@dataclass(frozen=True)
class CaseFile:
    """The content of a file of cases."""

    resolution: tuple[int, int]
    """Height and width, in pixels."""
    rows: tuple[CaseRow, ...]


def read_case_file(path: Path) -> CaseFile:
    """Read a file of cases; raise InputError with one sentence about its first mistake."""
    content = read_json(path, "name a file of cases")
    name = f"{quote_value(path)} is no file of cases"
    if not isinstance(content, dict):
        raise InputError(f"{name}: it has to be an object with resolution and cases.")
    refuse_unknown(content, FILE_KEYS, name)

    size = content.get("resolution")
    sides = size if isinstance(size, list) else []
    if len(sides) != 2 or not all(type(s) is int and 1 <= s <= MAX_SIDE for s in sides):
        raise InputError(
            f"{name}: resolution has to be height and width in pixels, as in [256, 256], and is "
            f"{show(size)}."
        )
    rows = content.get("cases")
    if not isinstance(rows, list) or not rows:
        raise InputError(f"{name}: cases has to be a list of cases, and is {show(rows)}.")
    parsed = [parse_row(row, f"{name}: case {n}") for n, row in enumerate(rows, start=1)]

    # The scores of two cases of one name would overwrite each other.
    names = [(row.scene, row.context, row.target) for row in parsed]
    for number, row_name in enumerate(names, start=1):
        first = names.index(row_name) + 1
        if first < number:
            raise InputError(
                f"{name}: case {number} has the scene, context and target of case {first}; leave "
                "one of them out."
            )
    height, width = sides
    return CaseFile((height, width), tuple(parsed))


def parse_row(row: Any, name: str) -> CaseRow:
    """Parse a case; sentences begin with its name."""
    if not isinstance(row, dict):
        raise InputError(f"{name} has to be an object with scene, context and target.")
    refuse_unknown(row, CASE_KEYS, name)
    scene = row.get("scene")
    if not isinstance(scene, str) or not scene:
        raise InputError(
            f"{name} needs scene, a folder relative to the file; it has {show(scene)}."
        )
    context = parse_frames(row.get("context"), "context", name)
    if len(context) < MIN_CONTEXT:
        raise InputError(
            f"{name} needs context, a list of at least two frames; it has {show(context)}."
        )
    target = row.get("target")
    if type(target) is not int or not is_frame(target):
        raise InputError(
            f"{name} needs target, the number of a frame counted from 0; it has {show(target)}."
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
    return CaseRow(scene, context, target, neighbours, near, far)


def refuse_unknown(content: Mapping[str, Any], known: Sequence[str], name: str) -> None:
    """Refuse keys that nothing reads, such as misspelt ones."""
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
            f"{name} has {key} {show(frames)}, and a list of numbers of frames counted from 0 is "
            "needed."
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
    if isinstance(value, bool) or not is_number(value) or not 0 < value < float("inf"):
        raise InputError(
            f"{name} has {key} {show(value)}, and a positive z-depth in scene units is needed."
        )
    return float(value)


def show(value: Any) -> str:
    """Write a value of the file for a sentence; `nothing` for a key that is not there."""
    if value is None:
        return "nothing"
    try:
        return quote_value(json.dumps(value))
    except (TypeError, ValueError):
        return quote_value(value)
