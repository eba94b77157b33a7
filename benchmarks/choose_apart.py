"""Draw the scenes that are kept apart, and write development.json and scenes.json, which say so.

    GSCOMPLETER_DATA=DIR python benchmarks/choose_apart.py

Of the scenes with enough photographs for every protocol of our tables (`MIN_FRAMES`) that were not
drawn before, the two with the smallest SHA-256 of "NAME NUMBER" are kept apart, where NUMBER is
that of the decision that draws them (docs/decisions). No later decision uses their photographs.

development.json holds the cases of DIR/data/cases.json, on which settings are chosen, scenes.json
the scenes alone. `evaluate` and the scripts here leave out what they keep apart.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

DATA = Path(os.environ["GSCOMPLETER_DATA"]) / "data"
OUT = Path(__file__).parent
DECISION = 105
NUM_APART = 2
MIN_FRAMES = 17
"""Photographs that n-8 needs, the widest protocol of our tables."""
DRAWN_BEFORE = ("fountain_p11", "kitti_city")
"""Drawn in November 2026, and used by decisions 051 to 059 nevertheless."""


def main() -> None:
    """Draw the scenes and write both files."""
    content = json.loads((DATA / "cases.json").read_text())
    rows = content["cases"]
    scenes = sorted({row["scene"] for row in rows})
    apart = draw_scenes(scenes)
    cases = [{**row, "scene": get_place(row["scene"])} for row in rows]
    about = (
        "Development cases, on which settings are chosen; written by benchmarks/choose_apart.py."
    )
    head = {"about": about, "apart": apart, "resolution": content["resolution"]}
    write_list(OUT / "development.json", head, "cases", cases)
    about = "Scenes for the protocols; written by benchmarks/choose_apart.py."
    places = [get_place(scene) for scene in scenes]
    write_list(OUT / "scenes.json", {"about": about, "apart": apart}, "scenes", places)
    print(f"kept apart: {', '.join(apart)}")


def draw_scenes(scenes: Sequence[str]) -> list[str]:
    """Draw the scenes to keep apart."""

    def rank(scene: str) -> str:
        return hashlib.sha256(f"{scene} {DECISION}".encode()).hexdigest()

    suitable = [
        scene for scene in scenes if scene not in DRAWN_BEFORE and count_frames(scene) >= MIN_FRAMES
    ]
    return sorted(sorted(suitable, key=rank)[:NUM_APART])


def count_frames(scene: str) -> int:
    """Count the photographs of a scene."""
    return len(json.loads((DATA / scene / "transforms.json").read_text())["frames"])


def get_place(scene: str) -> str:
    """Return the folder of a scene as files of cases name it."""
    return f"$GSCOMPLETER_DATA/data/{scene}"


def write_list(path: Path, head: Mapping[str, Any], key: str, items: Sequence[Any]) -> None:
    """Write a file of cases or of scenes, one a line."""
    lines = [f" {json.dumps(name)}: {json.dumps(value)}," for name, value in head.items()]
    listed = ",\n".join(f"  {json.dumps(item)}" for item in items)
    path.write_text("\n".join(["{", *lines, f' "{key}": [', listed, " ]", "}"]) + "\n")


if __name__ == "__main__":
    main()
