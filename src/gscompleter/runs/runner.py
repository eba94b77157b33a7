"""Tasks times methods: predict, save, score. A run that was stopped goes on where it was.

Rows of scores are made from what is saved, so that to score again needs no method to run again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from gscompleter.batch.engines import Engine
from gscompleter.batch.jobs import CLAIMS, Job, Outcome
from gscompleter.batch.places import FolderPlace
from gscompleter.batch.rounds import Rounds, in_this_process
from gscompleter.batch.shards import checked_shard
from gscompleter.config.generators import GeneratorSettings
from gscompleter.errors import InputError
from gscompleter.generators import Generator, load_generator
from gscompleter.memory import check_memory
from gscompleter.progress import Activity, going_on, shown_on, stage
from gscompleter.reconstructors import Reconstructor, load_reconstructor
from gscompleter.render import load_renderer
from gscompleter.runs.methods import Models, check_methods
from gscompleter.runs.steps import Prepared, Step, attempt, complete_task, kept
from gscompleter.runs.store import (
    VERSION,
    SavedContext,
    claim,
    load_context,
    read_json,
    row_path,
    save_context,
    slug,
    task_folder,
    write_json,
)
from gscompleter.runs.tasks import Task
from gscompleter.stages.context import exposed_alike, sort_by_frame
from gscompleter.types import View

RETRIES = 2
"""How often a task is tried again whose worker was killed."""


@dataclass(frozen=True)
class RunConfig:
    """What decides the numbers, beside the tasks."""

    reconstructor: str = "plane-sweep"
    weights: str | None = None
    """The file of the reconstructor's weights; None takes the published ones."""
    generator: str = "warp-inpaint"
    generator_settings: GeneratorSettings | None = None
    """What the generator is told; None leaves all as it is."""
    device: Literal["cpu", "cuda"] = "cpu"
    seed: int = 0
    """Of everything random."""
    baseline_iterations: int | None = None
    """Most iterations of the baselines; their own numbers if None."""
    source: Mapping[str, Any] = field(default_factory=dict)
    """Where the tasks come from, so that no folder mixes two sources."""

    def load_reconstructor(self) -> Reconstructor:
        """Ψ. One with weights is kept from one task to the next."""
        weights = None if self.weights is None else Path(self.weights)
        return load_reconstructor(self.reconstructor, weights, self.device)

    def load_generator(self, targets: Sequence[View] = ()) -> Generator:
        """Φ. One with weights is kept from one task to the next."""
        return load_generator(
            self.generator, self.seed, targets, self.device, self.generator_settings
        )

    def models(self, targets: Sequence[View]) -> Models:
        """The models for a task. Only the generator `oracle` looks at the images of `targets`."""
        return Models(
            self.load_reconstructor(),
            self.load_generator(targets),
            load_renderer(self.device),
            self.seed,
            self.baseline_iterations,
        )


Again = Literal["nothing", "failures", "scores"]
"""What an earlier call did that is to be done once more: tasks that failed, or all scores, from
what is saved."""


@dataclass(frozen=True)
class RowCounts:
    """What a call of `evaluate` did, in rows: pairs of a task and a method."""

    done: int
    failed: int
    """Of those that are done now, how many say why they have no more steps."""
    skipped: int
    """Done by an earlier call."""


