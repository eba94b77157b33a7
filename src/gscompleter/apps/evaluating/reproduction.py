"""Tables and figures of the paper, from scores of methods."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from gscompleter.apps.command_line.answers import print_json
from gscompleter.apps.evaluating.comparison import compare_runs
from gscompleter.apps.evaluating.scoring import (
    RUNS,
    TABLES,
    Scored,
    awaits_other_shards,
    choose_common_exit_code,
    run_methods,
    score_methods,
    write_run_tables,
)
from gscompleter.apps.requests.evaluation import (
    CasesRequest,
    ComparisonRequest,
    EvaluationRequest,
    ReproductionRequest,
)
from gscompleter.config.generators import GeneratorOptions
from gscompleter.evaluation.claims import CLAIM_COLUMNS, tabulate_claims
from gscompleter.evaluation.figures import draw_figure
from gscompleter.evaluation.measured_code import find_commit
from gscompleter.evaluation.paper import (
    FigureSpec,
    Requirements,
    TableSpec,
    get_data_set,
    load_paper,
    select_names,
)
from gscompleter.evaluation.paper_tables import (
    fill_table,
    write_paper_table,
)
from gscompleter.evaluation.protocols import FRAME_RULES, list_indices, parse_protocol
from gscompleter.evaluation.store import make_file_name, read_run_file
from gscompleter.evaluation.tables import format_markdown
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError, NoCaseError, OutputError, WorkerError
from gscompleter.system.files.text import encode_text
from gscompleter.system.files.writing import replace_file
from gscompleter.system.jobs.jobs import make_folder
from gscompleter.system.machine import describe_machine

SEPARATE_KINDS = ("stress", "sequence")
"""Kinds of the protocols that only tables of their own use."""
FIGURES = "figures"
"""Folder of the figures in OUT."""
RESULTS_PAGE = "results.md"
"""Page in OUT with all tables, claims and figures."""


def run_evaluation(request: EvaluationRequest | ComparisonRequest | ReproductionRequest) -> int:
    """Run the methods, or what tables and figures need; return the exit code."""
    if isinstance(request, ComparisonRequest):
        return compare_runs(request)
    if isinstance(request, ReproductionRequest):
        return reproduce(request)
    return run_methods(request)


def reproduce(request: ReproductionRequest) -> int:
    """Write the tables and figures that are asked for, and all results in OUT as one page.

    Return the exit code, which counts the cases of all tables and figures.
    """
    # A protocol that does not exist is of no kind: no table would take it, and so refuse it.
    for protocol in request.run.cases.protocol:
        parse_protocol(protocol)
    paper = load_paper()
    answer = request.run.answer
    console = make_console(stderr=True, quiet=answer.quiet)
    generator = request.run.models.generator

    # A preset or several reconstructors alone stand for the table of models.
    names = request.tables
    if not names and not request.figures:
        names = ("models",)
    tables = select_names(names, paper.tables, generator)
    figures = select_names(request.figures, paper.figures, generator)
    unused = find_unused_protocols(request.run.cases, [*tables.values(), *figures.values()])
    if unused:
        console.print(
            f"Not used: --protocol {' '.join(unused)}, which none of these tables and figures "
            "takes.",
            soft_wrap=True,
        )

    scored: list[Scored] = []
    reasons: list[str] = []
    for given, specs in ((names, tables), (request.figures, figures)):
        for name, spec in specs.items():
            console.print(f"{name}: {spec.title}")
            try:
                write_output(request, name, spec, scored)
            except (OutputError, WorkerError):  # InputErrors, too, that no other table would escape
                raise
            except InputError as error:
                # Of `all`, those are left out whose data or models are not here. One that is named
                # has to succeed.
                if name in given:
                    raise
                reasons.append(f"Left out {name}: {error}")
                console.print(reasons[-1], soft_wrap=True)
    if not scored:
        raise InputError(f"None of the tables and figures could be begun. {reasons[0]}")

    out = request.run.out
    text = write_results(out, request.run.models.device)
    if answer.json:
        print_json(collect_outputs(out))
    elif not answer.quiet:
        make_console().print(text, soft_wrap=True)
    return choose_common_exit_code(scored)


def collect_outputs(out: Path) -> dict[str, Any]:
    """Collect the tables by name, with the paths of the page and of the figures."""
    tables = sorted((out / TABLES).glob("*.json"))
    return {
        "results": str(out / RESULTS_PAGE),
        "tables": {path.stem: read_run_file(path) for path in tables},
        "figures": [str(path) for path in sorted((out / FIGURES).glob("*"))],
    }


def write_output(
    request: ReproductionRequest, name: str, spec: Requirements, scored: list[Scored]
) -> None:
    """Run what a table or figure needs, append the outcome to `scored`, and write it.

    Of several shards, the last one writes it.
    """
    runs = run_all(request, spec, scored)
    if awaits_other_shards(request.run, runs.values()):
        return
    try:
        write_from_runs(request, name, spec, runs)
    except OutputError:  # an InputError, too, which keeps its exit code
        raise
    except InputError as error:
        # The runs are written by now, so this is no refusal of the input.
        raise NoCaseError(str(error.args[0]), error.argument) from error


def write_from_runs(
    request: ReproductionRequest,
    name: str,
    spec: Requirements,
    runs: Mapping[tuple[str, str], Path],
) -> None:
    """Write a table or figure from the folders of its runs."""
    out = request.run.out
    if isinstance(spec, TableSpec):
        table = fill_table(spec, runs)
        if not any(table.num_cases.values()):
            reason = (*table.notes, "no row is there")[0]
            raise InputError(f"No case of the table was completed. {reason}")
        make_folder(out / TABLES)
        write_paper_table(out / TABLES / name, table)
        return
    assert isinstance(spec, FigureSpec), "what is no table is a figure"
    # It has one protocol (`choose_protocols`).
    by_model = {model: folder for (model, _), folder in runs.items()}
    make_folder(out / FIGURES)
    draw_figure(
        out / FIGURES / name,
        spec,
        by_model,
        request.figure_cases,
        request.has_outlines,
        request.has_crops,
    )


def run_all(
    request: ReproductionRequest, spec: Requirements, scored: list[Scored]
) -> dict[tuple[str, str], Path]:
    """Run what a table or figure needs; return the folder of each model and protocol.

    A protocol is named by its stem there, so that the path of an index is shown as its name. The
    outcome of each run is appended to `scored`.
    """
    runs = {}
    for model in request.weights:
        for protocol in choose_protocols(request.run.cases, spec):
            # Tables share runs: rows that an earlier one has scored are read, not computed again.
            run = make_run(request, spec, model, protocol)
            scored.append(score_methods(run))
            write_run_tables(run.out)
            runs[model, Path(protocol).stem] = run.out
    return runs


def choose_protocols(cases: CasesRequest, spec: Requirements) -> tuple[str, ...]:
    """Choose the given protocols of the kind that a table needs, or else those of the paper.

    A figure, which compares models on one protocol, takes the first of them. A file of cases, which
    needs no protocol, has an empty one.
    """
    kinds = {get_kind(name) for name in spec.protocol}
    if kinds:
        suitable = tuple(name for name in cases.protocol if get_kind(name) in kinds)
        chosen = suitable or spec.protocol
        return chosen[:1] if isinstance(spec, FigureSpec) else chosen

    # One without a kind of its own takes the first given protocol, or that of the data set.
    usual = [name for name in cases.protocol if get_kind(name) not in SEPARATE_KINDS]
    return tuple(usual[:1]) or get_data_set(cases.preset).protocol or ("",)


def find_unused_protocols(cases: CasesRequest, specs: Iterable[Requirements]) -> list[str]:
    """Find the given protocols that no table or figure takes."""
    taken = {name for spec in specs for name in choose_protocols(cases, spec)}
    return [name for name in cases.protocol if name not in taken]


def get_kind(protocol: str) -> str:
    """Return the kind of a protocol: what its name begins with, such as `n`, `stress`, `sequence`.

    In the names of our indices it comes second: `n` in dl3dv-n-10. An index of the user, which is
    given by its path, has the empty kind, whatever its file is called.
    """
    if protocol in list_indices():
        return protocol.split("-")[1]
    is_rule = any(re.fullmatch(pattern, protocol) for pattern in FRAME_RULES)
    return protocol.split("-")[0] if is_rule else ""


def make_run(
    request: ReproductionRequest, spec: Requirements, model: str, protocol: str
) -> EvaluationRequest:
    """Make the request for a run of one model with one protocol, in a folder of its own."""
    shared = request.run
    models = replace(shared.models, reconstructor=model, weights=request.weights[model])
    # Settings belong to the generator that was chosen, so that of the table has its defaults.
    if spec.generator and spec.generator != models.generator:
        settings = GeneratorOptions(spec.generator).make_settings()
        models = replace(models, generator=spec.generator, generator_settings=settings)
    one_per_scene = shared.cases.one_per_scene or spec.one_per_scene

    # The folder is named by all that differs between the runs of one reproduction.
    parts = [model, Path(protocol).stem or "cases", models.generator]
    if one_per_scene:
        parts.append("one-per-scene")
    return replace(
        shared,
        cases=replace(
            shared.cases, protocol=(protocol,) if protocol else (), one_per_scene=one_per_scene
        ),
        methods=spec.list_methods(),
        models=models,
        out=shared.out / RUNS / make_file_name(" ".join(parts)),
    )


def write_results(out: Path, device: str) -> str:
    """Write all tables, claims and figures in OUT as one page, and return its text."""
    paper = load_paper()
    facts = [f"{key} {value}" for key, value in describe_machine(device).items()]
    commit = find_commit()
    if commit is not None:
        facts.append(f"commit {commit}")
    parts = [f"# Results\n\n{', '.join(facts)}.\n"]

    # Tables and figures of earlier calls in the same folder are on the page, too.
    tables = [out / TABLES / f"{name}.md" for name in paper.tables]
    parts += [path.read_text("utf-8") for path in tables if path.is_file()]
    judged = format_markdown(CLAIM_COLUMNS, tabulate_claims(out / TABLES, paper.claims))
    parts.append(f"## Claims of the paper\n\n{judged}")
    for name, figure in paper.figures.items():
        if (out / FIGURES / f"{name}.png").is_file():
            parts.append(f"## {figure.title}\n\n![{figure.title}]({FIGURES}/{name}.png)\n")

    text = "\n".join(parts)
    with replace_file(out / RESULTS_PAGE) as file:
        file.write(encode_text(text))
    return text
