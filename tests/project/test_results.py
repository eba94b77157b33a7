"""Figures of the documentation are those of stored outputs, and held-out cases are held out."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import write_results
from gscompleter.evaluation.cases import read_cases
from gscompleter.evaluation.measured_code import compute_method_digest
from paths import ROOT

BENCHMARKS = ROOT / "benchmarks"


def test_pages_hold_the_figures_of_the_stored_outputs(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["write_results.py", "--check"])
    with pytest.raises(SystemExit) as stop:
        write_results.main()
    assert stop.value.code == 0, capsys.readouterr().out


@pytest.fixture
def cases(monkeypatch: pytest.MonkeyPatch) -> list:
    monkeypatch.setenv("GSCOMPLETER_DATA", "/photographs")
    return read_cases(BENCHMARKS / "held_out.json")


def test_held_out_cases_are_in_the_folder_that_the_environment_names(cases):
    assert {case.scene.parent for case in cases} == {Path("/photographs/data")}
    assert len({case.name for case in cases}) == len(cases) == 16


def test_no_two_held_out_cases_of_a_scene_share_a_frame(cases):
    for scene in {case.scene for case in cases}:
        frames = [
            frame
            for case in cases
            if case.scene == scene
            for frame in (*case.context, case.target, *case.neighbours)
        ]
        assert len(set(frames)) == len(frames)


def test_no_frame_of_a_held_out_case_is_in_a_development_case(shared, cases):
    developed = read_cases(shared / "data" / "cases.json")
    seen = {
        (case.scene.name, frame)
        for case in developed
        for frame in (*case.context, case.target, *case.neighbours)
    }
    for case in cases:
        for frame in (*case.context, case.target, *case.neighbours):
            assert (case.scene.name, frame) not in seen


def test_all_held_out_cases_are_kept_apart(cases):
    assert all(case.apart_by for case in cases)


@pytest.mark.parametrize("name", ["choose_apart.py", "choose_held_out.py", "choose_many.py"])
def test_the_rules_give_the_cases_that_stand_there(name, shared, tmp_path):
    """The scripts write beside themselves; copies of them give the same files."""
    for script in BENCHMARKS.glob("choose_*.py"):
        (tmp_path / script.name).write_bytes(script.read_bytes())
    environment = {**os.environ, "GSCOMPLETER_DATA": str(shared)}
    command = [sys.executable, str(tmp_path / name)]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    written = sorted(tmp_path.rglob("*.json"))
    assert written
    for path in written:
        assert path.read_bytes() == (BENCHMARKS / path.relative_to(tmp_path)).read_bytes()


def write_package(folder: Path, source: str) -> Path:
    """Write a package with one file of the method and one of the applications."""
    for name in ("stages", "apps"):
        (folder / name).mkdir(parents=True)
        (folder / name / "step.py").write_text(source if name == "stages" else "x = 1\n")
    return folder


def test_comments_and_docstrings_age_no_figure_but_a_constant_does(tmp_path):
    first = write_package(tmp_path / "first", 'STEPS = 3\n"""Steps."""\n')
    same = write_package(tmp_path / "same", '# Fewer fail.\nSTEPS = 3  # of Adam\n"""More."""\n')
    (same / "apps" / "step.py").write_text("x = 2\n")
    other = write_package(tmp_path / "other", "STEPS = 4\n")
    digest = compute_method_digest(first)
    assert compute_method_digest(same) == digest
    assert compute_method_digest(other) != digest
    (same / "stages" / "step.py").rename(same / "stages" / "renamed.py")
    assert compute_method_digest(same) != digest


def test_a_figure_says_what_happened_to_its_method(monkeypatch, tmp_path):
    golden = {"room": {"a": 1}, "scenes": {"b": 2}, "methods": ["then", "now"]}
    monkeypatch.setattr(write_results, "GOLDEN", tmp_path / "golden.json")
    monkeypatch.setattr(write_results, "compute_current_digest", lambda: "now")
    pictures = write_results.compute_golden_digest(golden)

    def describe(method: str, of: str = pictures) -> str:
        (tmp_path / "golden.json").write_text(json.dumps(golden))
        return write_results.describe_change({"method": method, "golden": of})

    assert describe("now") == "the method is the same since"
    assert describe("then") == "the method gives the same pictures since"
    assert describe("another") == "the method changed since"
    assert describe("then", "other pictures") == "the pictures changed since"
    golden["methods"] = ["then"]  # nobody checked the method of now
    assert describe("then") == "the method changed since"


def test_a_page_is_stale_once_the_method_changed(monkeypatch):
    """The check fails until the page says so: once for each measurement."""
    filled = write_results.fill_page("<!-- ours: measured held_out -->\n<!-- end -->")
    measured = json.loads(write_results.MEASURED.read_text())["held_out"]
    assert f"Measured at commit `{measured['commit']}`" in filled
    assert write_results.fill_page(filled) == filled
    monkeypatch.setattr(write_results, "compute_current_digest", lambda: measured["method"])
    assert write_results.fill_page(filled) != filled


@pytest.mark.parametrize(
    ("commits", "said"),
    [([["a"], ["b"]], "['a', 'b']"), ([["a-dirty"]], "one committed state"), ([[]], "no commit")],
)
def test_figures_of_no_or_several_commits_are_refused(commits, said, tmp_path):
    paths = []
    for number, of in enumerate(commits):
        paths.append(tmp_path / f"{number}.json")
        paths[-1].write_text(json.dumps({"made_with": {"commits": of}}))
    with pytest.raises(SystemExit, match=re.escape(said)):
        write_results.find_one_commit(paths)


def test_the_commit_of_a_reproduction_is_that_of_all_runs_of_its_tables(tmp_path):
    run = {"commits": ["12345678"]}
    (tmp_path / "cases.json").write_text(json.dumps({"made_with": run}))
    (tmp_path / "table.json").write_text(json.dumps({"made_with": {"n-2": run, "n-4": run}}))
    assert write_results.find_one_commit(sorted(tmp_path.iterdir())) == "12345678"


NUMBERS = re.compile(r"^\|.*\|[^|]*\d[^|]*\|[^|]*\d[^|]*\|", re.M)
"""A row of a table with two cells that have digits."""
COMMIT = re.compile(r"`[0-9a-f]{8}`|commit [0-9a-f]{8}\b")


@pytest.mark.parametrize(
    "page",
    ["README.md", "docs/results.md", "docs/gpu.md", "docs/gpu_h100.md", "docs/alternatives.md"],
)
def test_each_section_with_measured_figures_names_their_commit(page):
    text = (ROOT / page).read_text("utf-8")
    head, *sections = re.split(r"^## ", text, flags=re.M)
    without = []
    for section in sections:
        # What is measured stands in its own section, or is that of the head of the page.
        if NUMBERS.search(section) and not COMMIT.search(section + head):
            without.append(section.splitlines()[0])
    assert without == []


@pytest.mark.parametrize("page", ["docs/reproduce.md", "docs/generators.md"])
def test_pages_with_figures_of_one_measurement_name_its_commit(page):
    assert COMMIT.search((ROOT / page).read_text("utf-8"))


def test_tables_of_another_reconstructor_stand_in_a_folder_of_their_own(monkeypatch, tmp_path):
    monkeypatch.setattr(write_results, "STORED", tmp_path / "stored")
    monkeypatch.setattr(write_results, "MEASURED", tmp_path / "measured.json")
    (tmp_path / "stored" / "tables").mkdir(parents=True)
    (tmp_path / "out" / "tables").mkdir(parents=True)
    table = json.loads((ROOT / "docs" / "results" / "tables" / "dof.json").read_text())
    commit = write_results.run_git("rev-parse", "--short=8", "HEAD").decode().strip()
    table["made_with"] = {"commits": [commit]}
    (tmp_path / "out" / "tables" / "dof.json").write_text(json.dumps(table))
    write_results.copy_tables("other", str(tmp_path / "out"))
    assert write_results.read_table("other/dof") == table
    assert json.loads((tmp_path / "measured.json").read_text())["other"]["commit"] == commit
    # The paper's numbers stand beside it as beside ours, and only its claims are judged.
    assert "| `paper/unconstrained` | 22.39 |" in write_results.write_table("other/dof", "psnr")
    claims = write_results.write_claims("other")
    assert "| dof |" in claims
    assert "not measured" not in claims