def evaluate(
    tasks: Sequence[Task],
    methods: Sequence[str],
    out: Path,
    config: RunConfig = RunConfig(),
    shard: tuple[int, int] = (0, 1),
    again: Again = "nothing",
    engine: Engine = in_this_process,
) -> RowCounts:
    """Run every method on every task of the shard, and write a row of scores for each.

    What is there already stays: rows, and of a task that was stopped its whole steps. A task that
    fails gives rows that say why, and the others go on.

    Args:
        tasks: The tasks of all shards.
        methods: Names of methods.
        out: Folder of results: a new one, or that of an earlier call, or of another shard.
        config: What decides the numbers; the same as in earlier calls.
        shard: (i, n) takes the tasks i, i + n, i + 2n, …; n calls with i from 0 do them all.
        again: What of an earlier call is done once more.
        engine: Who does it. Calls at the same time share the tasks, whatever engine they have.

    Raises:
        InputError: a wrong name or shard, a folder that holds something else, a full disk.
    """
    check_evaluation(tasks, methods, config, shard)
    claim(out, deciding(config))
    share = tasks[shard[0] :: shard[1]]
    done = Evaluating(out, tuple(methods), config, again)
    todo = {row: task for task in share for row in done.missing(task)}
    jobs = [job_of(task) for task in {task.name: task for task in todo.values()}.values()]
    rounds = Rounds(FolderPlace(out), done, jobs, RETRIES)
    activity = Activity("evaluating", len(todo))
    with going_on(activity) if todo else nullcontext():
        for outcome in rounds.outcomes(engine, done):
            for _ in done.rows_of(outcome.job.options["task"]) & set(todo):
                activity.stepped()
    failed = sum(read_json(row).get("error") is not None for row in todo)
    return RowCounts(len(todo) - failed, failed, len(share) * len(methods) - len(todo))


def job_of(task: Task) -> Job:
    """A task as a job, which all methods of the task are."""
    return Job(slug(task.name), {"task": task})


@dataclass(frozen=True)
class Evaluating:
    """Does the jobs of an evaluation, and knows what became of them."""

    out: Path
    methods: tuple[str, ...]
    config: RunConfig
    again: Again = "nothing"

    def rows_of(self, task: Task) -> set[Path]:
        """Where the rows of a task lie."""
        return {row_path(self.out, task.name, method) for method in self.methods}

    def missing(self, task: Task) -> dict[Path, str]:
        """The rows of a task that are to be made, and of which method they are."""
        rows = {row_path(self.out, task.name, method): method for method in self.methods}
        return {row: method for row, method in rows.items() if is_missing(row, self.again)}

    def ended(self, job: Job) -> Outcome | None:
        """What became of a task that others did."""
        there = all(row.exists() for row in self.rows_of(job.options["task"]))
        return Outcome(job, "done") if there else None

    def give_up(self, job: Job, reason: str) -> Outcome:
        """Write rows that say why there is nothing."""
        task = job.options["task"]
        for row, method in self.missing(task).items():
            write_json(row, row_of(task, method, reason, task_folder(self.out, task.name)))
        return Outcome(job, "failed", reason)

    def __call__(self, job: Job) -> Outcome:
        """Run every method on the task that has no row yet, unless somebody else does it.

        Raises:
            OutputError: where a result cannot be written.
        """
        with FolderPlace(self.out).claimed(f"{CLAIMS}/{job.name}") as lost:
            if lost is None:
                return Outcome(job, "elsewhere")
            self.run(job.options["task"])
            return Outcome(job, "done")

    def run(self, task: Task) -> None:
        """Make the rows of a task that are missing."""
        prepared, folder = None, task_folder(self.out, task.name)
        for row, method in self.missing(task).items():
            # What goes on inside would fill a log.
            with stage(f"{task.name}, {method}"), shown_on(None):
                if prepared is None:
                    prepared = attempt(partial(prepare, task, folder, self.config))
                made = row_of(task, method, prepared, folder)
            write_json(row, made)


def is_missing(path: Path, again: Again) -> bool:
    """Whether a row is to be made."""
    if again == "scores" or not path.exists():
        return True
    return again == "failures" and read_json(path).get("error") is not None


