"""Runs of methods over tasks: predict, save, then score the saved; a stopped run resumes."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from gscompleter.config.generators import GeneratorSettings
from gscompleter.evaluation import store
from gscompleter.evaluation.measured_code import find_commit
from gscompleter.evaluation.methods import Models, check_methods, check_steps
from gscompleter.evaluation.protocols import Task, get_clip
from gscompleter.evaluation.scene_poses import refine_scene
from gscompleter.evaluation.steps import PreparedTask, attempt, complete_task
from gscompleter.generators import load_generator
from gscompleter.reconstructors import load_reconstructor
from gscompleter.reconstructors.features.depth_range import set_depth_range
from gscompleter.render.loading import load_renderer
from gscompleter.stages.context import normalize_exposures, reconstruct_context, sort_by_frame
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.jobs.jobs import (
    Engine,
    Job,
    check_shard,
    describe_loss,
    run_jobs,
    write_json,
)
from gscompleter.system.memory import check_memory
from gscompleter.system.progress import show_progress, stage, track
from gscompleter.system.timing import record_seconds
from gscompleter.types import View

RETRIES = 2
"""Number of times a task is repeated if its worker was killed."""


@dataclass(frozen=True)
class RunConfig:
    """Settings that determine the numbers, together with the tasks."""

    reconstructor: str = "plane-sweep"
    weights: str | None = None
    """File with the weights of the reconstructor; None selects the published ones."""
    depth: str = "none"
    depth_weights: str | None = None
    generator: str = "warp-inpaint"
    generator_settings: GeneratorSettings | None = None
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the renderer, and of photographs and Gaussians."""
    network_device: Literal["cpu", "cuda", "mps"] = "cpu"
    seed: int = 0
    baseline_iterations: int | None = None
    """As of `Models`."""
    source: Mapping[str, Any] = field(default_factory=dict)
    """Origin of the tasks, so that no folder mixes two sources."""

    def load_models(self, targets: Sequence[View]) -> Models:
        """Load the models of a task; those with weights are cached between tasks.

        Only the generator `oracle` uses the images of `targets`.
        """
        return Models(
            load_reconstructor(
                self.reconstructor,
                self.weights,
                self.network_device,
                self.depth,
                self.depth_weights,
            ),
            load_generator(
                self.generator,
                self.seed,
                targets,
                self.network_device,
                self.generator_settings,
            ),
            load_renderer(self.device),
            self.seed,
            self.baseline_iterations,
        )


Rerun = Literal["nothing", "failures", "scores"]
"""Earlier results to redo: none, failed tasks, or all scores from saved predictions."""


@dataclass(frozen=True)
class RowCounts:
    """Numbers of rows that a call of `evaluate` found missing, and of those that stood already.

    A missing row counts even if a simultaneous call wrote it.
    """

    done: int
    """Missing rows that have scores now."""
    failed: int
    """Missing rows that hold an error now."""
    skipped: int
    """Rows that stood already, with scores or errors."""
    failures: Sequence[str] = field(default=(), compare=False)
    """Rows without a score, of this call and earlier ones, with the reasons."""


def evaluate(
    tasks: Sequence[Task],
    methods: Sequence[str],
    out: Path,
    config: RunConfig = RunConfig(),
    shard: tuple[int, int] = (0, 1),
    rerun: Rerun = "nothing",
    engine: Engine | None = None,
) -> RowCounts:
    """Run methods on tasks and write a row of scores, or of an error, for each pair.

    Existing rows, reconstructed scenes and completed steps in `out` are kept, also for rows that
    are done again; simultaneous calls share the tasks. `shard` (i, n) selects the tasks i, i + n,
    i + 2n, …. Without an `engine` the tasks run in this process. Raises InputError for tasks,
    methods or settings with which nothing can be run; an error of a task is in its rows.
    """
    check_methods(methods, max((len(task.targets) for task in tasks), default=0))
    check_shard(*shard)
    check_tasks(tasks)
    # Once before all tasks: missing weights are then an error of the call, not of each task.
    check_steps(methods, config.load_models(()).generator)
    store.claim(out, collect_settings(config))
    share = tasks[shard[0] :: shard[1]]
    runner = TaskRunner(out, tuple(dict.fromkeys(methods)), config)
    refuse_changed_tasks(out, share)
    for task in share:
        for row in runner.find_rows(task):
            if rerun == "scores" or (rerun == "failures" and has_failed(row)):
                row.unlink(missing_ok=True)

    todo = {row: task for task in share for row in runner.find_missing_rows(task)}
    # Jobs are tasks: what all methods share is prepared once in a worker.
    named = {store.make_file_name(task.name): task for task in todo.values()}
    jobs = [Job(name, {"task": task}) for name, task in named.items()]

    def has_rows(job: Job) -> bool:
        return not runner.find_missing_rows(job.options["task"])

    ended = run_jobs(jobs, runner, has_rows, engine, RETRIES)
    # Cases are counted: the rows of all methods of a case come to light together.
    for _ in track(ended, "evaluating case", len(jobs)):
        pass
    failed = sum(has_failed(row) for row in todo)
    skipped = len(share) * len(runner.methods) - len(todo)
    return RowCounts(len(todo) - failed, failed, skipped, list_failures(runner, share))


