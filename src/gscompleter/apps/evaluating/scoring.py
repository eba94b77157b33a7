"""Methods run on cases and scored, with the tables of the scores."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from gscompleter.apps.batch.engine import make_engine
from gscompleter.apps.batch.running import print_failures
from gscompleter.apps.command_line.answers import print_json
from gscompleter.apps.command_line.exit_codes import choose_exit_code
from gscompleter.apps.evaluating.cases import collect_tasks, find_authors_loader, print_skipped
from gscompleter.apps.evaluating.tables import write_and_print_tables
from gscompleter.apps.requests.evaluation import CasesRequest, EvaluationRequest
from gscompleter.apps.requests.scene import DEFAULT_LONG_SIDE, decide_resolution
from gscompleter.apps.warmup import compile_kernels
from gscompleter.data.photographs import check_resolution
from gscompleter.data.sfm.refining import has_pycolmap
from gscompleter.evaluation.apart import record_uses
from gscompleter.evaluation.cases import SkippedScene
from gscompleter.evaluation.methods import expand_methods
from gscompleter.evaluation.protocols import Task
from gscompleter.evaluation.runner import RunConfig, collect_context_notes, evaluate
from gscompleter.evaluation.store import get_score_path, list_row_paths
from gscompleter.evaluation.tables import write_tables
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError
from gscompleter.system.progress import show_preparation, show_progress

TABLES = "tables"
"""Folder in OUT of the tables that compare several runs."""
RUNS = "runs"
"""Folder in OUT with the scores of each of these runs, as `run_methods` writes them."""
MAX_NAMED_CASES = 5
"""Most cases of which a line says what Ψ said about their photographs."""


def run_methods(request: EvaluationRequest) -> int:
    """Run and score the methods on the cases, write and print the tables; return the exit code."""
    scored = score_methods(request)
    answer = request.answer
    # A shard without cases has no tables.
    if list_row_paths(request.out):
        with show_progress(make_console(stderr=True, quiet=answer.quiet)):
            write_and_print_tables(
                request.out, answer.quiet, num_rows=scored.num_rows, as_json=answer.json
            )
    elif answer.json:
        print_json({"cases": 0, "methods": {}, "failures": list(scored.failures)})
    return choose_exit_code(len(scored.failures), scored.num_own_rows)


@dataclass(frozen=True)
class Scored:
    """Outcome of a call of `evaluate`."""

    num_rows: int
    """Number of rows of all shards."""
    num_own_rows: int
    """Number of rows of this shard, scored now or earlier."""
    failures: Sequence[str]
    """Rows of this shard without a score, with the reasons."""


def score_methods(request: EvaluationRequest) -> Scored:
    """Run and score the methods on the cases, and print the first failures."""
    console = make_console(stderr=True, quiet=request.answer.quiet)
    methods = expand_methods(request.methods)
    cases = request.cases
    if cases.resolution is not None:
        check_resolution(decide_resolution(cases.resolution))

    skipped: list[SkippedScene] = []
    notes: list[str] = []
    with show_progress(console), show_preparation("reading cases"):
        tasks = collect_tasks(cases, skipped, notes)
    # Several clips can have the same note.
    for note in dict.fromkeys(notes):
        console.print(note, soft_wrap=True)
    print_skipped(skipped, console)
    if cases.masks.is_inverted and not any(task.has_masks for task in tasks):
        raise InputError(
            "No scene has masks that could be read the other way round; leave it out.",
            "invert-masks",
        )
    tasks = leave_poses_without_colmap(tasks, console)

    models = request.models
    config = RunConfig(
        reconstructor=models.reconstructor,
        weights=None if models.weights is None else str(models.weights),
        depth=models.depth,
        depth_weights=None if models.depth_weights is None else str(models.depth_weights),
        generator=models.generator,
        generator_settings=models.generator_settings,
        device=models.device,
        network_device=models.network_device,
        seed=models.seed,
        source=describe_source(cases, tasks),
    )
    engine = make_engine(request.engine, request.out.resolve())
    share = request.engine.share

    apart = [task for task in tasks if task.apart_by is not None]
    if apart and share[0] == 0 and will_score(apart, methods, request):
        record_uses(apart, f"evaluate --methods {' '.join(request.methods)}")

    # Kernels are compiled here once, before workers would each compile them.
    with show_progress(console):
        compile_kernels((config.device, config.reconstructor, config.generator))
        counts = evaluate(tasks, methods, request.out, config, share, request.rerun, engine)

    print_context_notes(collect_context_notes(request.out, tasks), console)
    own = counts.done + counts.failed + counts.skipped
    print_failures(console, counts.failures, own)
    line = f"Scored {counts.done}, failed {counts.failed}, done earlier {counts.skipped}"
    console.print(f"{line}, of {len(tasks)} cases by {len(methods)} methods.", soft_wrap=True)
    return Scored(len(tasks) * len(methods), own, counts.failures)


def leave_poses_without_colmap(tasks: list[Task], console: Console) -> list[Task]:
    """Leave poses as they are given where COLMAP is missing, and say so."""
    if has_pycolmap() or not any(task.refines_poses for task in tasks):
        return tasks
    console.print(
        "Poses stay as they are given; pip install 'gscompleter[poses]' refines those that matches "
        "contradict.",
        soft_wrap=True,
    )
    return [replace(task, refines_poses=False) for task in tasks]


def will_score(tasks: Sequence[Task], methods: Sequence[str], request: EvaluationRequest) -> bool:
    """Check whether this call computes scores of some tasks, rather than reading earlier ones."""
    rows = (get_score_path(request.out, task.name, m) for task in tasks for m in methods)
    return request.rerun == "scores" or not all(row.exists() for row in rows)


def print_context_notes(notes: Mapping[str, str], console: Console) -> None:
    """Print what Ψ said about the photographs of the first cases, and the number of the others."""
    for name, note in list(notes.items())[:MAX_NAMED_CASES]:
        console.print(f"{name}: {note}", soft_wrap=True)
    if len(notes) > MAX_NAMED_CASES:
        console.print(
            f"... and of {len(notes) - MAX_NAMED_CASES} more cases (`context_notes` of their rows)."
        )


def describe_source(cases: CasesRequest, tasks: Sequence[Task]) -> dict[str, Any]:
    """Describe the cases, as an output folder records them.

    Scores with masks are not continued with scores without, nor the other way round.
    """
    has_masks = any(task.has_masks for task in tasks)
    num_apart = sum(task.apart_by is not None for task in tasks)
    # A cases.json has the resolution of each case; scenes of a protocol have none.
    size = DEFAULT_LONG_SIDE if cases.resolution is None and cases.protocol else cases.resolution
    loader = find_authors_loader(cases)
    return {
        "paths": [path.resolve().name for path in cases.paths],
        "protocols": list(cases.protocol),
        "resolution": list(size) if isinstance(size, tuple) else size,
        **({"masks": True} if has_masks else {}),
        **({"invert_masks": True} if has_masks and cases.masks.is_inverted else {}),
        **({"ignore_moving": True} if cases.ignore_moving else {}),
        **({"apart": num_apart} if num_apart else {}),
        **({"one_per_scene": True} if cases.one_per_scene else {}),
        **({"ego_mask": False} if not cases.ego_mask else {}),
        **({"refines_poses": True} if any(task.refines_poses for task in tasks) else {}),
        **({} if loader is None else {"loader": asdict(loader)}),
        **({} if cases.near is None else {"near": cases.near}),
        **({} if cases.far is None else {"far": cases.far}),
    }


def write_run_tables(folder: Path) -> None:
    """Write the tables of one of several runs; a shard without cases has none."""
    if list_row_paths(folder):
        write_tables(folder)


def awaits_other_shards(request: EvaluationRequest, folders: Iterable[Path]) -> bool:
    """Check whether a table has to wait for other shards, which have all cases of a run; say so.

    `folders` are those of the runs that the table compares.
    """
    _, num_shards = request.engine.share
    if num_shards == 1 or all(list_row_paths(folder) for folder in folders):
        return False
    console = make_console(stderr=True, quiet=request.answer.quiet)
    console.print("Not written yet: all cases of a run are those of other shards.", soft_wrap=True)
    return True


def choose_common_exit_code(scored: Sequence[Scored]) -> int:
    """Return the exit code of several runs, which counts the rows of each."""
    failed = sum(len(run.failures) for run in scored)
    return choose_exit_code(failed, sum(run.num_own_rows for run in scored))
