"""Models of a user on the command line: the examples, and what is no model."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import gscompleter as gsc
from command import run
from gscompleter.apps.commands.evaluate import PresetGeneratorOptions
from gscompleter.evaluation.store import make_file_name
from gscompleter.system.errors import InputError
from paths import ROOT
from scenes import camera_at, photographed

EXAMPLES = ROOT / "examples"
SMALL = ("--context", 0, 1, "--target", 2, "--resolution", 32, "--near", 0.5, "--far", 20)
DEPTH = f"{EXAMPLES / '06_own_depth.py'}:predict_depth"
PAINTER = f"{EXAMPLES / '08_own_generator.py'}:paint"


def complete(monkeypatch, room: Path, out: Path, *words: object) -> dict:
    assert run(monkeypatch, "complete", room, *SMALL, "--out", out, "--quiet", *words) in (0, 1)
    return json.loads((out / "summary.json").read_text())


def refuse(monkeypatch, capsys, *words: object) -> str:
    assert run(monkeypatch, *words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize(
    ("option", "word"),
    [
        pytest.param("--depth", DEPTH, marks=pytest.mark.slow),
        pytest.param(
            "--reconstructor",
            f"{EXAMPLES / '06_own_depth.py'}:reconstruct",
            marks=pytest.mark.slow,
        ),
        ("--reconstructor", f"{EXAMPLES / '07_own_reconstructor.py'}:Billboards"),
        ("--generator", f"{EXAMPLES / '08_own_generator.py'}:paint"),
    ],
)
def test_an_example_takes_the_place_of_a_model(option, word, room, tmp_path, monkeypatch):
    summary = complete(monkeypatch, room, tmp_path / "out", option, word)
    assert summary["settings"][option.removeprefix("--")] == word
    assert summary["gaussians"]["context"] > 0
    if option == "--generator":
        assert "The holes have the mean colour of the scene." in summary["targets"][0]["notes"]


def test_the_guard_of_the_example_drops_what_is_faint(room, tmp_path, monkeypatch):
    guard = f"{EXAMPLES / '09_own_guard.py'}:DropFaint"
    usual = ("image-agreement", "psnr")
    # Without padding, at whose end additions fade after all guards.
    margin = ("--config.margin", 0)
    summary = complete(
        monkeypatch, room, tmp_path / "out", *margin, "--config.guards", *usual, guard
    )
    assert summary["settings"]["config"]["guards"] == [*usual, guard]
    added = gsc.load_ply(tmp_path / "out" / "generated.ply")
    assert added.opacities.min() >= 0.2


# The test before shows that the guard of the example decides.
@pytest.mark.slow
def test_the_guard_of_the_example_drops_nothing_else(room, tmp_path, monkeypatch):
    guard = f"{EXAMPLES / '09_own_guard.py'}:DropFaint"
    usual = ("image-agreement", "psnr")
    # Gaps that open where something was dropped would be closed by further Gaussians.
    alone = ("--config.margin", 0, "--config.gaps.displacement", 0)
    for out, guards in (("out", (*usual, guard)), ("usual", usual)):
        complete(monkeypatch, room, tmp_path / out, *alone, "--config.guards", *guards)
    # `psnr` fades what makes a photograph worse.
    added, faded = (gsc.load_ply(tmp_path / out / "generated.ply") for out in ("out", "usual"))
    assert faded.opacities.min() < 0.19
    assert len(added) == int((faded.opacities >= 0.2).sum()) > 0


@pytest.mark.parametrize("option", ["--depth", "--reconstructor", "--generator"])
def test_what_is_no_function_is_refused(option, room, tmp_path, monkeypatch, capsys):
    (tmp_path / "models.py").write_text("number = 3\n")
    word = f"{tmp_path / 'models.py'}:number"
    line = refuse(
        monkeypatch, capsys, "complete", room, *SMALL, "--out", tmp_path / "o", option, word
    )
    assert "has to be a function" in line


def test_what_is_no_guard_is_refused(room, tmp_path, monkeypatch, capsys):
    (tmp_path / "models.py").write_text("class Other: pass\n")
    word = f"{tmp_path / 'models.py'}:Other"
    words = ("complete", room, *SMALL, "--out", tmp_path / "o", "--quiet", "--config.guards", word)
    assert "has to be a subclass of gsc.Guard" in refuse(monkeypatch, capsys, *words)


@pytest.mark.parametrize(
    "words",
    [
        ("--depth", DEPTH, "--depth-weights", "w.onnx"),
        ("--reconstructor", f"{EXAMPLES / '06_own_depth.py'}:reconstruct", "--weights", "w.pth"),
    ],
)
def test_weights_of_a_file_are_its_own(words, room, tmp_path, monkeypatch, capsys):
    line = refuse(monkeypatch, capsys, "complete", room, *SMALL, "--out", tmp_path / "o", *words)
    assert "opens its own weights" in line


@pytest.mark.slow
def test_depths_are_compared_in_one_table(room, tmp_path, monkeypatch, capsys):
    case = {"scene": str(room), "context": [0, 1], "target": 2, "near": 0.5, "far": 20}
    cases = tmp_path / "cases.json"
    cases.write_text(json.dumps({"resolution": [32, 32], "cases": [case]}))
    out = tmp_path / "out"
    # The depth is of the context already.
    words = ("evaluate", cases, "--methods", "context", "--out", out, "--device", "cpu")
    assert run(monkeypatch, *words, "--depth", "none", DEPTH) == 0
    table = json.loads((out / "tables" / "depths.json").read_text())
    rows = [(row["model"], row["method"]) for row in table["rows"]]
    assert rows == [(d, "context") for d in ("none", DEPTH)]
    assert table["rows"][0]["cells"]["psnr"]["difference"] is None
    assert table["rows"][1]["cells"]["psnr"]["difference"]["num_scenes"] == 1
    assert "| depth | method |" in capsys.readouterr().out

    assert run(monkeypatch, *words, "--depth", "none", DEPTH, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer == {"results": None, "tables": {"depths": table}, "figures": []}

    # The rows of an earlier run are read, not computed again.
    assert run(monkeypatch, *words, "--depth", "none", DEPTH) == 0
    assert "Scored 0, failed 0, done earlier 1" in capsys.readouterr().err
    assert "named twice" in refuse(monkeypatch, capsys, *words, "--depth", "none", "none")
    line = refuse(monkeypatch, capsys, *words, "--depth", "none", DEPTH, "--table", "models")
    assert "methods of their own" in line


@pytest.mark.slow
def test_a_shard_without_cases_leaves_the_comparison_to_the_others(
    room, tmp_path, monkeypatch, capsys
):
    case = {"scene": str(room), "context": [0, 1], "target": 2, "near": 0.5, "far": 20}
    cases = tmp_path / "cases.json"
    cases.write_text(json.dumps({"resolution": [32, 32], "cases": [case]}))
    out = tmp_path / "out"
    words = ("evaluate", cases, "--methods", "context", "--out", out, "--device", "cpu")
    compared = (*words, "--depth", "none", DEPTH, "--json", "--shard")
    assert run(monkeypatch, *compared, "1/2") == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["tables"] == {}
    assert "Not written yet" in printed.err
    assert run(monkeypatch, *compared, "0/2") == 0
    assert list(json.loads(capsys.readouterr().out)["tables"]) == ["depths"]

    paper = ("evaluate", cases, "--out", tmp_path / "paper", "--device", "cpu", "--shard", "1/2")
    assert run(monkeypatch, *paper, "--table", "models") == 0
    assert "Not written yet" in capsys.readouterr().err


# The test before compares depths by the same code.
@pytest.mark.slow
def test_generators_are_compared_in_one_table(room, tmp_path, monkeypatch, capsys):
    case = {"scene": str(room), "context": [0, 1], "target": 2, "near": 0.5, "far": 20}
    cases = tmp_path / "cases.json"
    cases.write_text(json.dumps({"resolution": [32, 32], "cases": [case]}))
    out = tmp_path / "out"
    words = ("evaluate", cases, "--methods", "full", "--out", out, "--device", "cpu")
    both = ("warp-inpaint", PAINTER)
    assert run(monkeypatch, *words, "--generator", *both) == 0
    table = json.loads((out / "tables" / "generators.json").read_text())
    assert [(row["model"], row["method"]) for row in table["rows"]] == [(g, "full") for g in both]
    assert table["rows"][0]["cells"]["psnr"]["difference"] is None
    assert table["rows"][1]["cells"]["psnr"]["difference"]["num_scenes"] == 1
    printed = capsys.readouterr().out
    assert "| Φ | method |" in printed
    # Both folders say above each table which models they are of.
    for name in both:
        run_folder = out / "runs" / make_file_name(f"generator {name}")
        made_with = f"Ψ: plane-sweep; Φ: {Path(name).name}; seed 0"
        assert f"{name}: {made_with}" in printed
        for file in ("tables.md", "timings.md"):
            assert made_with in (run_folder / file).read_text().splitlines()[0]
        latex = (run_folder / "tables.tex").read_text()
        assert latex.startswith(f"% Psi: plane-sweep; Phi: {Path(name).name}; seed 0")
        facts = json.loads((run_folder / "tables.json").read_text())["made_with"]
        assert (facts["reconstructor"], facts["generator"]) == ("plane-sweep", Path(name).name)

    line = refuse(monkeypatch, capsys, *words, "--generator", *both, "--generator-steps", 4)
    assert "None of the generators" in line
    assert "named twice" in refuse(monkeypatch, capsys, *words, "--generator", PAINTER, PAINTER)
    line = refuse(monkeypatch, capsys, *words, "--generator", *both, "--depth", "none", DEPTH)
    assert "one after the other" in line


def test_a_setting_goes_to_the_generators_that_have_it():
    options = PresetGeneratorOptions(("warp-inpaint", "pe-field"), generator_steps=2)
    shared = options.share_settings()
    assert [(of.generator, of.generator_steps) for of in shared.values()] == [
        (("warp-inpaint",), None),
        (("pe-field",), 2),
    ]
    assert shared["pe-field"].make_settings().steps == 2
    taken = PresetGeneratorOptions(("migan", "pe-field"), generator_weights="a.safetensors")
    with pytest.raises(InputError, match="would be taken by migan and pe-field"):
        taken.share_settings()


WAVES = """
import torch
from gscompleter import DepthMap