def list_failures(runner: TaskRunner, tasks: Sequence[Task]) -> list[str]:
    """Describe the rows of tasks that hold an error, with the reason of each."""
    return [
        f"{task.name}, {method}: {store.read_run_file(row)['error']}"
        for task in tasks
        for row, method in runner.find_rows(task).items()
        if has_failed(row)
    ]


def has_failed(row: Path) -> bool:
    """Return True if a row exists and holds an error."""
    return row.exists() and store.read_run_file(row).get("error") is not None


@dataclass(frozen=True)
class TaskRunner:
    """Run the jobs of an evaluation, whose option `task` is a `Task`, and write their rows."""

    out: Path
    methods: tuple[str, ...]
    config: RunConfig

    def find_rows(self, task: Task) -> dict[Path, str]:
        """Return the paths of the rows of a task, with their methods."""
        return {
            store.get_score_path(self.out, task.name, method): method for method in self.methods
        }

    def find_missing_rows(self, task: Task) -> dict[Path, str]:
        """Return the rows of a task that have to be computed, with their methods."""
        return {row: m for row, m in self.find_rows(task).items() if not row.exists()}

    def __call__(self, job: Job) -> None:
        """Compute the missing rows of a task; one that was often killed is given up."""
        task: Task = job.options["task"]
        folder = store.get_task_folder(self.out, task.name)
        is_given_up = job.lost > RETRIES
        prepared: PreparedTask | str | None = describe_loss(job.lost) if is_given_up else None
        for row, method in self.find_missing_rows(task).items():
            # Progress inside a task would flood a log.
            with stage(f"{task.name}, {method}"), show_progress(None):
                # Prepared once, by the first method whose row is missing.
                if prepared is None:
                    prepared = attempt(partial(self.prepare, task, folder))
                content = build_row(task, method, prepared, folder)
            write_json(row, content)

    def prepare(self, task: Task, folder: Path) -> PreparedTask:
        """Prepare a task with the poses that its scene has in this run."""
        photographs = task.open()
        poses = None
        if task.refines_poses:
            photographs, poses = refine_scene(photographs, self.out)
        opened = partial(get_clip, photographs)
        return prepare_task(replace(task, open=opened, poses=poses), folder, self.config)


def prepare_task(task: Task, folder: Path, config: RunConfig) -> PreparedTask:
    """Load the photographs of a task, and load or reconstruct its initial scene."""
    views = load_task_views(task, task.context, config)
    if not task.keeps_order:
        views = sort_by_frame(views)
    targets = load_task_views(task, task.targets, config)
    neighbours = load_task_views(task, task.neighbours, config)
    images = [*views, *targets]
    # Images too large for the memory are refused before the models are loaded.
    check_memory(max(v.camera.width * v.camera.height for v in images), len(images))
    models = config.load_models(targets)
    context = load_or_reconstruct(folder / "context.pt", views, models)

    # All methods get the depth range that the scene was reconstructed in.
    given = normalize_exposures(views, context.gains)
    near = context.near
    far = context.far
    return PreparedTask(
        context.gaussians,
        tuple(set_depth_range(given, near, far)),
        tuple(set_depth_range(targets, near, far)),
        tuple(set_depth_range(neighbours, near, far)),
        models,
        context.seconds,
        context.notes,
        task.poses,
    )


def load_task_views(task: Task, frames: tuple[int, ...], config: RunConfig) -> list[View]:
    """Load photographs and number them by their frames."""
    return [
        replace(view.to(config.device), frame=frame)
        for view, frame in zip(task.load(frames), frames, strict=True)
    ]


