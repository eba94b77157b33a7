"""Methods run on cases and scored, with the tables of the scores."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.console import Console

from gscompleter.apps.batch.engine import make_engine
from gscompleter.apps.batch.running import print_failures
from gscompleter.apps.command_line.answers import print_json
from gscompleter.apps.command_line.exit_codes import choose_exit_code
from gscompleter.apps.commands.evaluate import EvaluateOptions
from gscompleter.apps.commands.shared_options import parse_resolution
from gscompleter.apps.evaluating.cases import collect_tasks, find_loader, print_skipped
from gscompleter.apps.evaluating.tables import write_and_print_tables
from gscompleter.apps.inputs.scene_request import LONG_SIDE
from gscompleter.apps.warmup import compile_kernels
from gscompleter.data.photographs import check_resolution
from gscompleter.evaluation.apart import record_uses
from gscompleter.evaluation.cases import SkippedScene
from gscompleter.evaluation.methods import expand_methods
from gscompleter.evaluation.protocols import Task
from gscompleter.evaluation.runner import RunConfig, collect_context_notes, evaluate
from gscompleter.evaluation.store import get_score_path, list_row_paths
from gscompleter.render.device import choose_devices
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError
from gscompleter.system.jobs.jobs import parse_shard
from gscompleter.system.progress import show_preparation, show_progress

MAX_NAMED = 5
"""Most cases of which a line says what Ψ said about their photographs."""


def run_methods(options: EvaluateOptions) -> int:
    """Run and score the methods on the cases, write and print the tables; return the exit code."""
    scored = score_methods(options)
    # A shard without cases has no tables.
    if list_row_paths(options.out):
        with show_progress(make_console(stderr=True, quiet=options.quiet)):
            write_and_print_tables(
                options.out, options.quiet, num_rows=scored.num_rows, as_json=options.json
            )
    elif options.json:
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


def score_methods(options: EvaluateOptions) -> Scored:
    """Run and score the methods on the cases, and print the first failures."""
    if not options.paths:
        raise InputError("No data is given; name a cases.json, or scenes with --protocol.")
    console = make_console(stderr=True, quiet=options.quiet)
    methods = expand_methods(options.methods)
    shard = parse_shard(options.shard, os.environ)
    if options.resolution is not None:
        check_resolution(parse_resolution(options.resolution))

    skipped: list[SkippedScene] = []
    notes: list[str] = []
    with show_progress(console), show_preparation("reading cases"):
        tasks = collect_tasks(options, skipped, notes)
    if options.invert_masks and not any(task.has_masks for task in tasks):
        raise InputError(
            "No scene has masks that could be read the other way round; leave it out.",
            "invert-masks",
        )
    # Several clips can have the same note.
    for note in dict.fromkeys(notes):
        console.print(note, soft_wrap=True)
    print_skipped(skipped, console)

    devices = choose_devices(options.device, options.renderer_device, options.network_device)
    config = RunConfig(
        reconstructor=options.reconstructor[0],
        weights=str(options.weights[0]) if options.weights else None,
        depth=options.depth[0],
        depth_weights=str(options.depth_weights[0]) if options.depth_weights else None,
        generator=options.synthesis.generator[0],
        generator_settings=options.synthesis.make_settings(),
        device=devices.renderer,
        network_device=devices.networks,
        seed=options.seed,
        source=describe_source(options, tasks),
    )
    engine = make_engine(options, options.out.resolve())

    apart = [task for task in tasks if task.apart_by is not None]
    if apart and shard[0] == 0 and will_score(apart, methods, options):
        record_uses(apart, f"evaluate --methods {' '.join(options.methods)}")

    # Kernels are compiled here once, before workers would each compile them.
    with show_progress(console):
        compile_kernels((config.device, config.reconstructor, config.generator))
        counts = evaluate(tasks, methods, options.out, config, shard, options.rerun, engine)

    print_context_notes(collect_context_notes(options.out, tasks), console)
    own = counts.done + counts.failed + counts.skipped
    print_failures(console, counts.failures, own)
    line = f"Scored {counts.done}, failed {counts.failed}, done earlier {counts.skipped}"
    console.print(f"{line}, of {len(tasks)} cases by {len(methods)} methods.", soft_wrap=True)
    return Scored(len(tasks) * len(methods), own, counts.failures)


def will_score(tasks: Sequence[Task], methods: Sequence[str], options: EvaluateOptions) -> bool:
    """Check whether this call computes scores of some tasks, rather than reading earlier ones."""
    rows = (get_score_path(options.out, task.name, m) for task in tasks for m in methods)
    return options.rerun == "scores" or not all(row.exists() for row in rows)


def print_context_notes(notes: Mapping[str, str], console: Console) -> None:
    """Print what Ψ said about the photographs of the first cases, and the number of the others."""
    for name, note in list(notes.items())[:MAX_NAMED]:
        console.print(f"{name}: {note}", soft_wrap=True)
    if len(notes) > MAX_NAMED:
        console.print(
            f"... and of {len(notes) - MAX_NAMED} more cases (`context_notes` of their rows)."
        )


def describe_source(options: EvaluateOptions, tasks: Sequence[Task]) -> dict[str, Any]:
    """Describe the cases, as an output folder records them.

    Scores with masks are not continued with scores without, nor the other way round.
    """
    has_masks = any(task.has_masks for task in tasks)
    num_apart = sum(task.apart_by is not None for task in tasks)
    # A cases.json has the resolution of each case; scenes of a protocol have none.
    size = LONG_SIDE if options.resolution is None and options.protocol else options.resolution
    loader = find_loader(options)
    return {
        "paths": [path.resolve().name for path in options.paths],
        "protocols": list(options.protocol),
        "resolution": list(size) if isinstance(size, tuple) else size,
        **({"masks": True} if has_masks else {}),
        **({"invert_masks": True} if has_masks and options.invert_masks else {}),
        **({"ignore_moving": True} if options.ignore_moving else {}),
        **({"apart": num_apart} if num_apart else {}),
        **({"one_per_scene": True} if options.one_per_scene else {}),
        **({"ego_mask": False} if options.no_ego_mask else {}),
        **({} if loader is None else {"loader": asdict(loader)}),
        **({} if options.near is None else {"near": options.near}),
        **({} if options.far is None else {"far": options.far}),
    }
