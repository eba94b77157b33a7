"""What a method is run on: a scene to complete for one target, or for several one after the other.

A case of a `cases.json` and of a protocol that extrapolates is a task of one step. A clip that is
completed view after view is one of many (paper, "Analysis of Long Sequence Completion").
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from gscompleter.data.cases import Case
from gscompleter.data.framing import Resolution
from gscompleter.data.photographs import PosedPhotographs, without_masked
from gscompleter.errors import InputError
from gscompleter.runs.protocols import EvaluationProtocol, Split
from gscompleter.types import View


@dataclass(frozen=True)
class Task:
    """Frames of a scene: what is given, and what it is completed for."""

    scene: str
    """Name of the clip."""
    context: tuple[int, ...]
    """Frames that are known from the beginning."""
    targets: tuple[int, ...]
    """Frames that are completed, in this order, each into the scene that the last one left."""
    load: Callable[[tuple[int, ...]], list[View]]
    """Photographs of frames."""
    neighbours: tuple[int, ...] = ()
    """Frames beside the target, for scoring only."""

    @property
    def name(self) -> str:
        """What tables call it; no two tasks of a run share it."""
        first, last = self.targets[0], self.targets[-1]
        span = f"{first}" if first == last else f"{first}..{last}"
        return f"{self.scene} {'+'.join(map(str, self.context))}>{span}"


def task_of(case: Case) -> Task:
    """The task that a case of a `cases.json` is."""
    return Task(case.scene.name, case.context, (case.target,), case.load, case.neighbours)


def tasks_of(
    protocol: EvaluationProtocol,
    clip: PosedPhotographs,
    resolution: Resolution = None,
    ignore_masked: bool = False,
) -> list[Task]:
    """The tasks of a clip: one for each target, or one for all where they depend on each other.

    Args:
        protocol: What chooses the frames.
        clip: Where they are.
        resolution: As in `PosedPhotographs.views`.
        ignore_masked: Whether what is masked in the photographs is ignored.

    Raises:
        InputError: where a frame of the protocol is not in the clip.
    """

    load = partial(photographs_of, clip, resolution, ignore_masked)
    tasks = []
    for split in protocol.splits(clip):
        check_frames(protocol, split, clip)
        if split.in_sequence:
            tasks.append(Task(clip.name, split.context, split.targets, load))
            continue
        for target in split.targets:
            beside = neighbours(target, split.context, len(clip))
            tasks.append(Task(clip.name, split.context, (target,), load, beside))
    return tasks


def photographs_of(
    clip: PosedPhotographs, resolution: Resolution, ignore_masked: bool, frames: tuple[int, ...]
) -> list[View]:
    """Photographs of frames of a clip, as `tasks_of` is asked for them."""
    views = clip.views(frames, resolution)
    return without_masked(views, clip, resolution) if ignore_masked else views


def check_frames(protocol: EvaluationProtocol, split: Split, clip: PosedPhotographs) -> None:
    """Raise an InputError for a frame that the clip does not have."""
    for frame in (*split.context, *split.targets):
        if frame >= len(clip):
            raise InputError(
                f"The protocol {protocol.name} asks for frame {frame} of {clip.name}, which "
                f"has {len(clip)} frames; use the index that was made for this data set."
            )


def neighbours(target: int, context: Sequence[int], num_frames: int) -> tuple[int, ...]:
    """The frames before and after `target`, where they exist and are not context."""
    return tuple(
        frame
        for frame in (target - 1, target + 1)
        if 0 <= frame < num_frames and frame not in context
    )