def load_or_reconstruct(path: Path, views: Sequence[View], models: Models) -> store.SavedContext:
    """Load the scene saved at `path`, or reconstruct and save it.

    What is saved is of these photographs, since `evaluate` refuses a folder with rows of others.
    """
    if not store.is_complete(path):
        with record_seconds() as seconds:
            context = reconstruct_context(models.reconstructor, views)
        camera = context.views[0].camera
        assert camera.near is not None
        assert camera.far is not None
        saved = store.SavedContext(
            context.source.gaussians,
            float(camera.near),
            float(camera.far),
            seconds["total"],
            context.exposure_gains,
            tuple(context.notes),
        )
        store.save_values(path, vars(saved))
    # Always read back, so that a resumed run continues with the same tensors.
    return store.SavedContext(**store.load_values(path, views[0].image.device))


def collect_context_notes(out: Path, tasks: Sequence[Task]) -> dict[str, str]:
    """Collect what Ψ said about the photographs of tasks, by the name of the task."""
    notes = {}
    for task in tasks:
        for path in sorted(store.get_task_folder(out, task.name).glob("*.json")):
            said = store.read_run_file(path).get("context_notes", [])
            if said:
                notes[task.name] = " ".join(said)
    return notes


def build_row(
    task: Task, method: str, prepared: PreparedTask | str, folder: Path
) -> dict[str, Any]:
    """Build the row of a method on a task; `prepared` may be an error instead of a task."""
    outcome: dict[str, Any] = {"error": prepared, "reconstruct_seconds": None, "steps": []}
    if not isinstance(prepared, str):
        progress = complete_task(prepared, method, folder)
        steps = [asdict(step) for step in progress.steps]
        outcome = {"error": progress.error, "reconstruct_seconds": prepared.seconds, "steps": steps}
        if prepared.context_notes:
            outcome["context_notes"] = list(prepared.context_notes)
        poses = prepared.poses
        if poses is not None and poses.is_accepted:
            outcome["refined_poses"] = asdict(poses)
    described = describe_evaluated_task(task)
    row = {"version": store.RUN_VERSION, "task": described, "method": method, **outcome}
    commit = find_commit()
    return row if commit is None else {**row, "commit": commit}


def describe_evaluated_task(task: Task) -> dict[str, Any]:
    """Describe a task for its rows: what decides its scores, apart from the settings of the run."""
    keys = (
        *("name", "scene", "context", "targets", "neighbours"),
        *("resolution", "near", "far", "ignore"),
    )
    # As JSON has it, to be compared with rows. Of a mask the name, since it may lie elsewhere in a
    # later run.
    text = json.dumps(
        {key: getattr(task, key) for key in keys},
        default=lambda value: value.name if isinstance(value, Path) else asdict(value),
    )
    described: dict[str, Any] = json.loads(text)
    return described


def refuse_changed_tasks(out: Path, tasks: Sequence[Task]) -> None:
    """Raise InputError if a row, of any method, was made from other data than its task has now.

    The name of a task tells its scene and frames. If its file of cases has another resolution now,
    for instance, the scene and predictions that are saved do not fit it.
    """
    for task in tasks:
        wanted = describe_evaluated_task(task)
        for row in sorted(store.get_task_folder(out, task.name).glob("*.json")):
            saved = store.read_run_file(row).get("task", {})
            # Rows of earlier versions tell less.
            known = {key: value for key, value in wanted.items() if key in saved}
            difference = store.find_difference({key: saved[key] for key in known}, known)
            if difference is not None:
                name, old, new = difference
                raise InputError(
                    f"{quote_value(out)} holds the case {quote_value(task.name)} with {name} "
                    f"{quote_value(repr(old))}, and it has {quote_value(repr(new))} now; name "
                    "another folder."
                )


def check_tasks(tasks: Sequence[Task]) -> None:
    """Raise InputError if there is no task, or if two tasks share a folder."""
    if not tasks:
        raise InputError(
            "There is no case to run: no clip has the frames that the protocol needs; choose a "
            "protocol with a smaller step, or other data."
        )
    name, count = Counter(store.make_file_name(task.name) for task in tasks).most_common(1)[0]
    if count > 1:
        raise InputError(f"Two cases are called {name}; rename a scene.")


def collect_settings(config: RunConfig) -> dict[str, Any]:
    """Collect all settings that determine the numbers, named as on the command line."""
    values = asdict(config)
    settings = values.pop("generator_settings") or {}
    settings.pop("offload", None)  # it changes where the model waits, not what it computes
    return {**values, **{f"generator_{name}": value for name, value in settings.items()}}
