"""The commands `evaluate`, `tables` and `index`."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import groupby, islice
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from gscompleter.apps.commands.batch import make_engine, print_failures
from gscompleter.apps.commands.exit_codes import choose_exit_code
from gscompleter.apps.commands.options import (
    LONG_SIDE,
    EvaluateOptions,
    IndexOptions,
    TablesOptions,
    parse_resolution,
)
from gscompleter.apps.warmup import compile_kernels
from gscompleter.data.formats import open_photographs
from gscompleter.data.limits import check_planes
from gscompleter.data.photographs import MAX_TRANSLATION, Photographs, Resolution, check_resolution
from gscompleter.evaluation import protocols, tables
from gscompleter.evaluation.authors_loader import AuthorsLoader
from gscompleter.evaluation.cases import Case, SkippedScene, filter_usable, open_clips, read_cases
from gscompleter.evaluation.methods import expand_methods
from gscompleter.evaluation.paper import get_data_set
from gscompleter.evaluation.runner import RunConfig, evaluate
from gscompleter.evaluation.store import list_row_paths
from gscompleter.evaluation.tables import RunSummary
from gscompleter.render.device import choose_device
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_file import reserve_file
from gscompleter.system.jobs.jobs import parse_shard
from gscompleter.system.progress import show_preparation, show_progress


def run_methods(options: EvaluateOptions) -> int:
    """Run and score the methods on the cases, write and print the tables; return the exit code."""
    scored = score_methods(options)
    # A shard without cases has no tables.
    if list_row_paths(options.out):
        with show_progress(Console(stderr=True, quiet=options.quiet)):
            write_and_print_tables(options.out, options.quiet, num_rows=scored.num_rows)
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
    console = Console(stderr=True, quiet=options.quiet, highlight=False)
    methods = expand_methods(options.methods)
    shard = parse_shard(options.shard, os.environ)
    if options.resolution is not None:
        check_resolution(parse_resolution(options.resolution))

    skipped: list[SkippedScene] = []
    notes: list[str] = []
    with show_progress(console), show_preparation("reading cases"):
        tasks = collect_tasks(options, skipped, notes)
    # Several clips can have the same note.
    for note in dict.fromkeys(notes):
        console.print(note, markup=False, soft_wrap=True)
    print_skipped(skipped, console)

    config = RunConfig(
        reconstructor=options.reconstructor[0],
        weights=str(options.weights[0]) if options.weights else None,
        depth=options.depth,
        depth_weights=str(options.depth_weights) if options.depth_weights else None,
        generator=options.synthesis.generator,
        generator_settings=options.synthesis.make_settings(),
        device=choose_device(options.device),
        seed=options.seed,
        source=describe_source(options, any(task.has_masks for task in tasks)),
    )
    engine = make_engine(options, options.out.resolve())

    # Kernels are compiled here once, before workers would each compile them.
    with show_progress(console):
        compile_kernels((config.device, config.reconstructor, config.generator))
        counts = evaluate(tasks, methods, options.out, config, shard, options.rerun, engine)

    own = counts.done + counts.failed + counts.skipped
    print_failures(console, counts.failures, own)
    line = f"Scored {counts.done}, failed {counts.failed}, done earlier {counts.skipped}"
    console.print(f"{line}, of {len(tasks)} cases by {len(methods)} methods.")
    return Scored(len(tasks) * len(methods), own, counts.failures)


def describe_source(options: EvaluateOptions, has_masks: bool = False) -> dict[str, Any]:
    """Describe the cases, as an output folder records them.

    Scores with masks are not continued with scores without, nor the other way round.
    """
    # A cases.json has the resolution of each case; scenes of a protocol have none.
    size = LONG_SIDE if options.resolution is None and options.protocol else options.resolution
    loader = find_loader(options)
    return {
        "paths": [path.resolve().name for path in options.paths],
        "protocols": list(options.protocol),
        "resolution": list(size) if isinstance(size, tuple) else size,
        **({"masks": True} if has_masks else {}),
        **({"ignore_moving": True} if options.ignore_moving else {}),
        **({"one_per_scene": True} if options.one_per_scene else {}),
        **({} if options.ego_mask else {"ego_mask": False}),
        **({} if loader is None else {"loader": asdict(loader)}),
        **({} if options.near is None else {"near": options.near}),
        **({} if options.far is None else {"far": options.far}),
    }


def run_tables(options: TablesOptions) -> None:
    """Write the tables of an evaluation, and print the tables."""
    with show_progress(Console(stderr=True, quiet=options.quiet)):
        write_and_print_tables(options.out, options.quiet, options.fid)


def write_and_print_tables(
    out: Path, quiet: bool, with_fid: bool = False, num_rows: int = 0
) -> None:
    """Write the tables of an evaluation, and print the tables unless `quiet`.

    It repeats this if other shards added rows meanwhile and all `num_rows` are there.
    """
    # Several shards may end together, and each writes the tables. The one that saw all rows writes
    # again until no row changed while it wrote, so that the tables that remain are complete.
    written = None
    rows = list_row_times(out)
    while written is None or (rows != written and len(rows) >= num_rows):
        written = rows
        with show_preparation("tables"):
            summary = tables.write_tables(out, with_fid)
        rows = list_row_times(out)
    if not quiet:
        print_tables(summary, out)


def list_row_times(out: Path) -> dict[Path, int]:
    """Return the files of scores with their modification times."""
    return {path: path.stat().st_mtime_ns for path in list_row_paths(out)}


def run_index(options: IndexOptions) -> None:
    """Write the evaluation index of a protocol for a data set."""
    skipped: list[SkippedScene] = []
    rule = protocols.parse_protocol(options.protocol)
    with (
        reserve_file(options.out, options.overwrite),
        show_progress(Console(stderr=True, quiet=options.quiet)),
        show_preparation("reading clips"),
    ):
        index = protocols.build_index(rule, filter_usable(open_clips(options.path), skipped))
        # Skipped scenes are recorded as scenes without a case, not left out.
        index = replace(index, scenes={**index.scenes, **{clip.name: () for clip in skipped}})
        if not any(index.scenes.values()):
            reason = f" ({skipped[0].name}: {skipped[0].reason})" if skipped else ""
            raise InputError(
                f"The protocol {quote_value(options.protocol)} chooses no case in the "
                f"{len(index.scenes)} scene(s) of {quote_value(options.path)}{reason}; choose one "
                "with a smaller step, or other data."
            )
        protocols.write_evaluation_index(options.out, index)
    console = Console(quiet=options.quiet, highlight=False)
    print_skipped(skipped, console)

    # A split is one choice of context frames, and each of its targets is a case.
    targets = [len(split.targets) for splits in index.scenes.values() for split in splits]
    used = [name for name, splits in index.scenes.items() if splits]
    console.print(
        f"{sum(targets)} cases in {len(used)} scenes, {len(index.scenes) - len(used)} scenes "
        f"skipped: {options.out}",
        soft_wrap=True,
    )


def collect_tasks(
    options: EvaluateOptions, skipped: list[SkippedScene], notes: list[str]
) -> list[protocols.Task]:
    """Collect the tasks of the options, and append to `skipped` and `notes`."""
    if options.protocol:
        # The iterator opens clips one by one, so those beyond the limit are not opened.
        return list(islice(iterate_tasks(options, skipped, notes), options.limit))

    cases = [case for path in options.paths for case in read_cases(find_cases_file(path))]
    if options.one_per_scene:
        # The first case of a scene is the last that overwrites its entry in reversed order.
        first = {case.scene: case for case in reversed(cases)}
        cases = [case for case in cases if case is first[case.scene]]
    cases = cases[: options.limit]

    tasks: list[protocols.Task] = []
    # Cases of one scene stand together in a file, so that each scene is opened once for its notes.
    for scene, group in groupby(cases, lambda case: case.scene):
        own = [protocols.make_case_task(apply_options(case, options)) for case in group]
        # A scene that cannot be opened fails later, and its row in the table has the reason.
        with suppress(InputError):
            clip = open_photographs(scene)
            notes += clip.notes
            own = mark_masked(clip if options.masks else clip.leave_out_masks(), own, notes)
        tasks += own
    return tasks


def mark_masked(
    clip: Photographs, tasks: Sequence[protocols.Task], notes: list[str]
) -> list[protocols.Task]:
    """Mark the tasks of a clip if their photographs have masks, and append a note about these."""
    frames = {frame for task in tasks for frame in (*task.context, *task.targets, *task.neighbours)}
    # Frames that the clip does not have are refused when their case is run.
    masks = clip.describe_masks(sorted(frame for frame in frames if frame < len(clip)))
    if masks is None:
        return list(tasks)
    notes.append(f"{clip.name}: {masks} are read; what they hide is ignored.")
    return [replace(task, has_masks=True) for task in tasks]


def apply_options(case: Case, options: EvaluateOptions) -> Case:
    """Return a case with masks, resolution and depth range of the options."""
    size = options.resolution
    return replace(
        case,
        near=case.near if options.near is None else options.near,
        far=case.far if options.far is None else options.far,
        resolution=case.resolution if size is None else parse_resolution(size),
        masks=options.masks,
        ignore_moving=options.ignore_moving,
        ego_mask=options.ego_mask,
    )


def iterate_tasks(
    options: EvaluateOptions, skipped: list[SkippedScene], notes: list[str]
) -> Iterator[protocols.Task]:
    """Iterate over the tasks of the protocols, clip by clip."""
    rules = [protocols.parse_protocol(text) for text in options.protocol]

    # With a preset, images are cropped and scenes left out as by its authors' code (decision 047).
    loader = find_loader(options)
    resolution = LONG_SIDE if options.resolution is None else options.resolution
    size: Resolution
    if loader is not None and isinstance(resolution, tuple):
        height, width = resolution
        size = loader.make_crop(height, width)
    else:
        size = parse_resolution(resolution)
    # Their code also keeps clips whose coordinates are large.
    max_translation = MAX_TRANSLATION if loader is None else None
    for path in options.paths:
        for clip in filter_usable(open_clips(path), skipped, max_translation):
            notes += clip.notes
            if options.ignore_moving and not clip.has_boxes:
                raise InputError(
                    f"{clip.name} has no boxes of moving objects; leave --ignore-moving out. Masks "
                    "are always read (--no-masks leaves them out)."
                )

            # The authors' code scores every pixel of their data sets.
            scores_all = loader is not None
            if scores_all or not options.ego_mask:
                clip = clip.keep_ego_vehicle()
            if scores_all or not options.masks:
                clip = clip.leave_out_masks()
            if options.ignore_moving:
                clip = clip.ignore_moving()

            near = clip.near if options.near is None else options.near
            far = clip.far if options.far is None else options.far
            check_planes(near, far)
            clip = replace(clip, near=near, far=far)

            for rule in rules:
                if isinstance(rule, protocols.FrameRule) and not rule.select_splits(clip):
                    reason = f"{rule.name} chooses none of its {len(clip)} frames"
                    skipped.append(SkippedScene(clip.name, reason))
                kept = rule if loader is None else loader.choose_splits(rule, clip, skipped)
                # The authors' loaders keep the order of the context; ours is ascending.
                keeps_order = loader is not None
                tasks = protocols.make_tasks(kept, clip, size, keeps_order)
                tasks = mark_masked(clip, tasks, notes)
                yield from tasks[:1] if options.one_per_scene else tasks


def find_loader(options: EvaluateOptions) -> AuthorsLoader | None:
    """Find the loader to follow; none without a preset, or at another size than the preset's."""
    preset = get_data_set(options.preset)
    return preset.loader if options.resolution == preset.resolution else None