def depth(view):
    height, width = view.image.shape[:2]
    rows = torch.linspace(0, 30, height)[:, None]
    columns = torch.linspace(0, 40, width)[None]
    return DepthMap(3 + 2 * torch.sin(rows) * torch.cos(columns), torch.ones(height, width).bool())
"""
"""Source of a depth that has nothing to do with the scene."""


@pytest.mark.slow
def test_evaluate_says_what_the_reconstructor_says_of_photographs(tmp_path, monkeypatch, capsys):
    cameras = [camera_at(x, size=64) for x in (-0.3, 0.1, 0.5)]
    scene = photographed(tmp_path / "room", cameras)
    (tmp_path / "waves.py").write_text(WAVES)
    cases = tmp_path / "cases.json"
    row = {"scene": scene.name, "context": [0, 1], "target": 2}
    cases.write_text(json.dumps({"resolution": [64, 64], "cases": [row]}))
    words = ("--depth", f"{tmp_path / 'waves.py'}:depth", "--methods", "context")
    assert run(monkeypatch, "evaluate", cases, *words, "--out", tmp_path / "out") == 0
    sentence = "The predicted depth is not used in photograph"
    assert f": {sentence}" in capsys.readouterr().err
    (file,) = (tmp_path / "out" / "tasks").glob("*/context.json")
    (note,) = json.loads(file.read_text())["context_notes"]
    assert note.startswith(sentence)
