"""Write many/ORDER-N.json: the development cases with N further photographs in the context.

    GSCOMPLETER_DATA=DIR python benchmarks/choose_many.py

Users bring more than a pair. Further frames are never the target nor the photographs beside it by
which a case is scored. `nearest` takes those whose cameras are nearest to the target, `spread`
takes them at even steps of what is left. A scene with fewer frames gives all that it has.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from choose_apart import draw_scenes, get_place, write_list

DATA = Path(os.environ["GSCOMPLETER_DATA"]) / "data"
OUT = Path(__file__).with_name("many")
COUNTS = (1, 3, 6, 14)


def main() -> None:
    """Write a file of cases for each order and number of further photographs."""
    content = json.loads((DATA / "cases.json").read_text())
    apart = draw_scenes(sorted({row["scene"] for row in content["cases"]}))
    OUT.mkdir(exist_ok=True)
    for order in ("nearest", "spread"):
        for count in COUNTS:
            head = {
                "about": f"The development cases with up to {count} further photographs ({order}), "
                "from benchmarks/choose_many.py.",
                "apart": apart,
                "resolution": content["resolution"],
            }
            cases = [add_photographs(row, order, count) for row in content["cases"]]
            write_list(OUT / f"{order}-{count}.json", head, "cases", cases)


def add_photographs(row: dict[str, Any], order: str, count: int) -> dict[str, Any]:
    """Add further photographs to the context of a case."""
    frames = json.loads((DATA / row["scene"] / "transforms.json").read_text())["frames"]
    centres = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    used = {*row["context"], row["target"], *row["neighbours"]}
    left = [number for number in range(len(frames)) if number not in used]
    count = min(count, len(left))
    if order == "nearest":
        distances = np.linalg.norm(centres - centres[row["target"]], axis=1)
        further = sorted(left, key=lambda number: distances[number])[:count]
    else:
        further = [left[(2 * step + 1) * len(left) // (2 * count)] for step in range(count)]
    return {**row, "scene": get_place(row["scene"]), "context": [*row["context"], *sorted(further)]}


if __name__ == "__main__":
    main()
