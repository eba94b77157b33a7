"""What was opened and loaded for a command that completes, and how its work begins."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from jaxtyping import Bool
from torch import Tensor

from gscompleter.apps.inputs.task import CompletionTask, Opened, Target
from gscompleter.apps.requests.completion import ResultsRequest, TargetRequest, WorkRequest
from gscompleter.apps.requests.scene import AloneRequest, PhotographsRequest
from gscompleter.completer import GSCompleter
from gscompleter.data.photograph_names import describe_offset
from gscompleter.editing.cutting import Region
from gscompleter.editing.removal import remove_gaussians
from gscompleter.planning.planner import Choice, ViewPlanner
from gscompleter.state import Completion
from gscompleter.system.progress import stage
from gscompleter.types import Camera


@dataclass(frozen=True)
class Gone:
    """Gaussians that a command takes out of the splat before anything is completed."""

    chosen: Bool[Tensor, "n"]
    """True for those of the task's scene that go."""
    contains: Region
    """Tells points of its place, at whose border Gaussians are cut."""


@dataclass(frozen=True)
class Prepared:
    """Everything that is loaded before the first completion, and the request that it follows."""

    command: str
    """The command, for the record of edits."""
    source: PhotographsRequest | AloneRequest
    work: WorkRequest
    targets: TargetRequest | None
    """Cameras at which holes are filled; None where nothing is invented, as in an update."""
    results: ResultsRequest
    opened: Opened
    task: CompletionTask
    explorer: ViewPlanner
    """Holds the completer, and searches for targets where none is named."""
    cameras: Mapping[int, Camera]
    """Cameras of all usable photographs by frame, in the frame of the result."""
    seconds: Mapping[str, float]
    """Seconds that count as those of the context stage."""
    inverts_masks: bool = False
    """True if masks are read the other way round: those of what goes, or else of photographs."""
    choose_gone: Callable[[Prepared], Gone] | None = None
    """Chooses what goes before anything is completed; None for nothing."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of this command alone, for `summary.json`."""
    reopened: tuple[Target, ...] = ()
    """Targets of earlier commands at which holes opened, and which an update does not fill."""

    @property
    def completer(self) -> GSCompleter:
        """The completer with its models."""
        return self.explorer.completer

    @property
    def max_targets(self) -> int:
        """Most cameras to search for."""
        return 0 if self.targets is None else self.targets.max_found

    def begin(self) -> Completion:
        """Initialize the context, without what goes first."""
        gone = None
        if self.choose_gone is not None:
            # Before the context, so that a wrong selection is refused without waiting for it.
            with stage("removing"):
                gone = self.choose_gone(self)
        task = self.task
        begun = self.completer.begin(
            task.views,
            task.scene,
            task.check_views,
            task.target_cameras,
            earlier=task.earlier,
            geometry=task.geometry,
            has_scene_range=task.scene is None or task.is_remade,
        )
        guarding = tuple(begun.with_depth_range(camera) for camera in task.witnesses.guarding)
        begun = replace(begun, free_space_cameras=guarding)
        if gone is None:
            return begun
        with stage("removing"):
            return remove_gaussians(begun, gone.chosen, gone.contains, self.completer.scenes)

    def with_choices(self, choices: Iterable[Choice]) -> Prepared:
        """Return a copy whose targets are the cameras that a planner chose."""
        # A candidate knows its photograph by the place among `cameras`, a target by its frame.
        frames = list(self.cameras)
        targets = []
        for choice in choices:
            frame = frames[choice.candidate.base]
            offset = describe_offset(choice.camera, self.cameras[frame])
            targets.append(
                Target(choice.camera, derived_from=frame, offset=offset, reason=choice.describe())
            )
        return self.with_targets(targets)

    def with_targets(self, targets: Sequence[Target]) -> Prepared:
        """Return a copy with other targets."""
        return replace(self, task=replace(self.task, targets=targets))
