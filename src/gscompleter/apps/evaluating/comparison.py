"""Models of one kind, compared in one table."""

from __future__ import annotations

from dataclasses import replace

from gscompleter.apps.command_line.answers import print_json
from gscompleter.apps.evaluating.scoring import (
    RUNS,
    TABLES,
    awaits_other_shards,
    choose_common_exit_code,
    score_methods,
    write_run_tables,
)
from gscompleter.apps.requests.evaluation import ComparisonRequest
from gscompleter.evaluation.methods import expand_methods
from gscompleter.evaluation.paper_tables import (
    fill_comparison,
    format_paper_markdown,
    write_paper_table,
)
from gscompleter.evaluation.store import make_file_name, read_run_file
from gscompleter.system.console import make_console
from gscompleter.system.jobs.jobs import make_folder

COMMON_COLUMNS = ("psnr", "hole_psnr", "neighbours", "context_change")
"""Columns of every table that compares models."""
COMPARED_COLUMNS = {
    "depth": (*COMMON_COLUMNS, "depth_observed", "depth_hole", "depth_hole_median"),
    "generator": (*COMMON_COLUMNS, "st_lpips", "hole_flip", "hole_haarpsi", "hole_gradients"),
}
"""Columns of the table that compares models of a kind."""
COMPARED_TITLES = {"depth": "depth", "generator": "Φ"}
"""Title of the column that names them."""


def compare_runs(request: ComparisonRequest) -> int:
    """Run the methods with each model of a kind, and write one table; return the exit code."""
    shared = request.run
    kind = request.kind
    console = make_console(stderr=True, quiet=shared.answer.quiet)
    folders = {}
    scored = []
    for name, models in request.models.items():
        console.print(f"{kind} {name}")
        folder = shared.out / RUNS / make_file_name(f"{kind} {name}")
        scored.append(score_methods(replace(shared, models=models, out=folder)))
        write_run_tables(folder)
        folders[name] = folder

    tables = {}
    text = ""
    if not awaits_other_shards(shared, folders.values()):
        methods = expand_methods(shared.methods)
        title = f"{kind.title()}s compared"
        columns = COMPARED_COLUMNS[kind]
        table = fill_comparison(title, COMPARED_TITLES[kind], methods, columns, folders)
        make_folder(shared.out / TABLES)
        stem = f"{kind}s"
        write_paper_table(shared.out / TABLES / stem, table)
        tables[stem] = read_run_file(shared.out / TABLES / f"{stem}.json")
        text = format_paper_markdown(table)
    if shared.answer.json:
        # The keys of a reproduction of the paper, which alone has a page and figures.
        print_json({"results": None, "tables": tables, "figures": []})
    elif not shared.answer.quiet and text:
        print(text)
    return choose_common_exit_code(scored)
