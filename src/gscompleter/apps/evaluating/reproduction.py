"""Scores of methods, and from them tables and figures of the paper."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gscompleter.apps.command_line.answers import print_json
from gscompleter.apps.command_line.exit_codes import choose_exit_code
from gscompleter.apps.commands.evaluate import AUTO, EvaluateOptions, PresetGeneratorOptions
from gscompleter.apps.evaluating.scoring import Scored, run_methods, score_methods
from gscompleter.evaluation.claims import HEAD, tabulate_claims
from gscompleter.evaluation.figures import draw_figure
from gscompleter.evaluation.methods import expand_methods
from gscompleter.evaluation.paper import (
    FigureSpec,
    Requirements,
    TableSpec,
    get_data_set,
    load_paper,
    select_names,
)
from gscompleter.evaluation.paper_tables import (
    fill_depth_table,
    fill_table,
    format_paper_markdown,
    write_paper_table,
)
from gscompleter.evaluation.protocols import list_indices
from gscompleter.evaluation.store import make_file_name
from gscompleter.evaluation.tables import format_markdown, write_tables
from gscompleter.render.device import choose_device
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError, NoCaseError, OutputError, quote_value
from gscompleter.system.files.writing import encode_text, replace_file
from gscompleter.system.jobs.jobs import make_folder
from gscompleter.system.machine import describe_machine

UNUSUAL = ("stress", "sequence")
"""Kinds of the protocols that only tables of their own use."""
TABLES = "tables"
"""Folder of the tables in OUT."""
FIGURES = "figures"
"""Folder of the figures in OUT."""
RUNS = "runs"
"""Folder in OUT with the scores of each run, as `evaluate` writes them."""
DEPTHS = "depths"
"""Name of the table that compares depths."""
DEPTH_COLUMNS = (
    *("psnr", "hole_psnr", "neighbours", "context_change"),
    *("depth_observed", "depth_hole", "depth_hole_median"),
)
"""Columns of that table."""
RESULTS = "results.md"
"""Page in OUT with all tables, claims and figures."""


def run_evaluation(options: EvaluateOptions) -> int:
    """Run the methods of the options, or those that tables and figures of the paper need.

    Return the exit code.
    """
    is_reproduction = bool(options.preset or options.table or options.figure)
    options = apply_preset(options)
    models = options.reconstructor
    if len(set(models)) < len(models):
        raise InputError("A reconstructor is named twice; change --reconstructor.")
    if not options.depth or len(set(options.depth)) < len(options.depth):
        raise InputError("A depth is named twice, or none is; change --depth.", "depth")
    weights = assign_weights(models, options.weights)
    depth_weights = assign_weights(options.depth, options.depth_weights, "depth", "depth-weights")
    if len(options.depth) > 1:
        if is_reproduction or len(models) > 1:
            raise InputError(
                "Several depths are compared with one reconstructor in a table of their own; leave "
                "--preset, --table and --figure out, and name one reconstructor.",
                "depth",
            )
        return compare_depths(replace(options, weights=tuple(weights.values())), depth_weights)
    options = replace(options, depth_weights=tuple(depth_weights.values()))
    if is_reproduction or len(models) > 1:
        return reproduce(options)
    return run_methods(replace(options, weights=tuple(weights.values())))


def compare_depths(options: EvaluateOptions, weights: Mapping[str, Path]) -> int:
    """Run the methods with each depth, and write one table of all; return the exit code."""
    console = make_console(stderr=True, quiet=options.quiet)
    methods = expand_methods(options.methods)
    runs = {}
    scored = []
    for depth in options.depth:
        console.print(f"depth {depth}")
        own = weights.get(depth)
        run = replace(
            options,
            out=options.out / RUNS / make_file_name(f"depth {depth}"),
            depth=(depth,),
            depth_weights=() if own is None else (own,),
        )
        scored.append(score_methods(run))
        write_tables(run.out)
        runs[depth] = run.out
    table = fill_depth_table(methods, DEPTH_COLUMNS, runs)
    make_folder(options.out / TABLES)
    write_paper_table(options.out / TABLES / DEPTHS, table)
    if not options.quiet:
        print(format_paper_markdown(table))
    failed = sum(len(run.failures) for run in scored)
    return choose_exit_code(failed, sum(run.num_own_rows for run in scored))


def assign_weights(
    models: Sequence[str],
    weights: Sequence[Path],
    kind: str = "reconstructor",
    option: str = "weights",
) -> dict[str, Path]:
    """Assign files of weights to models: one for each in their order, or by `NAME=FILE`.

    Those without a file take the published one. Raise InputError if a file has no model.
    """
    named: dict[str, Path] = {}
    plain: list[Path] = []
    for word in weights:
        # A path may contain `=`, too; only a known name before it makes it NAME=FILE.
        name, _, file = str(word).partition("=")
        if file and name in models:
            named[name] = Path(file)
        else:
            plain.append(word)
    if plain and (named or len(plain) != len(models)):
        raise InputError(
            f"{quote_value(plain[0])} belongs to no {kind}; give --{option} one file for "
            f"each of {', '.join(models)} in this order, or {models[0]}=FILE for some of them."
        )
    return named or dict(zip(models, plain, strict=False))


def apply_preset(options: EvaluateOptions) -> EvaluateOptions:
    """Set what is not given as the preset does, or as without one."""
    preset = get_data_set(options.preset)
    synthesis = options.synthesis
    if synthesis.generator == AUTO:
        synthesis = replace(synthesis, generator=preset.generator)
    return replace(
        options,
        resolution=preset.resolution if options.resolution is None else options.resolution,
        reconstructor=options.reconstructor or preset.reconstructor,
        near=preset.near if options.near is None else options.near,
        far=preset.far if options.far is None else options.far,
        synthesis=synthesis,
    )


def reproduce(options: EvaluateOptions) -> int:
    """Write the tables and figures of the options, and all results in OUT as one page.

    Return the exit code, which counts the cases of all tables and figures.
    """
    paper = load_paper()
    console = make_console(stderr=True, quiet=options.quiet)
    generator = options.synthesis.generator

    # A preset or several reconstructors alone stand for the table of models.
    names = options.table
    if not names and not options.figure:
        names = ("models",)
    tables = select_names(names, paper.tables, generator)
    figures = select_names(options.figure, paper.figures, generator)

    scored: list[Scored] = []
    for name, spec in [*tables.items(), *figures.items()]:
        console.print(f"{name}: {spec.title}")
        try:
            write_output(options, name, spec, scored)
        except InputError as error:
            # Of `all`, those are left out whose data or models are not here. One that is named has
            # to succeed.
            if "all" not in (*options.table, *options.figure):
                raise
            console.print(f"Left out {name}: {error}", soft_wrap=True)
    if not scored:
        raise InputError("None of the tables and figures could be begun; the lines above say why.")

    text = write_results(options)
    if options.json:
        print_json(collect_outputs(options.out))
    elif not options.quiet:
        make_console().print(text, soft_wrap=True)
    failed = sum(len(run.failures) for run in scored)
    return choose_exit_code(failed, sum(run.num_own_rows for run in scored))


def collect_outputs(out: Path) -> dict[str, Any]:
    """Collect the tables by name, with the paths of the page and of the figures."""
    tables = sorted((out / TABLES).glob("*.json"))
    return {
        "results": str(out / RESULTS),
        "tables": {path.stem: json.loads(path.read_bytes()) for path in tables},
        "figures": [str(path) for path in sorted((out / FIGURES).glob("*"))],
    }


def write_output(
    options: EvaluateOptions, name: str, spec: Requirements, scored: list[Scored]
) -> None:
    """Run what a table or figure needs, append the outcome to `scored`, and write it."""
    runs = run_all(options, spec, scored)
    try:
        write_from_runs(options, name, spec, runs)
    except OutputError:  # an InputError, too, which keeps its exit code
        raise
    except InputError as error:
        # The runs are written by now, so this is no refusal of the input.
        raise NoCaseError(str(error.args[0]), error.argument) from error


def write_from_runs(
    options: EvaluateOptions, name: str, spec: Requirements, runs: Mapping[tuple[str, str], Path]
) -> None:
    """Write a table or figure from the folders of its runs."""
    if isinstance(spec, TableSpec):
        table = fill_table(spec, runs)
        if not any(table.num_cases.values()):
            reason = (*table.notes, "no row is there")[0]
            raise InputError(f"No case of the table was completed. {reason}")
        make_folder(options.out / TABLES)
        write_paper_table(options.out / TABLES / name, table)
    if isinstance(spec, FigureSpec):
        # A figure compares models on one protocol.
        by_model = {model: folder for (model, _), folder in runs.items()}
        make_folder(options.out / FIGURES)
        draw_figure(
            options.out / FIGURES / name,
            spec,
            by_model,
            options.figure_cases,
            options.outlines,
            options.crops,
        )


def run_all(
    options: EvaluateOptions, spec: Requirements, scored: list[Scored]
) -> dict[tuple[str, str], Path]:
    """Run what a table or figure needs; return the folder of each model and protocol.

    The outcome of each run is appended to `scored`.
    """
    runs = {}
    for number, model in enumerate(options.reconstructor):
        for protocol in choose_protocols(options, spec):
            # Tables share runs: rows that an earlier one has scored are read, not computed again.
            run = make_run(options, spec, number, protocol)
            scored.append(score_methods(run))
            write_tables(run.out)
            runs[model, Path(protocol).stem] = run.out
    return runs


def choose_protocols(options: EvaluateOptions, spec: Requirements) -> tuple[str, ...]:
    """Choose the given protocols of the kind that a table needs, or else those of the paper.

    A file of cases, which needs no protocol, has an empty one.
    """
    kinds = {get_kind(name) for name in spec.protocol}
    if kinds:
        suitable = tuple(name for name in options.protocol if get_kind(name) in kinds)
        return suitable or spec.protocol

    # A table without a kind of its own takes a given protocol, or that of the data set.
    usual = [name for name in options.protocol if get_kind(name) not in UNUSUAL]
    return tuple(usual[:1]) or get_data_set(options.preset).protocol or ("",)


def get_kind(protocol: str) -> str:
    """Return the kind of a protocol: `n` of n-10 and of our index dl3dv-n-10, `stress`, ...."""
    parts = protocol.split("-")
    return parts[1] if protocol in list_indices() else parts[0]


def make_run(
    options: EvaluateOptions, spec: Requirements, number: int, protocol: str
) -> EvaluateOptions:
    """Return the options of a run of one model with one protocol, in a folder of its own."""
    # Settings belong to the generator that was chosen, so that of the table has its defaults.
    synthesis = options.synthesis
    if spec.generator and spec.generator != synthesis.generator:
        synthesis = PresetGeneratorOptions(spec.generator)
    one_per_scene = options.one_per_scene or spec.one_per_scene
    model = options.reconstructor[number]

    # The folder is named by all that differs between the runs of one reproduction.
    parts = [model, Path(protocol).stem or "cases", synthesis.generator]
    if one_per_scene:
        parts.append("one-per-scene")
    own = assign_weights(options.reconstructor, options.weights).get(model)
    return replace(
        options,
        out=options.out / RUNS / make_file_name(" ".join(parts)),
        reconstructor=(model,),
        weights=() if own is None else (own,),
        protocol=(protocol,) if protocol else (),
        methods=spec.list_methods(),
        synthesis=synthesis,
        one_per_scene=one_per_scene,
    )


def write_results(options: EvaluateOptions) -> str:
    """Write all tables, claims and figures in OUT as one page, and return its text."""
    out = options.out
    paper = load_paper()
    device = choose_device(options.renderer_device or options.device)
    machine = {**describe_machine(device), **find_commit()}
    facts = ", ".join(f"{key} {value}" for key, value in machine.items())
    parts = [f"# Results\n\n{facts}.\n"]

    # Tables and figures of earlier calls in the same folder are on the page, too.
    tables = [out / TABLES / f"{name}.md" for name in paper.tables]
    parts += [path.read_text("utf-8") for path in tables if path.is_file()]
    judged = format_markdown(HEAD, tabulate_claims(out / TABLES, paper.claims))
    parts.append(f"## Claims of the paper\n\n{judged}")
    for name, figure in paper.figures.items():
        if (out / FIGURES / f"{name}.png").is_file():
            parts.append(f"## {figure.title}\n\n![{figure.title}]({FIGURES}/{name}.png)\n")

    text = "\n".join(parts)
    with replace_file(out / RESULTS) as file:
        file.write(encode_text(text))
    return text


def find_commit() -> dict[str, str]:
    """Return the commit of this code, or nothing if it is not a git checkout."""
    # From src/gscompleter/apps/evaluating of a checkout; an installed package has no .git there.
    root = Path(__file__).parents[4]
    if not (root / ".git").exists() or shutil.which("git") is None:
        return {}
    git = ["git", "-C", str(root), "describe", "--always", "--dirty"]
    return {"commit": subprocess.run(git, capture_output=True, text=True).stdout.strip()}
