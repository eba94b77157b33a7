"""The commands `evaluate`, `tables` and `index`."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from gscompleter.commands.options import EvaluateOptions, IndexOptions, TablesOptions
from gscompleter.data.cases import read_cases
from gscompleter.data.datasets import Skipped, open_clips, usable
from gscompleter.data.framing import check_resolution
from gscompleter.errors import InputError
from gscompleter.progress import shown_on
from gscompleter.render import choose_device
from gscompleter.reports.plots import PlotsNotAvailable, plot_sequences, plots
from gscompleter.reports.sequence_tables import overview, sequence_tables
from gscompleter.reports.tables import (
    COLUMNS,
    Summary,
    present,
    score_cells,
    seconds_of,
    tables,
)
from gscompleter.runs.methods import methods_named
from gscompleter.runs.protocols import (
    SequenceCase,
    ViewByView,
    cases_of,
    index_of,
    parse_protocol,
    sequences_of,
    write_evaluation_index,
)
from gscompleter.runs.runner import EvaluationCase, RunConfig, evaluate
from gscompleter.runs.sequences import evaluate_sequences
from gscompleter.runs.store import CASES, SEQUENCES


def run_evaluation(options: EvaluateOptions) -> None:
    """Run the methods on the cases, write rows, tables and plots, and say what was done.

    Raises:
        InputError: anything about the input that the user can mend.
    """
    if not options.paths:
        raise InputError("No data was named; give a cases.json, or scenes with --protocol.")
    console = Console(stderr=True, quiet=options.quiet)
    methods = methods_named(options.methods)
    shard = parse_shard(options.shard)
    check_resolution(options.resolution)
    skipped: list[Skipped] = []
    cases = chosen_cases(options, skipped)
    for clip in skipped:
        console.print(f"Left out {clip.name}: {clip.reason}.", highlight=False)
    config = RunConfig(
        reconstructor=options.reconstructor,
        weights=None if options.weights is None else str(options.weights),
        generator=options.synthesis.name,
        generator_settings=options.synthesis.settings(),
        device=choose_device(options.device),
        seed=options.seed,
        source=source_of(options),
    )
    sequences = [case for case in cases if isinstance(case, SequenceCase)]
    singles = [case for case in cases if not isinstance(case, SequenceCase)]
    with shown_on(None if options.quiet else console):
        tallies = []
        if singles or not sequences:
            tallies.append(evaluate(singles, methods, options.out, config, shard, options.again))
        if sequences:
            tallies.append(
                evaluate_sequences(sequences, methods, options.out, config, shard, options.again)
            )
    done, failed, before = (
        sum(getattr(tally, count) for tally in tallies) for count in ("done", "failed", "skipped")
    )
    console.print(
        f"Scored {done}, failed {failed}, there before {before}.",
        highlight=False,
    )
    # An empty shard, where there are more shards than cases, has nothing to show.
    if done + failed + before > 0:
        show(options.out, options.quiet)


def source_of(options: EvaluateOptions) -> dict[str, Any]:
    """Where the cases come from, as a folder of results remembers it."""
    return {
        "paths": [path.resolve().name for path in options.paths],
        "protocols": list(options.protocol),
        "resolution": None if options.resolution is None else list(options.resolution),
    }


def run_tables(options: TablesOptions) -> None:
    """Write the tables and plots of a run and print them.

    Raises:
        InputError: where there is no run.
    """
    show(options.out, options.quiet, options.fid)


def show(out: Path, quiet: bool, with_fid: bool = False) -> None:
    """Write the tables and plots of a run, and print the former unless `quiet`.

    Raises:
        InputError: where there is no run.
    """
    if (out / SEQUENCES).is_dir():
        tell_sequences(out, quiet)
        if not (out / CASES).is_dir():
            return
    summary = tables(out, with_fid)
    draw(quiet, lambda: plots(summary, out))
    if not quiet:
        tell(summary, out)


def draw(quiet: bool, drawing: Callable[[], object]) -> None:
    """Do `drawing`, or say what it needs."""
    try:
        drawing()
    except PlotsNotAvailable as missing:
        if not quiet:
            Console(stderr=True).print(str(missing), highlight=False, markup=False)


def run_index(options: IndexOptions) -> None:
    """Write the evaluation index of a protocol on a data set.

    Raises:
        InputError: anything about the input that the user can mend.
    """
    if options.out.exists() and not options.overwrite:
        raise InputError(f"{options.out} exists; name another file, or use --overwrite.")
    skipped: list[Skipped] = []
    protocol = parse_protocol(options.protocol)
    if isinstance(protocol, ViewByView):
        raise InputError(
            f"{protocol.name} has no index, as its targets are not apart from each other; give it "
            "to `evaluate` itself."
        )
    index = index_of(protocol, usable(open_clips(options.path), skipped))
    index = replace(index, skipped=(*index.skipped, *(clip.name for clip in skipped)))
    write_evaluation_index(options.out, index)
    if options.quiet:
        return
    console = Console()
    for clip in skipped:
        console.print(f"Left out {clip.name}: {clip.reason}.", highlight=False)
    targets = sum(len(split.targets) for splits in index.scenes.values() for split in splits)
    console.print(
        f"{targets} cases in {len(index.scenes)} scenes, {len(index.skipped)} scenes skipped: "
        f"{options.out}",
        highlight=False,
        soft_wrap=True,
    )


def chosen_cases(
    options: EvaluateOptions, skipped: list[Skipped]
) -> Sequence[EvaluationCase | SequenceCase]:
    """The cases that the options ask for; clips that are left out go to `skipped`.

    Raises:
        InputError: where there are none to be found, or a protocol is needed or wrong.
    """
    if not options.protocol:
        files = [cases_file(path) for path in options.paths]
        cases = [case for file in files for case in read_cases(file)][: options.limit]
        if options.resolution is None:
            return cases
        return [replace(case, resolution=options.resolution) for case in cases]
    protocols = [parse_protocol(text) for text in options.protocol]
    clips = (clip for path in options.paths for clip in usable(open_clips(path), skipped))
    found = (
        case
        for clip in clips
        for protocol in protocols
        for case in (
            sequences_of(protocol, [clip], skipped, options.resolution)
            if isinstance(protocol, ViewByView)
            else cases_of(protocol, clip, options.resolution)
        )
    )
    return list(islice(found, options.limit))


def cases_file(path: Path) -> Path:
    """The cases.json that `path` is or holds.

    Raises:
        InputError: where it is and holds none.
    """
    file = path / "cases.json" if path.is_dir() else path
    if not file.exists() and not path.exists():
        raise InputError(f"There is no {path}; name a cases.json, or scenes with --protocol.")
    if file.suffix != ".json" or not file.exists() or file.name in ("transforms.json",):
        raise InputError(
            f"{path} says not which frames are given and which are the target; add --protocol, as "
            "in --protocol n-10."
        )
    return file


def parse_shard(text: str | None) -> tuple[int, int]:
    """`i/n` as numbers.

    Raises:
        InputError: where it is not of that form.
    """
    if text is None:
        return 0, 1
    match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if match is None:
        raise InputError(f"--shard is {text!r}; give it as i/n, as in 0/4 for the first of four.")
    return int(match[1]), int(match[2])


def tell_sequences(out: Path, quiet: bool) -> None:
    """Write the tables of sequences, and print their overview unless `quiet`.

    Raises:
        InputError: where a row is damaged, or a file cannot be written.
    """
    summary = sequence_tables(out)
    if summary is None:
        return
    draw(quiet, lambda: plot_sequences(summary, out))
    if quiet:
        return
    console = Console()
    console.print(overview(summary), highlight=False, markup=False, soft_wrap=True)
    for name, method, steps, reason in summary.failures:
        text = f"Failed: {name}, {method}, after {steps} steps: {reason}"
        console.print(text, highlight=False, markup=False, soft_wrap=True)
    console.print(f"Each step: {out / 'sequences.md'}", highlight=False, soft_wrap=True)


def tell(summary: Summary, out: Path) -> None:
    """Print the tables, turned on their side: a column per method."""
    table = Table("", *summary.methods, box=None)
    columns = present(summary, COLUMNS)
    cells = score_cells(summary, columns)
    for number, column in enumerate(columns, start=1):
        table.add_row(column.title, *(row[number] for row in cells))
    seconds = seconds_of(summary)
    table.add_row("seconds", *(f"{seconds[m]['total']:.1f}" for m in summary.methods))
    console = Console()
    console.print(table)
    for case, method, reason in summary.failures:
        console.print(f"Failed: {case}, {method}: {reason}", highlight=False, markup=False)
    console.print(
        f"Over {len(summary.common)} of {summary.cases} cases: {out / 'tables.md'}",
        highlight=False,
        soft_wrap=True,
    )
