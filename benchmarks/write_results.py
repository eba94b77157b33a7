"""Write the figures of docs/reproduce.md and docs/results.md from the outputs of evaluations.

    python benchmarks/write_results.py [--reproduced OUT] [--development OUT] [--held-out OUT]
    python benchmarks/write_results.py --check
    python benchmarks/write_results.py --tables NAME OUT
    python benchmarks/write_results.py --measured NAME COMMIT

`make reproduce`, `make development` and `make held-out` make the three outputs. Tables and scores
are copied to docs/results with the commit that computed them. What stands between
`<!-- ours: ... -->` and `<!-- end -->` in the pages is written from there, beside the numbers of
the paper (paper_values.yaml). Nobody types a figure. With --check nothing is written; the exit code
is 1 if a page differs from the stored outputs.

A figure is true of the code that it was measured with. docs/results/measured.json has that commit
for each set of figures, with the digests of its method and of its golden scenes, and the sentence
above the figures says whether the method is still the same. So --check fails once after a change of
the method: run this script, and the page says it. It says that pictures are the same where the
golden scenes prove it (`make check-golden` lists the method in golden.json). --measured names the
commit of figures that a script of their own printed.

The comment names what is written:
    table NAME COLUMN ...    a table of the paper, a row for each method; FOLDER/NAME of --tables
    spans NAME COLUMN        a table with a row for each protocol
    claims                   the verdicts on the claims
    claims FOLDER            those that the tables of a folder can judge
    scores FILE COLUMN ...   means of `evaluate` of docs/results/FILE.json
    headline FILE ...        the three lines of the README, for each of these files
    measured NAME            the commit of a set of figures, and whether the method changed since
    alternatives KIND        the table of alternatives (alternatives.yaml), or what they do better
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from gscompleter.evaluation.claims import CLAIM_COLUMNS, tabulate_claims
from gscompleter.evaluation.columns import BY_KEY
from gscompleter.evaluation.measured_code import compute_method_digest
from gscompleter.evaluation.paper import load_paper
from gscompleter.evaluation.tables import format_markdown, format_score

DOCS = Path(__file__).resolve().parents[1] / "docs"
STORED = DOCS / "results"
MEASURED = STORED / "measured.json"
"""Commit and digests of each set of figures."""
GOLDEN = Path(__file__).with_name("golden.json")
PAGES = ("reproduce.md", "results.md", "generators.md", "alternatives.md", "../README.md")
ALTERNATIVES = {
    "in_place": "completes your .ply in place",
    "kept": "observed part kept bit for bit",
    "cuda": "needs CUDA",
    "time": "time for a scene",
    "licence": "licence",
}
"""Columns of the table of alternatives."""
REGION = re.compile(r"(<!-- ours: (?P<words>[^>]*?) -->\n)(?P<body>.*?)(<!-- end -->)", re.DOTALL)
NOT_MEASURED = "Not measured yet.\n"


def main() -> None:
    """Copy outputs and write the pages, as the command line asks."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--reproduced", type=Path, help="output of make reproduce")
    parser.add_argument("--development", type=Path, help="output of make development")
    parser.add_argument("--held-out", type=Path, help="output of make held-out")
    parser.add_argument("--check", action="store_true", help="only compare the pages")
    parser.add_argument("--tables", nargs=2, metavar=("NAME", "OUT"))
    parser.add_argument("--measured", nargs=2, metavar=("NAME", "COMMIT"))
    options = parser.parse_args()
    if options.measured is not None:
        note_measured(*options.measured)
    if options.tables is not None:
        copy_tables(*options.tables)
    if options.reproduced is not None:
        copy_reproduction(options.reproduced)
    if options.development is not None:
        copy_scores("development", options.development)
    if options.held_out is not None:
        copy_scores("held_out", options.held_out)
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


def copy_scores(name: str, out: Path) -> None:
    """Copy the scores of an evaluation, whose pages name them by `name`."""
    scores = STORED / f"{name}.json"
    shutil.copyfile(out / "tables.json", scores)
    note_measured(name, find_one_commit([scores]))


def copy_reproduction(out: Path) -> None:
    """Copy tables and results of a reproduction."""
    for path in sorted((out / "tables").glob("*.json")):
        shutil.copyfile(path, STORED / "tables" / path.name)
    # Figures show photographs, which may not be redistributed.
    text = (out / "results.md").read_text("utf-8")
    without_figures = re.sub(r"## [^\n]*\n+!\[[^\n]*\n*", "", text)
    (STORED / "results.md").write_text(without_figures.rstrip() + "\n", "utf-8")
    note_measured("reproduced", find_one_commit((STORED / "tables").glob("*.json")))


def copy_tables(name: str, out: str) -> None:
    """Copy the tables of an output beside those of a reproduction."""
    folder = STORED / "tables" / name
    folder.mkdir(exist_ok=True)
    for path in sorted(Path(out, "tables").glob("*.json")):
        shutil.copyfile(path, folder / path.name)
    note_measured(name, find_one_commit(folder.glob("*.json")))


