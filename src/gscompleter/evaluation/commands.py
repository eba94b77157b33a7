"""The commands `evaluate`, `tables` and `index`."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import islice
from pathlib import Path

from rich.console import Console
from rich.table import Table

from gscompleter.errors import InputError
from gscompleter.evaluation.cases import Case, read_cases
from gscompleter.evaluation.clips import Skipped, usable
from gscompleter.evaluation.folders import open_clips
from gscompleter.evaluation.methods import check_methods
from gscompleter.evaluation.protocols import (
    ClipCase,
    SequenceCase,
    ViewByView,
    cases_of,
    index_of,
    parse_protocol,
    sequences_of,
    write_evaluation_index,
)
from gscompleter.evaluation.runs import RunConfig, evaluate
from gscompleter.evaluation.sequence_tables import overview, read_sequences, sequence_tables
from gscompleter.evaluation.sequences import evaluate_sequences
from gscompleter.evaluation.tables import COLUMNS, Summary, score_cells, tables
from gscompleter.io.framing import check_resolution
from gscompleter.options import EvaluateOptions, IndexOptions, TablesOptions
from gscompleter.progress import shown_on
from gscompleter.render import choose_device


def run_evaluation(options: EvaluateOptions) -> None:
    """Run the methods on the cases, write rows and tables, and say what was done.

    Raises:
        InputError: anything about the input that the user can mend.
    """
    console = Console(stderr=True, quiet=options.quiet)
    check_methods(options.methods)
    shard = parse_shard(options.shard)
    if options.limit is not None and options.limit < 1:
        raise InputError(f"--limit is {options.limit}, and at least one case is needed.")
    check_resolution(options.resolution)
    skipped: list[Skipped] = []
    cases = chosen_cases(options, skipped)
    for clip in skipped:
        console.print(f"Left out {clip.name}: {clip.reason}.", highlight=False)
    source = {
        "path": options.path.resolve().name,
        "protocol": options.protocol,
        "resolution": None if options.resolution is None else list(options.resolution),
    }
    config = RunConfig(
        options.reconstructor,
        options.generator,
        choose_device(options.device),
        options.seed,
        source=source,
    )
    sequences = [case for case in cases if isinstance(case, SequenceCase)]
    singles = [case for case in cases if not isinstance(case, SequenceCase)]
    with shown_on(None if options.quiet else console):
        if sequences:
            tally = evaluate_sequences(sequences, options.methods, options.out, config, shard)
        else:
            tally = evaluate(singles, options.methods, options.out, config, shard)
    console.print(
        f"Scored {tally.done}, failed {tally.failed}, there before {tally.skipped}.",
        highlight=False,
    )
    # An empty shard, where there are more shards than cases, has nothing to show.
    if sequences:
        tell_sequences(options.out, options.quiet)
    elif tally.done + tally.failed + tally.skipped > 0:
        summary = tables(options.out)
        if not options.quiet:
            tell(summary, options.out)


def run_tables(options: TablesOptions) -> None:
    """Write the tables of a run and print them.

    Raises:
        InputError: where there is no run.
    """
    summary = tables(options.out)
    if not options.quiet:
        tell(summary, options.out)


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
) -> list[Case] | list[ClipCase] | list[SequenceCase]:
    """The cases that the options ask for; clips that are left out go to `skipped`.

    Raises:
        InputError: where there are none to be found, or a protocol is needed or wrong.
    """
    if options.protocol is None:
        cases = read_cases(cases_file(options.path))[: options.limit]
        if options.resolution is None:
            return cases
        return [replace(case, resolution=options.resolution) for case in cases]
    protocol = parse_protocol(options.protocol)
    clips = usable(open_clips(options.path), skipped)
    if isinstance(protocol, ViewByView):
        sequences = sequences_of(protocol, clips, skipped, options.resolution)
        return list(islice(sequences, options.limit))
    found = (case for clip in clips for case in cases_of(protocol, clip, options.resolution))
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
    sequence_tables(out)
    summary = read_sequences(out)
    if summary is None or quiet:
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
    cells = score_cells(summary)
    for number, column in enumerate(COLUMNS, start=1):
        table.add_row(column.title, *(row[number] for row in cells))
    seconds = (summary.seconds[method][0] for method in summary.methods)
    table.add_row("seconds", *("–" if value is None else f"{value:.1f}" for value in seconds))
    console = Console()
    console.print(table)
    for case, method, reason in summary.failures:
        console.print(f"Failed: {case}, {method}: {reason}", highlight=False, markup=False)
    console.print(
        f"Over {len(summary.common)} of {summary.cases} cases: {out / 'tables.md'}",
        highlight=False,
        soft_wrap=True,
    )
