"""Tasks: a scene to complete for one target, or for several in sequence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from gscompleter.data.cases import Case
from gscompleter.data.photographs import PosedPhotographs, apply_masks
from gscompleter.data.resize import Resolution
from gscompleter.errors import InputError
from gscompleter.evaluation.protocols import EvaluationProtocol
from gscompleter.types import View


@dataclass(frozen=True)
class Task:
    """A scene with its context and target frames."""

    scene: str
    """Name of the clip."""
    context: tuple[int, ...]
    targets: tuple[int, ...]
    """Target frames, completed in this order into one scene."""
    load: Callable[[tuple[int, ...]], list[View]]
    """Function that loads the photographs of frames."""
    neighbours: tuple[int, ...] = ()
    """Frames beside the target, for scoring only."""

    @property
    def name(self) -> str:
        """Unique name of the task in a run, as in tables."""
        first, last = self.targets[0], self.targets[-1]
        span = f"{first}" if first == last else f"{first}..{last}"
        return f"{self.scene} {'+'.join(map(str, self.context))}>{span}"


def make_case_task(case: Case) -> Task:
    """Make a task of a case of a `cases.json`."""
    return Task(case.scene.name, case.context, (case.target,), case.load, case.neighbours)


def make_tasks(
    protocol: EvaluationProtocol,
    clip: PosedPhotographs,
    resolution: Resolution = None,
    use_masks: bool = False,
) -> list[Task]:
    """Make the tasks of a clip: one per target, or one per sequence.

    Args:
        protocol: Chooses the frames.
        clip: The photographs.
        resolution: As in `PosedPhotographs.views`.
        use_masks: True to ignore masked pixels of the photographs.
    """
    load = partial(load_clip_views, clip, resolution, use_masks)
    tasks = []
    for split in protocol.select_splits(clip):
        for frame in (*split.context, *split.targets):
            if frame >= len(clip):
                raise InputError(
                    f"The protocol {protocol.name} needs frame {frame} of {clip.name}, which "
                    f"has {len(clip)} frames; use the index of this data set."
                )
        if split.is_sequence:
            tasks.append(Task(clip.name, split.context, split.targets, load))
            continue
        for target in split.targets:
            beside = find_neighbours(target, split.context, len(clip))
            tasks.append(Task(clip.name, split.context, (target,), load, beside))
    return tasks


def load_clip_views(
    clip: PosedPhotographs, resolution: Resolution, use_masks: bool, frames: tuple[int, ...]
) -> list[View]:
    """Load photographs of a clip, with the arguments of `make_tasks`."""
    views = clip.views(frames, resolution)
    return apply_masks(views, clip, resolution) if use_masks else views


def find_neighbours(target: int, context: Sequence[int], num_frames: int) -> tuple[int, ...]:
    """Return the frames before and after `target` that exist and are not context."""
    beside = (target - 1, target + 1)
    return tuple(frame for frame in beside if 0 <= frame < num_frames and frame not in context)