def find_cases_file(path: Path) -> Path:
    """Find the cases.json that `path` is or contains."""
    file = path / "cases.json" if os.path.isdir(path) else path
    # A transforms.json is a scene, and so needs a protocol.
    if file.suffix != ".json" or not os.path.isfile(file) or file.name == "transforms.json":
        raise InputError(
            f"{quote_value(path)} is no cases.json; name one, or add --protocol for scenes, as in "
            "--protocol n-10."
        )
    return file


def print_skipped(skipped: Sequence[SkippedScene], console: Console) -> None:
    """Print the skipped clips with the reasons."""
    for clip in skipped:
        console.print(f"Skipped {clip.name}: {clip.reason}.")


def print_tables(summary: RunSummary, out: Path) -> None:
    """Print the tables, transposed: one column per method."""
    table = Table("", *summary.methods, box=None)
    cells = tables.format_score_cells(summary, summary.columns)
    for number, column in enumerate(summary.columns, start=1):
        table.add_row(column.title, *(row[number] for row in cells))

    # Seconds compare methods, so they are those of the cases that all of them completed.
    if summary.common_tasks:
        seconds = [summary.compute_seconds(method)["total"] for method in summary.methods]
        table.add_row("seconds", *(f"{total:.1f}" for total in seconds))
    console = Console(highlight=False)
    console.print(table)
    for case, method, reason in summary.failures:
        console.print(f"Failed: {case}, {method}: {reason}", markup=False)
    over = f"Over {len(summary.common_tasks)} of {len(summary.tasks)} cases"
    console.print(f"{over}: {out / 'tables.md'}", soft_wrap=True)
