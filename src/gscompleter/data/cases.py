"""Completion cases on posed photographs, written down in a file.

A case names two or more context frames and a target frame whose photograph no stage sees, and
frames beside the target ("neighbours"), which a flat billboard in front of the target camera
cannot satisfy. A file of cases is JSON: `{"resolution": [h, w], "cases": [{"scene", "context",
"target", "near", "far", "neighbours"}, ...]}` with scene folders beside the file.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gscompleter.data.formats import open_photographs
from gscompleter.data.framing import Resolution
from gscompleter.data.photographs import Photographs, without_masked
from gscompleter.errors import InputError, quoted
from gscompleter.io.json_file import read_json
from gscompleter.types import View

NAME = "cases.json"


@dataclass(frozen=True)
class Case:
    """One completion task."""

    scene: Path
    """Folder of the scene."""
    context: tuple[int, ...]
    target: int
    neighbours: tuple[int, ...]
    """Frames beside the target, for scoring only."""
    resolution: Resolution
    """Height and width, or what else `PosedPhotographs.views` takes."""
    near: float | None = None
    far: float | None = None
    ignore_masked: bool = False
    """Whether what is masked in the photographs is ignored."""
    ego_mask: bool = True
    """True if the vehicle that carries the camera is ignored."""

    @property
    def name(self) -> str:
        return f"{self.scene.name} {'+'.join(map(str, self.context))}>{self.target}"

    def load(self, frames: tuple[int, ...]) -> list[View]:
        """Photographs of `frames`."""
        scene = open_photographs(self.scene, near=self.near, far=self.far)
        scene = scene if self.ego_mask else scene.with_ego_vehicle()
        views = scene.views(frames, self.resolution)
        return without_masked(views, scene, self.resolution) if self.ignore_masked else views


def holds_cases(path: Path) -> bool:
    """Whether `path` is a folder with a `cases.json`, or a JSON file with cases."""
    if os.path.isdir(path):
        return os.path.isfile(path / NAME)
    if path.suffix != ".json" or not os.path.isfile(path):
        return False
    content = read_json(path, "name a file of cases or cameras")
    return isinstance(content, dict) and "cases" in content


def open_cases(path: Path) -> Iterator[Photographs]:
    """The scenes of the cases that `path` is or holds, each once and in their order.

    The near and far planes of a scene enclose those of all its cases, where all have them.

    Raises:
        InputError: as `read_cases`, and while iterating, where a scene cannot be opened.
    """
    cases = read_cases(path / NAME if os.path.isdir(path) else path)
    for scene in dict.fromkeys(case.scene for case in cases):
        ours = [case for case in cases if case.scene == scene]
        near = [case.near for case in ours if case.near is not None]
        far = [case.far for case in ours if case.far is not None]
        yield open_photographs(
            scene,
            near=min(near) if len(near) == len(ours) else None,
            far=max(far) if len(far) == len(ours) else None,
        )


def read_cases(path: Path) -> list[Case]:
    """The cases of a file.

    Raises:
        InputError: where the file is missing or holds no cases.
    """
    content = read_json(path, "name a file of cases")
    try:
        height, width = content["resolution"]
        return [_case(row, (_whole(height), _whole(width)), path) for row in content["cases"]]
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(
            f"{path} is no file of cases ({type(error).__name__}: {quoted(str(error))}); it needs "
            "resolution and cases, each with scene, context and target."
        ) from error


def _case(row: Any, resolution: tuple[int, int], path: Path) -> Case:
    return Case(
        path.parent / row["scene"],
        tuple(map(_whole, row["context"])),
        _whole(row["target"]),
        tuple(map(_whole, row.get("neighbours", ()))),
        resolution,
        None if row.get("near") is None else float(row["near"]),
        None if row.get("far") is None else float(row["far"]),
    )


def _whole(value: Any) -> int:
    if type(value) is not int:
        raise TypeError(f"{quoted(value)} is no whole number")
    return value
