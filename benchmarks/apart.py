"""Cases and scenes for the scripts here, without those that are kept apart unless asked for.

As in `gscompleter evaluate`, `--apart` uses them, and a row of apart_uses.md says so.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

from gscompleter.evaluation.apart import (
    Apartable,
    describe_left_out,
    leave_out_apart,
    record_uses,
)
from gscompleter.evaluation.cases import Case, ScenePlace, list_places, read_cases

SCENES = Path(__file__).with_name("scenes.json")
"""Scenes of the protocols, with those that are kept apart."""
HELP = "use also what is kept apart, and note that in apart_uses.md"


def read_used_cases(path: Path, uses_apart: bool, name: str = "") -> list[Case]:
    """Read the cases of a file that may be used and whose names contain `name`."""
    left_out: list[Apartable] = []
    listed = [case for case in read_cases(path) if name in case.name]
    cases = list(leave_out_apart(listed, uses_apart, left_out))
    print(*describe_left_out(left_out, len(cases)), file=sys.stderr)
    record_uses(cases, name_script())
    return cases


def select_scenes(names: Iterable[str], uses_apart: bool) -> set[str]:
    """Select the names of our scenes that may be used; other scenes are nobody's to keep apart."""
    known = {place.path.name: place for place in list_places(SCENES)}
    places = [known.get(name, ScenePlace(Path(name))) for name in names]
    left_out: list[Apartable] = []
    used = list(leave_out_apart(places, uses_apart, left_out))
    print(*describe_left_out(left_out, len(used), "scenes"), file=sys.stderr)
    record_uses(used, name_script())
    return {place.path.name for place in used}


def name_script() -> str:
    """Name the running script with its arguments, without the folders of files."""
    return " ".join(Path(word).name for word in sys.argv)
