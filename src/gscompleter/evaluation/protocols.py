"""Evaluation protocols, which choose context and target frames, and the tasks that they make.

There are published indices (`{scene: {"context", "target"} or null}`), the extrapolation `n-k`, a
stress test, and `sequence-k`, which completes its targets one after the other into one scene.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, MinLen
from pydantic import Field, TypeAdapter, ValidationError

from gscompleter.data.ignored_regions import IgnoredRegions
from gscompleter.data.photographs import Photographs, Resolution
from gscompleter.data.sfm.refining import PoseRefinement
from gscompleter.evaluation.cases import Case
from gscompleter.parts import MAX_TARGET_ID
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_json
from gscompleter.system.files.writing import replace_file
from gscompleter.types import View

INDICES = Path(__file__).parent / "indices"
"""Folder of the evaluation indices in the package; its README.md has the rule."""
INDEX_VERSION = 1
"""Version of the files that `write_evaluation_index` writes."""

Frames = Annotated[tuple[Annotated[int, Ge(0)], ...], MinLen(1)]


@dataclass(frozen=True)
class Split:
    """Context and target frames of one clip."""

    context: Frames
    targets: Annotated[Frames, Field(alias="target")]
    is_sequence: bool = False
    """True if all targets are completed into one scene, one after the other."""

    def sort_frames(self) -> Split:
        """Return the split with context and targets in ascending order."""
        return replace(
            self, context=tuple(sorted(self.context)), targets=tuple(sorted(self.targets))
        )


@dataclass(frozen=True)
class FrameRule:
    """A protocol that chooses frames by their number in a clip."""

    name: str
    split: Callable[[int], tuple[Split, ...]] = field(compare=False)
    """Returns the splits of a clip with this number of frames; determined by the name."""

    def select_splits(self, clip: Photographs) -> tuple[Split, ...]:
        """Return the splits of a clip; none if it is too short."""
        return self.split(len(clip))


@dataclass(frozen=True)
class EvaluationIndex:
    """The splits of each scene, from a file."""

    name: str
    """Name of the protocol; the stem of a published file."""
    scenes: Mapping[str, tuple[Split, ...]]
    """Splits by scene; empty if it is null in a published file, or too short in ours."""

    def select_splits(self, clip: Photographs) -> tuple[Split, ...]:
        """Return the splits of a clip; none if the index skips or lacks its scene."""
        return self.scenes.get(clip.name, ())


EvaluationProtocol = FrameRule | EvaluationIndex


@dataclass(frozen=True)
class IndexFile:
    """Content of an evaluation index; a published one has the scenes alone."""

    version: Literal[1]
    protocol: str
    scenes: dict[str, Split | Annotated[tuple[Split, ...], MinLen(1)] | None]


def parse_protocol(text: str) -> EvaluationProtocol:
    """Parse a protocol: `n-10`, `n-10-stride-5`, `stress`, `sequence-4`, or a path."""
    for pattern, split in FRAME_RULES.items():
        match = re.fullmatch(pattern, text)
        if match is not None:
            # Names of groups in the pattern are the parameters of the function; optional ones may
            # be absent.
            numbers = {key: int(n) for key, n in match.groupdict().items() if n}
            if 0 in numbers.values() or numbers.get("steps", 0) > MAX_TARGET_ID:
                raise InputError(
                    f"The protocol {text} is impossible; its numbers have to be at least 1, and "
                    f"steps at most {MAX_TARGET_ID}."
                )
            return FrameRule(text, partial(split, **numbers))

    if os.path.isfile(text):
        return read_evaluation_index(Path(text))
    if text in list_indices():
        return read_evaluation_index(INDICES / f"{text}.json")
    raise InputError(
        f"There is no protocol '{quote_value(text)}'; give n-K for a number of frames K (as n-10), "
        "stress or stress-K-TARGET, sequence-K (as sequence-4), the path of an evaluation index, "
        f"or the name of ours ({', '.join(list_indices())})."
    )


def list_indices() -> list[str]:
    """List the names of the evaluation indices in the package, as `dl3dv-n-10`."""
    return sorted(path.stem for path in INDICES.glob("*.json"))


def extrapolate(num_frames: int, k: int, stride: int | None = None) -> tuple[Split, ...]:
    """Choose n, n + k → n + 2k and n + 2k, n + k → n, for n = 0, stride, 2 stride, …."""
    # By default, the frames of one n and of the next do not overlap.
    splits = []
    for n in range(0, num_frames - 2 * k, stride or 2 * k + 1):
        splits.append(Split((n, n + k), (n + 2 * k,)))
        splits.append(Split((n + 2 * k, n + k), (n,)))
    return tuple(splits)


def split_stress_test(num_frames: int, k: int = 30, target: int = 99) -> tuple[Split, ...]:
    """Choose 0, k → target: most of the target is outside the context."""
    return (Split((0, k), (target,)),) if num_frames > target > k else ()


def split_sequence(num_frames: int, k: int, steps: int = MAX_TARGET_ID) -> tuple[Split, ...]:
    """Choose 0, k → 2k, 3k, 4k, …: targets completed one after the other into one scene."""
    targets = tuple(range(2 * k, num_frames, k))[:steps]
    return (Split((0, k), targets, is_sequence=True),) if targets else ()


FRAME_RULES: dict[str, Callable[..., tuple[Split, ...]]] = {
    "n-(?P<k>[0-9]{1,6})(?:-stride-(?P<stride>[0-9]{1,6}))?": extrapolate,
    "sequence-(?P<k>[0-9]{1,6})(?:-steps-(?P<steps>[0-9]{1,6}))?": split_sequence,
    "stress(?:-(?P<k>[0-9]{1,6})-(?P<target>[0-9]{1,6}))?": split_stress_test,
}
"""Functions that choose frames, by the name of the protocol with its numbers."""


def build_index(protocol: EvaluationProtocol, clips: Iterable[Photographs]) -> EvaluationIndex:
    """Collect the splits of each clip; raise InputError for equal names or a sequence."""
    scenes: dict[str, tuple[Split, ...]] = {}
    for clip in clips:
        if clip.name in scenes:
            raise InputError(f"Two clips are called {quote_value(clip.name)}; rename one of them.")
        scenes[clip.name] = protocol.select_splits(clip)
    if any(split.is_sequence for splits in scenes.values() for split in splits):
        raise InputError(
            f"{quote_value(protocol.name)} has no index, because its targets depend on each other; "
            "give the protocol to `evaluate` instead."
        )
    return EvaluationIndex(protocol.name, scenes)


def read_evaluation_index(path: Path) -> EvaluationIndex:
    """Read an evaluation index, published or of `write_evaluation_index`."""
    content = read_json(path, "download it again")
    if not isinstance(content, dict) or "version" not in content:
        # A published index names the scene alone; the rest is added.
        content = {"version": INDEX_VERSION, "protocol": path.stem, "scenes": content}
    try:
        file = TypeAdapter(IndexFile).validate_json(json.dumps(content), strict=True)
    except ValidationError as error:
        defect = error.errors(include_url=False)[0]
        place = quote_value(".".join(str(part) for part in defect["loc"]))
        raise InputError(
            f"{quote_value(path)} is no evaluation index of version {INDEX_VERSION} ({place}: "
            f"{defect['msg']}); it has to map the name of each scene to its context and target "
            "frames, or to null."
        ) from None
    # A scene has one split, several, or null, which leaves it out.
    scenes = {
        name: (splits,) if isinstance(splits, Split) else splits or ()
        for name, splits in file.scenes.items()
    }
    return EvaluationIndex(file.protocol, scenes)


def write_evaluation_index(path: Path | str, index: EvaluationIndex) -> None:
    """Write an index atomically, in the format that `read_evaluation_index` reads."""
    scenes = {
        # An empty list would not be valid, and null says the same.
        name: [{"context": s.context, "target": s.targets} for s in splits] or None
        for name, splits in index.scenes.items()
    }
    content = {"version": INDEX_VERSION, "protocol": index.name, "scenes": scenes}
    with replace_file(path) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())


@dataclass(frozen=True)
class Task:
    """A scene with its context and target frames."""

    scene: str
    context: tuple[int, ...]
    targets: tuple[int, ...]
    """Target frames, completed in this order into one scene."""
    open: Callable[[], Photographs]
    """Opens the photographs of the scene."""
    resolution: Resolution = None
    neighbours: tuple[int, ...] = ()
    """Frames beside the target, for scoring only."""
    keeps_order: bool = False
    """True to give Ψ the context in this order, as a published index has it, instead of sorted."""
    has_masks: bool = False
    """True if masks hide parts of the photographs of its scene."""
    refines_poses: bool = False
    """True to refine poses of the scene that matches contradict."""
    poses: PoseRefinement | None = None
    """What was done to the poses of `open`; None for nothing."""
    apart_by: Path | None = None
    """File that keeps the task apart, or None."""
    near: float | None = None
    """Smallest z-depth that its case gives, which `open` has set; None for none. So are `far` and
    `ignore`."""
    far: float | None = None
    ignore: IgnoredRegions | None = None

    def load(self, frames: tuple[int, ...]) -> list[View]:
        """Load the photographs of `frames`."""
        return self.open().views(frames, self.resolution)

    @property
    def name(self) -> str:
        """Unique name of the task in a run, as in tables."""
        first = self.targets[0]
        last = self.targets[-1]
        span = f"{first}" if first == last else f"{first}..{last}"
        frames = "+".join(str(frame) for frame in self.context)
        return f"{self.scene} {frames}>{span}"


def make_case_task(case: Case) -> Task:
    """Make a task of a case of a `cases.json`."""
    return Task(
        case.scene.name,
        case.context,
        (case.target,),
        case.open,
        case.resolution,
        case.neighbours,
        apart_by=case.apart_by,
        near=case.near,
        far=case.far,
        ignore=case.ignore,
    )


def make_tasks(
    protocol: EvaluationProtocol,
    clip: Photographs,
    resolution: Resolution = None,
    keeps_order: bool = False,
) -> list[Task]:
    """Make the tasks of a clip: one per target, or one per sequence.

    With `keeps_order`, Ψ gets the context in the order of the split instead of sorted by frame.
    """
    opened = partial(get_clip, clip)
    tasks = []
    for split in protocol.select_splits(clip):
        for frame in (*split.context, *split.targets):
            if frame >= len(clip):
                raise InputError(
                    f"The protocol {quote_value(protocol.name)} needs frame {frame} of "
                    f"{quote_value(clip.name)}, which has {len(clip)} frames; use the index of "
                    "this data set."
                )
        if split.is_sequence:
            task = Task(clip.name, split.context, split.targets, opened, resolution)
            tasks.append(replace(task, keeps_order=keeps_order))
            continue
        for target in split.targets:
            beside = find_neighbour_frames(target, split.context, len(clip))
            task = Task(clip.name, split.context, (target,), opened, resolution, beside)
            tasks.append(replace(task, keeps_order=keeps_order))
    return tasks


def get_clip(clip: Photographs) -> Photographs:
    """Return a clip that is open already, as `Task.open`."""
    return clip


def find_neighbour_frames(target: int, context: Sequence[int], num_frames: int) -> tuple[int, ...]:
    """Return the frames before and after `target` that exist and are not context."""
    beside = (target - 1, target + 1)
    return tuple(frame for frame in beside if 0 <= frame < num_frames and frame not in context)
