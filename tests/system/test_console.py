"""Lines and tables hold names of files as they are."""

from __future__ import annotations

import ast
import io
import json
import shutil
from collections.abc import Iterable
from pathlib import Path

import pytest
from rich.table import Table

from command import run
from gscompleter.apps.completing.printing import print_completion
from gscompleter.apps.requests.completion import ResultsRequest
from gscompleter.system.console import make_console
from paths import PACKAGE, TESTS
from scenes import camera_at, photographed
from sources import list_nodes, parse_package

ODD = "b].png [red][/b] :cat: [link=x]"
"""A name of which rich would leave out parts, colour others, draw one, and end with an error."""


PRINTERS = {"Console", "get_console", "print_json", "from_markup", "render_markup"}


def find_consoles(nodes: Iterable[ast.AST]) -> list[str]:
    """List what a file takes from rich that would print: names other than the type of a console."""
    found = []
    for node in nodes:
        if isinstance(node, ast.Call):
            function = node.func
            name = getattr(function, "attr", getattr(function, "id", ""))
            found += [ast.unparse(function)] * (name in PRINTERS)
        if isinstance(node, ast.ImportFrom) and node.module == "rich":
            found += [f"rich.{name.name}" for name in node.names if name.name == "print"]
        found += [
            f"{keyword.arg}={ast.unparse(keyword.value)}"
            for keyword in getattr(node, "keywords", ())
            if keyword.arg in ("markup", "emoji")
        ]
    return found


def test_there_is_no_other_console():
    """Each file prints with `make_console`, and none turns the markup on again."""
    allowed = {"system/console.py": ["markup=False", "emoji=False"]}
    for path in parse_package():
        name = path.relative_to(PACKAGE).as_posix()
        found = [one for one in find_consoles(list_nodes(path)) if one != "print_json"]
        assert found == allowed.get(name, []), name


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("Console(stderr=True)", "Console"),
        ("import rich.console\nrich.console.Console()", "rich.console.Console"),
        ("from rich import print", "rich.print"),
        ("console.print(name, markup=True)", "markup=True"),
    ],
)
def test_other_consoles_are_found(source, found):
    assert find_consoles(ast.walk(ast.parse(source))) == [found]


def test_lines_and_cells_hold_a_name_as_it_is():
    console = make_console(file=io.StringIO(), width=200)
    console.print(ODD)
    table = Table(ODD, box=None)
    table.add_row(ODD)
    console.print(table)
    assert [line.strip() for line in console.file.getvalue().splitlines()] == [ODD] * 3


def test_a_completion_names_its_folder_and_photographs_as_they_are(tmp_path, capsys, monkeypatch):
    """Results below a folder `[`, whose photographs have brackets in their names."""
    monkeypatch.setenv("COLUMNS", "300")
    out = Path(shutil.copytree(TESTS / "fixtures/results/before-formats", tmp_path / "[" / "o[x]"))
    summary = json.loads((out / "summary.json").read_text())
    for row in (*summary["context"], *summary["targets"]):
        row["file"] = "c [red] b].png"
    (out / "summary.json").write_text(json.dumps(summary))
    print_completion(ResultsRequest(out=out))
    said = capsys.readouterr().out
    assert "context 0 (c [red] b].png)" in said
    assert "(c [red] b].png)" in said.split("target 1: ")[1]
    assert f"Report: {out / 'report.html'}" in said


def test_a_narrow_terminal_breaks_cameras_and_no_numbers(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    out = Path(shutil.copytree(TESTS / "fixtures/results/before-formats", tmp_path / "out"))
    summary = json.loads((out / "summary.json").read_text())
    target = summary["targets"][0]
    target["derived_from"] = target["frame"]
    target["offset"] = "turned right by 15° and moved down by 1.6"
    target["added"] = 1_234_567
    (out / "summary.json").write_text(json.dumps(summary))
    print_completion(ResultsRequest(out=out))
    said = capsys.readouterr().out
    assert "…" not in said
    assert "1,234,567" in said
    assert f"{summary['context'][0]['psnr_before']:.2f}" in said


@pytest.mark.slow
def test_a_dry_run_names_its_folder_as_it_is(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    scene = photographed(tmp_path / "[", [camera_at(x, size=32) for x in (-0.2, 0.2, 0.6)])
    out = tmp_path / "o[x]"
    words = ("--context", 0, 1, "--target", 2, "--near", 0.5, "--far", 20, "--dry-run")
    assert run(monkeypatch, "complete", scene, *words, "--out", out) == 0
    assert f"Edit the cameras in {out / 'targets.json'}." in capsys.readouterr().out
