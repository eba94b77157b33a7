"""Completion cases on posed photographs, written down in a file.

A case names two or more context frames and a target frame whose photograph no stage sees, and
frames beside the target ("neighbours"), which a flat billboard in front of the target camera
cannot satisfy. A file of cases is JSON: `{"resolution": [h, w], "cases": [{"scene", "context",
"target", "near", "far", "neighbours"}, ...]}` with scene folders beside the file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gscompleter.data.scene import load_views
from gscompleter.errors import InputError
from gscompleter.io.json_file import read_json
from gscompleter.types import View


@dataclass(frozen=True)
class Case:
    """One completion task."""

    scene: Path
    """Folder of the scene."""
    context: tuple[int, ...]
    target: int
    neighbours: tuple[int, ...]
    """Frames beside the target, for scoring only."""
    resolution: tuple[int, int]
    """Height and width."""
    near: float | None = None
    far: float | None = None

    @property
    def name(self) -> str:
        return f"{self.scene.name} {'+'.join(map(str, self.context))}>{self.target}"

    def load(self, frames: tuple[int, ...]) -> list[View]:
        """Photographs of `frames`."""
        return load_views(self.scene, list(frames), self.resolution, near=self.near, far=self.far)


def read_cases(path: Path) -> list[Case]:
    """The cases of a file.

    Raises:
        InputError: where the file is missing or holds no cases.
    """
    content = read_json(path, "name a file of cases")
    try:
        height, width = content["resolution"]
        return [
            Case(
                path.parent / row["scene"],
                tuple(row["context"]),
                row["target"],
                tuple(row.get("neighbours", ())),
                (height, width),
                None if row.get("near") is None else float(row["near"]),
                None if row.get("far") is None else float(row["far"]),
            )
            for row in content["cases"]
        ]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} is no file of cases ({type(error).__name__}: {error}); it needs resolution "
            "and cases, each with scene, context and target."
        ) from error
