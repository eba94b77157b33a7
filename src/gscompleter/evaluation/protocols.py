"""Evaluation protocols: which frames of a clip are context and which are targets.

There are published indices (`{scene: {"context", "target"} or null}`), the extrapolation `n-k`, a
stress test, and `sequence-k`, which completes its targets one after the other into one scene.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gscompleter.completer import MAX_TARGET_ID
from gscompleter.data.photographs import PosedPhotographs
from gscompleter.errors import InputError, quote_value
from gscompleter.io.files import replace_file
from gscompleter.io.json_file import read_json

VERSION = 1
"""Version of the files that `write_evaluation_index` writes."""


@dataclass(frozen=True)
class Split:
    """Context and target frames of one clip."""

    context: tuple[int, ...]
    targets: tuple[int, ...]
    is_sequence: bool = False
    """True if all targets are completed into one scene, one after the other."""


@dataclass(frozen=True)
class Extrapolation:
    """Frames n, n + k → n + 2k and n + 2k, n + k → n, for n = 0, stride, 2 stride, …."""

    k: int
    stride: int | None = None
    """Step of n; None means 2k + 1, so that the cases share no frame."""

    def __post_init__(self) -> None:
        if self.k < 1 or (self.stride is not None and self.stride < 1):
            raise InputError(
                f"An extrapolation over {self.k} frames with a stride of {self.stride} is "
                "impossible; both have to be at least 1."
            )

    @property
    def name(self) -> str:
        """Name of the protocol."""
        return f"n-{self.k}" + ("" if self.stride is None else f"-stride-{self.stride}")

    def select_splits(self, clip: PosedPhotographs) -> tuple[Split, ...]:
        """Return the splits of a clip."""
        k, stride = self.k, self.stride or 2 * self.k + 1
        return tuple(
            split
            for n in range(0, len(clip) - 2 * k, stride)
            for split in (Split((n, n + k), (n + 2 * k,)), Split((n + 2 * k, n + k), (n,)))
        )


@dataclass(frozen=True)
class StressTest:
    """Frames 0, 30 → 99: most of the target is outside the context."""

    name: str = "stress"
    """Name of the protocol."""

    def select_splits(self, clip: PosedPhotographs) -> tuple[Split, ...]:
        """Return the split of a clip; none if it is too short."""
        split = Split((0, 30), (99,))
        return (split,) if len(clip) > max(split.targets) else ()


@dataclass(frozen=True)
class EvaluationIndex:
    """The splits of each scene, from a file."""

    name: str
    """Name of the protocol; the stem of a published file."""
    scenes: Mapping[str, tuple[Split, ...]]
    skipped: tuple[str, ...] = ()
    """Scenes without a split: null in a published file, clips that are too short in ours."""

    def select_splits(self, clip: PosedPhotographs) -> tuple[Split, ...]:
        """Return the splits of a clip; none if the index skips or lacks its scene."""
        return self.scenes.get(clip.name, ())


@dataclass(frozen=True)
class ViewByView:
    """Frames 0, k → 2k, 3k, 4k, …: targets completed one after the other into one scene."""

    k: int
    """Step between frames."""
    steps: int | None = None
    """Maximum number of targets; None takes all frames of the clip, up to `MAX_TARGET_ID`."""

    def __post_init__(self) -> None:
        if self.k < 1:
            raise InputError("A sequence of every 0th frame is impossible; give at least 1.")
        if self.steps is not None and not 1 <= self.steps <= MAX_TARGET_ID:
            raise InputError(
                f"A sequence of {self.steps} steps is impossible; give 1 to {MAX_TARGET_ID}, the "
                "number of targets that a .ply can tell apart."
            )

    @property
    def name(self) -> str:
        """Name of the protocol."""
        return f"sequence-{self.k}" + ("" if self.steps is None else f"-steps-{self.steps}")

    def select_splits(self, clip: PosedPhotographs) -> tuple[Split, ...]:
        """Return the split of a clip; none if it is too short."""
        targets = tuple(range(2 * self.k, len(clip), self.k))[: self.steps or MAX_TARGET_ID]
        return (Split((0, self.k), targets, is_sequence=True),) if targets else ()

    def explain_skip(self, clip: PosedPhotographs) -> str | None:
        """Explain why a clip has no split, or return None if it has one."""
        needed = 2 * self.k + 1
        if len(clip) >= needed:
            return None
        return f"it has {len(clip)} frames, and {self.name} needs {needed}"


EvaluationProtocol = Extrapolation | StressTest | EvaluationIndex | ViewByView
"""A deterministic rule that chooses frames."""

_PATTERNS: dict[str, type[Extrapolation | ViewByView]] = {
    "n-([0-9]{1,6})(?:-stride-([0-9]{1,6}))?": Extrapolation,
    "sequence-([0-9]{1,6})(?:-steps-([0-9]{1,6}))?": ViewByView,
}


def parse_protocol(text: str) -> EvaluationProtocol:
    """Parse a protocol: `n-10`, `n-10-stride-5`, `stress`, `sequence-4` or the path of an index."""
    for pattern, kind in _PATTERNS.items():
        if match := re.fullmatch(pattern, text):
            return kind(*(int(number) for number in match.groups() if number is not None))
    if text == "stress":
        return StressTest()
    if os.path.isfile(text):
        return read_evaluation_index(text)
    raise InputError(
        f"There is no protocol '{quote_value(text)}'; give n-K for a number of frames K (as n-10), "
        "stress, sequence-K (as sequence-4), or the path of an evaluation index."
    )


def build_index(protocol: EvaluationProtocol, clips: Iterable[PosedPhotographs]) -> EvaluationIndex:
    """Write down the splits of each clip; raise InputError for equal names or a sequence."""
    if isinstance(protocol, ViewByView):
        raise InputError(
            f"{protocol.name} has no index, because its targets depend on each other; give the "
            "protocol to `evaluate` instead."
        )
    scenes: dict[str, tuple[Split, ...]] = {}
    for clip in clips:
        if clip.name in scenes:
            raise InputError(f"Two clips are called {clip.name}; rename one of them.")
        scenes[clip.name] = protocol.select_splits(clip)
    chosen = {name: splits for name, splits in scenes.items() if splits}
    return EvaluationIndex(protocol.name, chosen, tuple(n for n in scenes if not scenes[n]))


def read_evaluation_index(path: Path | str) -> EvaluationIndex:
    """Read an evaluation index, published or of `write_evaluation_index`."""
    path = Path(path)
    content = read_json(path, "download it again")
    if not isinstance(content, dict):
        raise InputError(
            f"{path} is no evaluation index: it has to map the name of each scene to its context "
            "and target frames, or to null."
        )
    if "version" not in content:
        return _parse_index(path.stem, content, path)
    if content["version"] != VERSION:
        raise InputError(
            f"{path} is of version {quote_value(content['version'])} and version {VERSION} can be "
            "read; update gscompleter, or write the index again."
        )
    name, scenes = content.get("protocol"), content.get("scenes")
    if not isinstance(name, str) or not isinstance(scenes, dict):
        raise InputError(f"{path} is damaged: `protocol` and `scenes` are needed; write it again.")
    return _parse_index(name, scenes, path)


def write_evaluation_index(path: Path | str, index: EvaluationIndex) -> None:
    """Write an index atomically, in the format that `read_evaluation_index` reads."""
    scenes: dict[str, list[dict[str, list[int]]] | None] = {
        name: [{"context": list(s.context), "target": list(s.targets)} for s in splits]
        for name, splits in index.scenes.items()
    }
    scenes |= dict.fromkeys(index.skipped)
    rows = ",\n".join(f"  {json.dumps(name)}: {json.dumps(s)}" for name, s in scenes.items())
    head = f' "version": {VERSION},\n "protocol": {json.dumps(index.name)},\n "scenes": '
    with replace_file(path) as file:
        file.write(f"{{\n{head}{{\n{rows}\n }}\n}}\n".encode())


def _parse_index(name: str, content: Mapping[str, Any], path: Path) -> EvaluationIndex:
    scenes = {
        scene: _parse_splits(entry, scene, path)
        for scene, entry in content.items()
        if entry is not None
    }
    return EvaluationIndex(name, scenes, tuple(s for s, entry in content.items() if entry is None))


def _parse_splits(entry: Any, scene: str, path: Path) -> tuple[Split, ...]:
    """Parse the entry of a scene: one split in a published file, a list of splits in ours."""
    rows = entry if isinstance(entry, list) else [entry]
    if not rows or not all(isinstance(row, dict) for row in rows):
        raise InputError(
            f"The entry of the scene {scene} in {path} is {quote_value(entry)}; context and "
            "target, or null, are needed."
        )
    for row in rows:
        for key in ("context", "target"):
            frames = row.get(key)
            whole = isinstance(frames, list) and all(type(f) is int and f >= 0 for f in frames)
            if not whole or not frames:
                raise InputError(
                    f"The `{key}` of the scene {scene} in {path} is {quote_value(frames)}; a list "
                    "of frame numbers, at least one, is needed."
                )
    return tuple(Split(tuple(row["context"]), tuple(row["target"])) for row in rows)
