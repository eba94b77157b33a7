"""Which frames of a clip are given and which are to be synthesized.

A published evaluation index (`{scene: {"context", "target"} or null}`), the extrapolation `n-k`
(frames n and n + k show what frame n + 2k is completed from, and the same backwards), a stress test
far outside of what the context sees, and `sequence-k`, whose targets depend on each other: they are
completed one after the other.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from gscompleter.completer import MAX_TARGETS
from gscompleter.data.photographs import PosedPhotographs
from gscompleter.errors import InputError, quoted
from gscompleter.io.files import replacing
from gscompleter.io.json_file import read_json

VERSION = 1
"""Of the files that `write_evaluation_index` writes."""


@dataclass(frozen=True)
class Split:
    """Frames of one clip."""

    context: tuple[int, ...]
    """What is given."""
    targets: tuple[int, ...]
    """What is to be synthesized."""
    in_sequence: bool = False
    """True where the scene is completed for one target after the other; else each stands by
    itself."""


@runtime_checkable
class EvaluationProtocol(Protocol):
    """A rule that chooses frames. It is deterministic."""

    @property
    def name(self) -> str:
        """What `parse_protocol` or a table calls it."""

    def splits(self, clip: PosedPhotographs) -> tuple[Split, ...]:
        """The splits of a clip; none where it is skipped."""


@dataclass(frozen=True)
class Extrapolation:
    """n, n + k → n + 2k and n + 2k, n + k → n, for n = 0, stride, 2 stride, …"""

    k: int
    stride: int | None = None
    """From one n to the next; 2k + 1 if left out, so that no two n share a frame."""

    def __post_init__(self) -> None:
        if self.k < 1 or (self.stride is not None and self.stride < 1):
            raise InputError(
                f"An extrapolation over {self.k} frames with a stride of {self.stride} is "
                "impossible; both have to be at least 1."
            )

    @property
    def name(self) -> str:
        return f"n-{self.k}" + ("" if self.stride is None else f"-stride-{self.stride}")

    def splits(self, clip: PosedPhotographs) -> tuple[Split, ...]:
        k, stride = self.k, self.stride or 2 * self.k + 1
        return tuple(
            split
            for n in range(0, len(clip) - 2 * k, stride)
            for split in (Split((n, n + k), (n + 2 * k,)), Split((n + 2 * k, n + k), (n,)))
        )


@dataclass(frozen=True)
class StressTest:
    """Frames 0 and 30 → 99: most of the target lies outside of what the context sees."""

    name: str = "stress"

    def splits(self, clip: PosedPhotographs) -> tuple[Split, ...]:
        split = Split((0, 30), (99,))
        return (split,) if len(clip) > max(split.targets) else ()


@dataclass(frozen=True)
class EvaluationIndex:
    """The splits of each scene, written down."""

    name: str
    """Of the protocol; for a published file, its stem."""
    scenes: Mapping[str, tuple[Split, ...]]
    skipped: tuple[str, ...] = ()
    """Scenes with no split: null in a published file, clips that are too short in ours."""

    def splits(self, clip: PosedPhotographs) -> tuple[Split, ...]:
        """The splits of a clip; none where the index skips or lacks its scene."""
        return self.scenes.get(clip.name, ())


@dataclass(frozen=True)
class ViewByView:
    """0, k → 2k, 3k, 4k, …: one target after the other, all into one scene."""

    k: int
    """Frames from one photograph to the next."""
    steps: int | None = None
    """Most targets; if left out, all that the clip has, up to `MAX_TARGETS`."""

    def __post_init__(self) -> None:
        if self.k < 1:
            raise InputError("A sequence of every 0th frame is impossible; give at least 1.")
        if self.steps is not None and not 1 <= self.steps <= MAX_TARGETS:
            raise InputError(
                f"A sequence of {self.steps} steps is impossible; give 1 to {MAX_TARGETS}, which "
                "is how many a .ply can tell apart."
            )

    @property
    def name(self) -> str:
        return f"sequence-{self.k}" + ("" if self.steps is None else f"-steps-{self.steps}")

    def splits(self, clip: PosedPhotographs) -> tuple[Split, ...]:
        targets = tuple(range(2 * self.k, len(clip), self.k))[: self.steps or MAX_TARGETS]
        return (Split((0, self.k), targets, in_sequence=True),) if targets else ()

    def reason_to_skip(self, clip: PosedPhotographs) -> str | None:
        """Why a clip has no split; None where it has one."""
        needed = 2 * self.k + 1
        if len(clip) >= needed:
            return None
        return f"it has {len(clip)} frames, and {self.name} needs {needed}"


_PATTERNS: dict[str, type[Extrapolation | ViewByView]] = {
    "n-([0-9]{1,6})(?:-stride-([0-9]{1,6}))?": Extrapolation,
    "sequence-([0-9]{1,6})(?:-steps-([0-9]{1,6}))?": ViewByView,
}


def parse_protocol(text: str) -> EvaluationProtocol:
    """The protocol of that name: `n-10`, `n-10-stride-5`, `stress`, `sequence-4`,
    `sequence-4-steps-6`, or the path of an index.

    Raises:
        InputError: where it is none of these, or the index is damaged.
    """
    for pattern, kind in _PATTERNS.items():
        if match := re.fullmatch(pattern, text):
            return kind(*(int(number) for number in match.groups() if number is not None))
    if text == "stress":
        return StressTest()
    if os.path.isfile(text):
        return read_evaluation_index(text)
    raise InputError(
        f"There is no protocol '{quoted(text)}'; give n-K for a number of frames K (as n-10), "
        "stress, sequence-K (as sequence-4), or the path of an evaluation index."
    )


def index_of(protocol: EvaluationProtocol, clips: Iterable[PosedPhotographs]) -> EvaluationIndex:
    """What a protocol chooses in each of `clips`, written down.

    Raises:
        InputError: where two clips have the same name, or targets depend on each other.
    """
    if isinstance(protocol, ViewByView):
        raise InputError(
            f"{protocol.name} has no index, as its targets are not apart from each other; give it "
            "to `evaluate` itself."
        )
    scenes: dict[str, tuple[Split, ...]] = {}
    for clip in clips:
        if clip.name in scenes:
            raise InputError(f"Two clips are called {clip.name}; rename one of them.")
        scenes[clip.name] = protocol.splits(clip)
    chosen = {name: splits for name, splits in scenes.items() if splits}
    return EvaluationIndex(protocol.name, chosen, tuple(n for n in scenes if not scenes[n]))


def read_evaluation_index(path: Path | str) -> EvaluationIndex:
    """An evaluation index, as published or as `write_evaluation_index` writes it.

    Raises:
        InputError: where it is missing or damaged, or from a later version.
    """
    path = Path(path)
    content = read_json(path, "download it again")
    if not isinstance(content, dict):
        raise InputError(
            f"{path} is no evaluation index: it has to map the name of each scene to its context "
            "and target frames, or to null."
        )
    if "version" not in content:
        return _index(path.stem, content, path)
    if content["version"] != VERSION:
        raise InputError(
            f"{path} is of version {quoted(content['version'])} and version {VERSION} can be read; "
            "update gscompleter, or write the index again."
        )
    name, scenes = content.get("protocol"), content.get("scenes")
    if not isinstance(name, str) or not isinstance(scenes, dict):
        raise InputError(f"{path} is damaged: `protocol` and `scenes` are needed; write it again.")
    return _index(name, scenes, path)


def write_evaluation_index(path: Path | str, index: EvaluationIndex) -> None:
    """Write an index that `read_evaluation_index` reads back as it was, all at once.

    Raises:
        InputError: where the file cannot be written.
    """
    scenes: dict[str, list[dict[str, list[int]]] | None] = {
        name: [{"context": list(s.context), "target": list(s.targets)} for s in splits]
        for name, splits in index.scenes.items()
    }
    scenes |= dict.fromkeys(index.skipped)
    rows = [f"  {json.dumps(name)}: {json.dumps(splits)}" for name, splits in scenes.items()]
    text = (
        f'{{\n "version": {VERSION},\n "protocol": {json.dumps(index.name)},\n "scenes": {{\n'
        + ",\n".join(rows)
        + "\n }\n}\n"
    )
    with replacing(path) as file:
        file.write(text.encode())


def _index(name: str, content: Mapping[str, Any], path: Path) -> EvaluationIndex:
    scenes = {
        scene: _splits(entry, scene, path) for scene, entry in content.items() if entry is not None
    }
    return EvaluationIndex(name, scenes, tuple(s for s, entry in content.items() if entry is None))


def _splits(entry: Any, scene: str, path: Path) -> tuple[Split, ...]:
    """A scene has one split in a published file, and a list of them in ours."""
    rows = entry if isinstance(entry, list) else [entry]
    if not rows or not all(isinstance(row, dict) for row in rows):
        raise InputError(
            f"The entry of the scene {scene} in {path} is {quoted(entry)}; context and target, "
            "or null, are needed."
        )
    return tuple(
        Split(_frames(row, "context", scene, path), _frames(row, "target", scene, path))
        for row in rows
    )


def _frames(row: dict[str, Any], key: str, scene: str, path: Path) -> tuple[int, ...]:
    frames = row.get(key)
    whole = isinstance(frames, list) and all(type(f) is int and f >= 0 for f in frames)
    if not whole or not frames:
        raise InputError(
            f"The `{key}` of the scene {scene} in {path} is {quoted(frames)}; a list of frame "
            "numbers, at least one, is needed."
        )
    return tuple(frames)
