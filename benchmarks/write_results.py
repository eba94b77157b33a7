"""Write the figures of docs/reproduce.md and docs/results.md from the outputs of evaluations.

    python benchmarks/write_results.py [--reproduced OUT] [--held-out OUT] [--check]

`make reproduce` and `make held-out` make the two outputs. Tables and scores are copied to
docs/results, and what stands between `<!-- ours: ... -->` and `<!-- end -->` in the pages is
written from there, beside the numbers of the paper (paper_values.yaml). Nobody types a figure. With
--check nothing is written; the exit code is 1 if a page differs from the stored outputs.

The comment names what is written:
    table NAME COLUMN ...    a table of the paper, a row for each method
    spans NAME COLUMN        a table with a row for each protocol
    claims                   the verdicts on the claims
    scores FILE COLUMN ...   means of `evaluate` of docs/results/FILE.json
    headline FILE ...        the three lines of the README, for each of these files
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import yaml

from gscompleter.evaluation.claims import HEAD, tabulate_claims
from gscompleter.evaluation.columns import BY_KEY
from gscompleter.evaluation.paper import load_paper
from gscompleter.evaluation.tables import format_markdown, format_score

DOCS = Path(__file__).resolve().parents[1] / "docs"
STORED = DOCS / "results"
PAGES = ("reproduce.md", "results.md", "../README.md")
DEVELOPMENT = "plane-sweep-cases-warp-inpaint"
"""Start of the name of the run with the table of all development cases."""
REGION = re.compile(r"(<!-- ours: (?P<words>[^>]*?) -->\n)(?P<body>.*?)(<!-- end -->)", re.DOTALL)
NOT_MEASURED = "Not measured yet.\n"


def main() -> None:
    """Copy outputs and write the pages, as the command line asks."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--reproduced", type=Path, help="output of make reproduce")
    parser.add_argument("--held-out", type=Path, help="output of make held-out")
    parser.add_argument("--check", action="store_true", help="only compare the pages")
    options = parser.parse_args()
    if options.reproduced is not None:
        copy_reproduction(options.reproduced)
    if options.held_out is not None:
        shutil.copyfile(options.held_out / "tables.json", STORED / "held_out.json")
    stale = []
    for name in PAGES:
        page = DOCS / name
        text = page.read_text("utf-8")
        if (new := fill_page(text)) == text:
            continue
        stale.append(page.resolve().name)
        if not options.check:
            page.write_text(new, "utf-8")
    if stale:
        print(f"{'Stale' if options.check else 'Written'}: {', '.join(stale)}")
    sys.exit(1 if stale and options.check else 0)


def copy_reproduction(out: Path) -> None:
    """Copy tables and results of a reproduction, and the scores of all cases."""
    for path in sorted((out / "tables").glob("*.json")):
        shutil.copyfile(path, STORED / "tables" / path.name)
    # Figures show photographs, which may not be redistributed.
    text = (out / "results.md").read_text("utf-8")
    without_figures = re.sub(r"## [^\n]*\n+!\[[^\n]*\n*", "", text)
    (STORED / "results.md").write_text(without_figures.rstrip() + "\n", "utf-8")
    (scores,) = (out / "runs").glob(f"{DEVELOPMENT}/tables.json")
    shutil.copyfile(scores, STORED / "development.json")


def fill_page(text: str) -> str:
    """Return a page with all of its regions written anew."""

    def fill(found: re.Match[str]) -> str:
        kind, *words = found["words"].split()
        if (
            kind in ("scores", "headline")
            and read_scores(words[0]) is None
            and found["body"].strip()
        ):
            return found[0]  # what stands there is of an evaluation whose output is not stored
        return f"{found[1]}\n{WRITERS[kind](*words).rstrip()}\n\n{found[4]}"

    return REGION.sub(fill, text)


def read_table(name: str) -> dict[str, Any]:
    """Read a stored table of the paper."""
    content: dict[str, Any] = json.loads((STORED / "tables" / f"{name}.json").read_text("utf-8"))
    return content


def format_cell(cell: dict[str, Any] | None, key: str) -> str:
    """Format a value with its standard error; a dash if there is none."""
    digits = BY_KEY[key].digits
    if cell is None or cell["value"] is None:
        return "–"
    error = "" if cell["error"] is None else f" ± {cell['error']:.{digits}f}"
    return f"{cell['value']:.{digits}f}{error}"