def find_one_commit(paths: Iterable[Path]) -> str:
    """Find the commit that computed all rows of some tables; exit where it is none or several."""
    facts = [json.loads(path.read_text("utf-8"))["made_with"] for path in paths]
    # A table of the paper has the facts of each of its runs.
    runs = [run for of in facts for run in ([of] if "commits" in of else of.values())]
    commits = {commit for run in runs for commit in run["commits"]}
    if len(commits) != 1 or (commit := commits.pop()).endswith("-dirty"):
        sys.exit(
            f"The rows are of {sorted(commits) or 'no commit'}; evaluate one committed state of "
            "the code in an empty folder."
        )
    return commit


def note_measured(name: str, commit: str) -> None:
    """Note the commit of a set of figures, with the digests of its method and golden scenes."""
    with tempfile.TemporaryDirectory() as folder:
        archive = run_git("archive", commit, "src/gscompleter")
        subprocess.run(["tar", "-x", "-C", folder], input=archive, check=True)
        method = compute_method_digest(Path(folder, "src", "gscompleter"))
    # The oldest commits have no golden scenes.
    path = GOLDEN.relative_to(DOCS.parent).as_posix()
    has_golden = bool(run_git("ls-tree", commit, path))
    golden = json.loads(run_git("show", f"{commit}:{path}")) if has_golden else {}
    known = json.loads(MEASURED.read_text("utf-8")) if MEASURED.is_file() else {}
    known[name] = {
        "commit": run_git("rev-parse", "--short=8", commit).decode().strip(),
        "date": run_git("show", "-s", "--format=%cs", commit).decode().strip(),
        "method": method,
        "golden": compute_golden_digest(golden),
    }
    MEASURED.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n", "utf-8")


def run_git(*words: str) -> bytes:
    """Run git in this checkout and return its output."""
    return subprocess.run(
        ["git", "-C", str(DOCS.parent), *words], capture_output=True, check=True
    ).stdout


def compute_golden_digest(golden: Mapping[str, Any]) -> str:
    """Compute the digest of the pictures and scores of golden scenes."""
    scenes = {name: golden.get(name) for name in ("room", "scenes")}
    return hashlib.sha256(json.dumps(scenes, sort_keys=True).encode()).hexdigest()[:16]


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
    known: dict[str, dict[str, str]] = paper.get(Path(name).name, {})
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


def write_claims(folder: str = "") -> str:
    """Write the verdicts on the claims of the paper: all, or those that a folder has tables of."""
    tables = STORED / "tables" / folder
    claims = load_paper().claims
    if folder:
        claims = [claim for claim in claims if (tables / f"{claim.table}.json").is_file()]
    return format_markdown(CLAIM_COLUMNS, tabulate_claims(tables, claims))


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


def write_measured(name: str) -> str:
    """Write the commit of a set of figures, and whether the method is still the same."""
    of = json.loads(MEASURED.read_text("utf-8"))[name]
    return f"Measured at commit `{of['commit']}` ({of['date']}); {describe_change(of)}.\n"


def describe_change(measured: Mapping[str, str]) -> str:
    """Describe what the method did since a measurement."""
    golden = json.loads(GOLDEN.read_text("utf-8"))
    now = compute_current_digest()
    if measured["method"] == now:
        return "the method is the same since"
    proven = golden.get("methods", [])
    is_golden = compute_golden_digest(golden) == measured["golden"]
    if is_golden and measured["method"] in proven and now in proven:
        return "the method gives the same pictures since"
    return "the method changed since" if is_golden else "the pictures changed since"


@cache
def compute_current_digest() -> str:
    """Compute the digest of the method of this checkout, once for all pages."""
    return compute_method_digest(DOCS.parent / "src" / "gscompleter")


def write_alternatives(kind: str) -> str:
    """Write the table of alternatives: all columns, or what each of the others does better."""
    rows = yaml.safe_load(Path(__file__).with_name("alternatives.yaml").read_text("utf-8"))
    if kind == "better":
        others = [row for row in rows if "better" in row]
        cells = [[link_name(row), row["better"]] for row in others]
        return format_text_table(["", "what it does better"], cells)
    seconds = {
        row["method"]: f"{row['cells']['seconds']['value']:.0f}"
        for row in read_table("paradigms")["rows"]
    }
    # Its row comes with the next reproduction; until then nothing else was timed beside it.
    seconds.setdefault("distill", "not measured with the others")
    head = ["", *ALTERNATIVES.values()]
    cells = [
        [link_name(row), *(row[key].format_map(seconds) for key in ALTERNATIVES)] for row in rows
    ]
    return format_text_table(head, cells)


def link_name(row: Mapping[str, str]) -> str:
    """Link the name of a row to the page of its authors, if one is given."""
    return f"[{row['name']}]({row['address']})" if "address" in row else row["name"]


def format_text_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table of words."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


WRITERS = {
    "table": write_table,
    "spans": write_spans,
    "claims": write_claims,
    "scores": write_scores,
    "headline": write_headline,
    "measured": write_measured,
    "alternatives": write_alternatives,
}
"""Writers of a region, by the first word of its comment."""

if __name__ == "__main__":
    main()
