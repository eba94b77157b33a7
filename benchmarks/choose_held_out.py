"""Write held_out.json: cases on which no setting was chosen, by a rule that leaves no choice.

    GSCOMPLETER_DATA=DIR python benchmarks/choose_held_out.py

Frames: a case is two context frames n, n + g and the target n + 2 g, or the same backwards, as the
development cases of DIR/data/cases.json. g is the median gap of the scene's development cases, so
that held-out ones are as hard. No frame of a case, and no photograph beside its target, is in a
development case, and its target is in no measurement of the documentation (`MEASURED`). Of what is
left, the SHA-256 of "SCENE CONTEXT TARGET" decides: the smallest come first, up to three for each
scene, none with a frame of another. The file keeps all of them apart: `evaluate` uses them with
--apart alone, and notes the use in apart_uses.md.
"""

from __future__ import annotations

import hashlib
import json
import os
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from choose_apart import get_place, write_list

DATA = Path(os.environ["GSCOMPLETER_DATA"]) / "data"
OUT = Path(__file__).with_name("held_out.json")
PER_SCENE = 3
MEASURED = {
    "fountain_p11": {4},
    "fox": {4, 8, 16, 29, 34, 37, 39},
    "hololens_room": {4, 6, 8, 10, 12, 14, 16, 18, 24, 30, 39},
    "kitti_city": {4, 8, 16, 39},
    "re10k_000c3ab1": {4, 8, 16, 39},
    "re10k_0d4de33c": {4, 8, 10, 12, 14, 16, 18, 20, 22},
    "redkitchen": {4, 6, 8, 10, 12, 14, 16, 18, 20, 24, 25, 26, 28, 30, 32, 36, 39},
}
"""Targets beside the development cases: spans and stress test (docs/reproduce.md), sequences and
splats (docs/results.md), given depth (decision 046), and eight targets (performance.json)."""


def main() -> None:
    """Choose the cases, and write them with the rule."""
    rows = json.loads((DATA / "cases.json").read_text())["cases"]
    scenes = sorted({row["scene"] for row in rows})
    cases = [case for scene in scenes for case in choose_cases(scene, rows)]
    head = {
        "about": "Held-out cases: chosen once by benchmarks/choose_held_out.py, for reports only.",
        "apart": True,
        "resolution": [256, 256],
    }
    write_list(OUT, head, "cases", cases)
    print(f"{len(cases)} cases of {len({case['scene'] for case in cases})} scenes")


def choose_cases(scene: str, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Choose the cases of a scene; none if its frames are used up."""
    own = [row for row in rows if row["scene"] == scene]
    seen = {frame for row in own for frame in (*row["context"], row["target"], *row["neighbours"])}
    gap = round(statistics.median(abs(row["context"][1] - row["context"][0]) for row in own))
    content = json.loads((DATA / scene / "transforms.json").read_text())
    count = len(content["frames"])
    taken: set[int] = set()
    cases = []

    def rank(triple: tuple[tuple[int, int], int]) -> str:
        (first, second), target = triple
        return compute_digest(f"{scene} {first}+{second} {target}")

    for context, target in sorted(list_triples(count, gap), key=rank):
        beside = [f for f in (target - 1, target + 1) if 0 <= f < count and f not in context]
        frames = {*context, target, *beside}
        is_measured = target in MEASURED.get(scene, ())
        if len(cases) < PER_SCENE and not is_measured and not frames & (seen | taken):
            taken |= frames
            planes = {"near": own[0]["near"], "far": own[0]["far"]}
            case = {
                "scene": get_place(scene),
                "context": [*context],
                "target": target,
                "neighbours": beside,
            }
            cases.append({**case, **planes})
    return cases


def list_triples(count: int, gap: int) -> Iterator[tuple[tuple[int, int], int]]:
    """List context and target of all extrapolations by `gap`, forwards and backwards."""
    for n in range(count - 2 * gap):
        yield (n, n + gap), n + 2 * gap
        yield (n + 2 * gap, n + gap), n


def compute_digest(text: str) -> str:
    """Compute the SHA-256 that decides the order."""
    return hashlib.sha256(text.encode()).hexdigest()


if __name__ == "__main__":
    main()