def count_cases(table: dict[str, Any]) -> str:
    """Say how many cases a table is of."""
    kind = "sequences" if "Long sequences" in table["title"] else "cases"
    return f"\nOurs: {', '.join(str(count) for count in table['cases'].values())} {kind}.\n"


def write_table(name: str, *columns: str) -> str:
    """Write a table with the paper's numbers before ours."""
    table = read_table(name)
    paper = yaml.safe_load(Path(__file__).with_name("paper_values.yaml").read_text("utf-8"))
    known: dict[str, dict[str, str]] = paper.get(name, {})
    shared = [key for key in columns if any(key in values for values in known.values())]
    head = ["method", *(f"{BY_KEY[key].title}, paper" for key in shared)]
    ending = ", ours" if known else ""
    head += [f"{BY_KEY[key].title}{ending}" for key in columns]
    rows = []
    for row in table["rows"]:
        of = known.get(row["method"], {})
        ours = [format_cell(row["cells"].get(key), key) for key in columns]
        rows.append([f"`{row['method']}`", *(of.get(key, "–") for key in shared), *ours])
    return format_markdown(head, rows) + count_cases(table)


def write_spans(name: str, key: str) -> str:
    """Write a row for each protocol: both methods, the difference, and the number of cases."""
    table = read_table(name)
    head = [
        "protocol",
        *dict.fromkeys(f"`{row['method']}`, ours" for row in table["rows"]),
        "cases",
    ]
    rows: dict[str, list[str]] = {}
    for row in table["rows"]:
        cell = row["cells"][key]
        text = format_cell(cell, key)
        if cell["difference"] is not None:
            text += f" ({cell['difference']['mean']:+.{BY_KEY[key].digits}f})"
        rows.setdefault(row["protocol"], []).append(text)
    counts = {name.split(", ")[-1]: str(count) for name, count in table["cases"].items()}
    return format_markdown(head, [[f"`{p}`", *of, counts[p]] for p, of in rows.items()])


def write_claims() -> str:
    """Write the verdicts on all claims of the paper."""
    return format_markdown(HEAD, tabulate_claims(STORED / "tables", load_paper().claims))


def write_scores(file: str, *columns: str) -> str:
    """Write the scores of an evaluation, a row for each method."""
    content = read_scores(file)
    if content is None:
        return NOT_MEASURED
    num_cases = len(content["common"])

    def format_score_cell(cell: dict[str, Any], key: str) -> str:
        text = format_score(cell["value"], BY_KEY[key].digits)
        return text if cell["cases"] in (0, num_cases) else f"{text} ({cell['cases']})"

    rows = [
        [method, *(format_score_cell(scores[key], key) for key in columns)]
        for method, scores in content["methods"].items()
    ]
    return format_markdown(["method", *(BY_KEY[key].title for key in columns)], rows)


def write_headline(*files: str) -> str:
    """Write the lines of the README: target, photographs beside it, worst given photograph."""
    lines = {
        "psnr": "held-back photograph (target)",
        "neighbours": "photographs beside it",
        "context_change": "worst change of a given photograph",
    }
    methods = {"context": "before", "full": "gscompleter", "paper": "paper's settings"}
    rows = []
    for file in files:
        content = read_scores(file)
        if content is None:
            rows.append([f"{name_scores(file)}: not measured yet", *["–"] * len(methods)])
            continue
        name = f"{name_scores(file)}, {len(content['common'])} cases"
        for key, says in lines.items():
            of = [content["methods"][method][key]["value"] for method in methods]
            texts = [format_score(value, BY_KEY[key].digits) for value in of]
            rows.append([f"{name}: {says}", *(["–", *texts[1:]] if "change" in key else texts)])
    return format_markdown(["", *methods.values()], rows)


def name_scores(file: str) -> str:
    """Return the name of a set of cases in a sentence."""
    return file.replace("_", "-")


def read_scores(file: str) -> dict[str, Any] | None:
    """Read the stored scores of an evaluation; None if it was not run yet."""
    path = STORED / f"{file}.json"
    if not path.is_file():
        return None
    content: dict[str, Any] = json.loads(path.read_text("utf-8"))
    return content


WRITERS = {
    "table": write_table,
    "spans": write_spans,
    "claims": write_claims,
    "scores": write_scores,
    "headline": write_headline,
}
"""Writers of a region, by the first word of its comment."""

if __name__ == "__main__":
    main()