def prepare(task: Task, folder: Path, config: RunConfig) -> Prepared:
    """Read the photographs of a task, and read, or compute, the scene that all methods begin with.

    Raises:
        InputError: where a photograph is damaged, other than that of a later target, or there is
            not enough memory.
        OutputError: where the scene cannot be saved.
    """
    views = sort_by_frame(photographs(task, task.context, config))
    neighbours = photographs(task, task.neighbours, config)
    targets, error = readable_targets(task, config)
    if not targets:
        raise InputError(str(error))
    images = [*views, *targets]
    check_memory(max(v.camera.width * v.camera.height for v in images), len(images))
    models = config.models(targets)
    context = context_at(folder / "context.npz", views, models)

    def ranged(view: View) -> View:
        return replace(view, camera=replace(view.camera, near=context.near, far=context.far))

    return Prepared(
        context.gaussians,
        tuple(map(ranged, exposed_alike(views, context.gains))),
        tuple(map(ranged, targets)),
        tuple(map(ranged, neighbours)),
        models,
        context.seconds,
        error,
    )


def photographs(task: Task, frames: tuple[int, ...], config: RunConfig) -> list[View]:
    """Photographs of `frames`, numbered by them; an InputError where one is damaged."""
    return [
        replace(view.to(config.device), frame=frame)
        for view, frame in zip(task.load(frames), frames, strict=True)
    ]


def readable_targets(task: Task, config: RunConfig) -> tuple[list[View], str | None]:
    """The targets up to the first whose photograph is damaged, and what is wrong with that."""
    targets: list[View] = []
    for frame in task.targets:
        loaded = attempt(partial(photographs, task, (frame,), config))
        if isinstance(loaded, str):
            return targets, f"Frame {frame}: {loaded}"
        targets += loaded
    return targets, None


def context_at(path: Path, views: Sequence[View], models: Models) -> SavedContext:
    """The scene that is saved at `path`, else what Ψ makes of the views, as by `kept`.

    Raises InputError for fewer than two views, or none that make a stereo pair.
    """
    device = views[0].image.device if views else "cpu"

    def save() -> None:
        made = models.completer().reconstruct(views)
        near, far = made.views[0].camera.near, made.views[0].camera.far
        assert near is not None
        assert far is not None
        seconds = made.seconds["total"]
        save_context(path, SavedContext(made.gaussians, near, far, seconds, made.gains))

    return kept(path, lambda: load_context(path, device), save)


def row_of(task: Task, method: str, prepared: Prepared | str, folder: Path) -> dict[str, Any]:
    """What a method came to on a task; `prepared` may be the reason why it came to nothing."""
    steps: tuple[Step, ...] = ()
    error: str | None
    if isinstance(prepared, str):
        error, seconds = prepared, None
    else:
        progress = complete_task(prepared, method, folder)
        steps, error, seconds = progress.steps, progress.error, prepared.seconds
    return {
        "version": VERSION,
        "task": {
            "name": task.name,
            "context": list(task.context),
            "targets": list(task.targets),
            "neighbours": list(task.neighbours),
        },
        "method": method,
        "error": error,
        "reconstruct_seconds": seconds,
        "steps": [asdict(step) for step in steps],
    }


def check_evaluation(
    tasks: Sequence[Task], methods: Sequence[str], config: RunConfig, shard: tuple[int, int]
) -> None:
    """Raise an InputError, before anything is written, where a run is impossible."""
    check_methods(methods, max((len(task.targets) for task in tasks), default=0))
    checked_shard(shard)
    check_tasks(tasks)
    config.load_reconstructor()
    config.load_generator()


def check_tasks(tasks: Sequence[Task]) -> None:
    """Raise an InputError for no task at all, and for two that would be written to one place."""
    if not tasks:
        raise InputError(
            "There is no case to run: no clip has the frames that the protocol asks for; choose a "
            "protocol with a smaller step, or other data."
        )
    names: dict[str, str] = {}
    for task in tasks:
        folder = slug(task.name)
        if folder in names:
            raise InputError(
                f"The cases {names[folder]} and {task.name} have the same name; rename a scene."
            )
        names[folder] = task.name


def deciding(config: RunConfig) -> dict[str, Any]:
    """All that decides the numbers, by the names of the command line.

    Where the parts of a generator wait is not among it.
    """
    values = asdict(config)
    settings = values.pop("generator_settings") or {}
    settings.pop("offload", None)
    return {**values, **{f"generator_{name}": value for name, value in settings.items()}}
