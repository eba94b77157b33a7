"""The paper's tables, figures and claims, and a small reproduction of all of them."""

import json
import math
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

import tiny_diffusion
from chunk_files import example, save_chunk
from command import run
from gscompleter.apps.commands.evaluate import (
    EvaluateOptions,
    FigureName,
    TableName,
    assign_weights,
    decide_evaluation,
)
from gscompleter.apps.evaluating import reproduction
from gscompleter.apps.evaluating.reproduction import (
    choose_protocols,
    find_unused_protocols,
    make_run,
)
from gscompleter.apps.evaluating.scoring import Scored
from gscompleter.apps.requests.answer import AnswerRequest
from gscompleter.apps.requests.evaluation import EvaluationRequest, ReproductionRequest
from gscompleter.data.formats import open_photographs
from gscompleter.evaluation.baselines.reggs import RegGSConfig
from gscompleter.evaluation.columns import BY_KEY
from gscompleter.evaluation.figures import draw_outline, find_widest_hole
from gscompleter.evaluation.methods import METHODS
from gscompleter.evaluation.paper import load_paper, select_names
from gscompleter.evaluation.paper_tables import compare_cases, estimate_mean
from gscompleter.evaluation.runner import RunConfig
from gscompleter.models.feed_forward import MVSplat
from gscompleter.models.weights.published import PUBLISHED
from gscompleter.system.errors import InputError, OutputError, WorkerError
from gscompleter.system.files.image import read_pixels
from paths import ROOT
from scenes import Room, camera_at, view_of

PAPER = load_paper()
SIZE = 64
FRAMES = 9
PROTOCOLS = ("n-2", "n-3", "stress-2-7", "sequence-2-steps-2")


@dataclass(frozen=True)
class CoarseRegGS(RegGSConfig):
    """RegGS with few clusters, because its time is quadratic in them."""

    components: int = 50


def test_the_registry_names_what_exists():
    assert (*PAPER.tables, "all") == get_args(TableName)
    assert (*PAPER.figures, "all") == get_args(FigureName)
    for spec in (*PAPER.tables.values(), *PAPER.figures.values()):
        assert set(spec.list_methods()) <= set(METHODS)
    for spec in PAPER.tables.values():
        assert set(spec.columns) <= set(BY_KEY)
        assert spec.baseline in spec.methods
    for claim in PAPER.claims:
        table = PAPER.tables[claim.table]
        assert {claim.method, claim.baseline} <= set(table.methods)
        assert claim.column in table.columns
    for preset in PAPER.data_sets.values():
        assert all(PUBLISHED[name].is_reconstructor for name in preset.reconstructor)


def test_the_standard_error_is_over_scenes():
    alone = {"a 0>1": 1.0, "b 0>1": 2.0, "c 0>1": 6.0}
    found = estimate_mean(alone)
    assert found.mean == 3
    assert found.error == pytest.approx(statistics.stdev(alone.values()) / math.sqrt(3))
    # Cases of the same scenes with the same values tell nothing new.
    repeated = {f"{case}{i}": value for case, value in alone.items() for i in range(4)}
    assert estimate_mean(repeated).error == pytest.approx(found.error)
    assert estimate_mean({"a 0>1": 1.0, "a 0>2": 5.0}).error is None


@pytest.mark.parametrize(("values", "p"), [((1, 2, 3), 0.0742), ((1, 2, 3, 4, 5), 0.0132)])
def test_significance_is_by_t_with_one_degree_of_freedom_less_than_scenes(values, p):
    """Both are above two standard errors; p values are those of a table of Student's t."""
    found = estimate_mean(
        {f"{scene} 0>1": float(v) for scene, v in zip("abcde", values, strict=False)}
    )
    assert found.degrees_of_freedom == len(values) - 1
    assert found.mean > 2 * found.error
    assert found.p_value == pytest.approx(p, abs=1e-4)
    assert found.is_noise == (p > 0.05)


def test_differences_are_paired():
    easy, hard = {"a 0>1": 30.0, "b 0>1": 10.0}, {"a 0>1": 30.5, "b 0>1": 10.4, "c 0>1": 0.0}
    found = compare_cases(hard, easy)
    assert found.mean == pytest.approx(0.45)
    assert found.error < 0.06
    assert estimate_mean(easy).error > 9
    assert compare_cases({"a 0>1": 1.0}, {"b 0>1": 1.0}) is None


def decide(**given: object) -> EvaluationRequest | ReproductionRequest:
    return decide_evaluation(EvaluateOptions(paths=(Path("data"),), out=Path("out"), **given))


def test_a_preset_sets_what_is_not_given():
    found = decide(preset="dl3dv")
    cases = found.run.cases
    assert (cases.resolution, cases.near, cases.far) == ((256, 448), 0.5, 200)
    assert list(found.weights) == ["depthsplat-base-dl3dv-256x448"]
    assert found.run.models.generator == "pe-field"
    found = decide(preset="dl3dv", reconstructor=("plane-sweep",), resolution=64)
    assert (list(found.weights), found.run.cases.resolution) == (["plane-sweep"], 64)
    models = decide().models
    assert (models.reconstructor, models.generator) == ("plane-sweep", "warp-inpaint")


@pytest.mark.parametrize(
    ("weights", "assigned"),
    [
        ((), {}),
        (("a.ckpt", "b.ckpt"), {"mvsplat-re10k": "a.ckpt", "volsplat-re10k": "b.ckpt"}),
        (("mvsplat-re10k=re10k.ckpt",), {"mvsplat-re10k": "re10k.ckpt"}),
        (("volsplat-re10k=x=1/b.ckpt",), {"volsplat-re10k": "x=1/b.ckpt"}),
    ],
)
def test_weights_are_one_for_each_model_or_named(weights, assigned):
    models = ("mvsplat-re10k", "volsplat-re10k")
    found = assign_weights(models, [Path(path) for path in weights])
    assert list(found) == list(models)
    named = {name: str(path) for name, path in found.items() if path is not None}
    assert named == assigned


@pytest.mark.parametrize(
    "weights", [("a.ckpt",), ("a", "b", "c"), ("a", "mvsplat-re10k=b"), ("other=a.ckpt",)]
)
def test_weights_that_belong_to_no_model_are_refused(weights):
    with pytest.raises(InputError, match="belongs to no reconstructor; give --weights one file"):
        assign_weights(("mvsplat-re10k", "volsplat-re10k"), [Path(path) for path in weights])


def test_two_weights_for_one_model_are_refused():
    twice = [Path("mvsplat-re10k=a.ckpt"), Path("mvsplat-re10k=b.ckpt")]
    with pytest.raises(InputError, match="mvsplat-re10k is given two files of weights"):
        assign_weights(("mvsplat-re10k", "volsplat-re10k"), twice)


def test_each_run_of_table_i_gets_its_own_weights():
    given = decide(preset="re10k", weights=(Path("mvsplat-re10k=re10k.ckpt"),))
    runs = [make_run(given, PAPER.tables["models"], model, "n-30") for model in given.weights]
    assert {run.models.reconstructor: run.models.weights for run in runs} == {
        "volsplat-re10k": None,
        "mvsplat-re10k": Path("re10k.ckpt"),
        "depthsplat-large-re10k": None,
    }


def test_a_table_takes_the_given_protocols_of_its_kind():
    given = decide(preset="re10k", protocol=("n-2", "n-3", "stress-2-7")).run.cases
    assert choose_protocols(given, PAPER.tables["spans"]) == ("n-2", "n-3")
    assert choose_protocols(given, PAPER.tables["stress"]) == ("stress-2-7",)
    assert choose_protocols(given, PAPER.tables["models"]) == ("n-2",)
    assert choose_protocols(given, PAPER.tables["sequence"]) == ("sequence-10",)
    assert choose_protocols(decide(preset="re10k").run.cases, PAPER.tables["models"]) == ("n-30",)
    assert choose_protocols(decide().cases, PAPER.tables["models"]) == ("",)


def test_an_index_of_the_user_has_no_kind_whatever_it_is_called():
    given = decide(preset="re10k", protocol=("stress-rooms.json", "n-rooms.json")).run.cases
    assert choose_protocols(given, PAPER.tables["stress"]) == ("stress",)
    assert choose_protocols(given, PAPER.tables["spans"]) == ("n-10", "n-20", "n-30")
    assert choose_protocols(given, PAPER.tables["models"]) == ("stress-rooms.json",)


def test_a_figure_shows_one_protocol():
    given = decide(preset="re10k", protocol=("sequence-4", "sequence-2-steps-2")).run.cases
    assert choose_protocols(given, PAPER.tables["sequence"]) == given.protocol
    assert choose_protocols(given, PAPER.figures["sequence"]) == ("sequence-4",)


def test_a_protocol_that_does_not_exist_is_refused_where_no_table_takes_it(written):
    with pytest.raises(InputError, match="no protocol 'sequence-x'"):
        written({}, table=("spans",), protocol=("n-2", "sequence-x"))


def test_protocols_that_nothing_takes_are_told():
    given = decide(table=("models",), protocol=("n-2", "n-3", "stress-2-7")).run.cases
    alone = [PAPER.tables["models"]]
    assert find_unused_protocols(given, alone) == ["n-3", "stress-2-7"]
    assert find_unused_protocols(given, [*alone, PAPER.tables["spans"]]) == ["stress-2-7"]


FAILURES = (InputError("no frames"), OutputError("no space"), WorkerError("no process"))


@pytest.fixture
def written(monkeypatch, tmp_path) -> Callable[..., list[str]]:
    """Return a function that reproduces with tables that fail, and lists those that were tried."""

    def reproduce_with(failing: Mapping[str, InputError], **given: object) -> list[str]:
        tried: list[str] = []

        def write(request, name, spec, scored):
            tried.append(name)
            if name in failing:
                raise failing[name]
            scored.append(Scored(1, 1, []))

        monkeypatch.setattr(reproduction, "write_output", write)
        request = decide(reconstructor=("plane-sweep",), **given)
        run = replace(request.run, out=tmp_path, answer=AnswerRequest(quiet=True))
        assert reproduction.reproduce(replace(request, run=run)) == 0
        return tried

    return reproduce_with


def test_all_goes_on_without_what_cannot_be_made(written):
    tried = written({"stress": FAILURES[0]}, table=("all",))
    assert tried == list(select_names(["all"], PAPER.tables, "warp-inpaint"))


@pytest.mark.parametrize(
    ("named", "error"),
    [
        ({"table": ("all", "stress")}, FAILURES[0]),
        ({"table": ("stress",), "figure": ("all",)}, FAILURES[0]),
        # Without a place or a process all of them fail.
        ({"table": ("all",)}, FAILURES[1]),
        ({"table": ("all",)}, FAILURES[2]),
    ],
)
def test_what_is_named_beside_all_has_to_succeed(written, named, error):
    with pytest.raises(InputError, match=str(error)):
        written({"stress": error}, **named)


def test_that_nothing_could_be_made_has_its_reason_also_if_quiet(written):
    failing = dict.fromkeys(PAPER.tables, FAILURES[0])
    with pytest.raises(InputError, match=r"None of the tables and figures .* no frames"):
        written(failing, table=("all",))


def test_all_leaves_out_what_another_generator_is_needed_for():
    assert "steps" not in select_names(["all"], PAPER.tables, "warp-inpaint")
    assert "steps" in select_names(["all"], PAPER.tables, "pe-field")
    assert list(select_names(["steps"], PAPER.tables, "warp-inpaint")) == ["steps"]


def test_crops_and_outlines_are_at_the_holes():
    holes = np.zeros((60, 90), np.uint8)
    holes[40:, 70:] = 255
    holes[:3] = 255
    rows, columns = find_widest_hole(holes)
    assert (rows.stop, columns.stop) == (60, 90)
    assert rows.stop - rows.start == columns.stop - columns.start == 20
    marked = draw_outline(np.zeros((60, 90, 3), np.uint8), holes)
    assert marked[50, 70].any()
    assert not marked[55, 80].any()


@pytest.fixture(scope="module")
def rooms(tmp_path_factory) -> Path:
    """Write a chunk with two rooms."""
    cameras = [camera_at(x=0.12 * i, yaw=3.0 * i, size=SIZE) for i in range(FRAMES)]
    inside = {"a": Room(), "b": Room(boxes=(((-4.0, -1.5, -1.0), (4.0, 1.5, 6.0)),))}
    examples = [example(k, views=[view_of(r, c) for c in cameras]) for k, r in inside.items()]
    return save_chunk(tmp_path_factory.mktemp("rooms") / "000000.torch", *examples)


@pytest.fixture
def clip(shared, tmp_path) -> Path:
    """Write a chunk with a clip of photographs."""
    folder = shared / "data" / "re10k_0d4de33c"
    views = open_photographs(folder).views(range(FRAMES), (SIZE, SIZE))
    return save_chunk(tmp_path / "000000.torch", example(folder.name, views=views))


def reproduce(monkeypatch, data: Path, out: Path, *more: object) -> int:
    words = ["evaluate", data, "--out", out, "--one-per-scene", "--resolution", SIZE, SIZE]
    protocols = () if "--protocol" in more else ("--protocol", *PROTOCOLS)
    return run(monkeypatch, *words, *protocols, "--quiet", *more)


@pytest.mark.slow
def test_a_table_and_a_figure_of_rooms(rooms, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="needs gscompleter[evaluation]")
    more = ("--table", "models", "spans", "--figure", "seams", "--outlines", "--crops")
    assert reproduce(monkeypatch, rooms, tmp_path, *more) == 0
    table = json.loads((tmp_path / "tables" / "spans.json").read_text())
    assert [row["protocol"] for row in table["rows"]] == ["n-2", "n-2", "n-3", "n-3"]
    before, after = (row["cells"]["psnr"] for row in table["rows"][:2])
    differences = [after["cases"][case] - value for case, value in before["cases"].items()]
    assert len(differences) == 2
    assert after["difference"]["mean"] == pytest.approx(statistics.fmean(differences))
    assert after["value"] > before["value"]
    facts = table["made_with"]["plane-sweep, n-2"]
    assert (facts["reconstructor"], facts["generator"]) == ("plane-sweep", "warp-inpaint")
    for suffix, sentence in ((".md", "Ψ: plane-sweep; Φ: "), (".tex", "Psi: plane-sweep; Phi: ")):
        assert sentence in (tmp_path / "tables" / f"spans{suffix}").read_text()
    text = (tmp_path / "results.md").read_text()
    assert "## Seams without and with a dilated hole mask" in text
    assert text.count("not measured") < len(PAPER.claims)
    # Two rows with their crops, four columns.
    height, width, _ = read_pixels(tmp_path / "figures" / "seams.png").shape
    assert height == pytest.approx(width, rel=0.15)
    first = {path: path.read_bytes() for path in tmp_path.glob("*/s*.*")}
    assert reproduce(monkeypatch, rooms, tmp_path, *more) == 0
    assert {path: path.read_bytes() for path in tmp_path.glob("*/s*.*")} == first


@pytest.mark.slow
def test_all_of_the_paper_on_photographs(clip, tmp_path, monkeypatch):
    """A model with random weights, one without, and for steps a tiny one in place of PE-Field's."""
    pytest.importorskip("matplotlib", reason="needs gscompleter[evaluation]")
    pytest.importorskip("diffusers", reason="needs gscompleter[diffusion]")
    torch.manual_seed(0)
    state = {f"encoder.{k}": v for k, v in MVSplat().state_dict().items()}
    weights = tmp_path / "random.ckpt"
    torch.save({"state_dict": state}, weights)
    kontext = tiny_diffusion.saved(tiny_diffusion.kontext_pipeline(), tmp_path / "kontext")
    few = partial(RunConfig, baseline_iterations=3)
    monkeypatch.setattr("gscompleter.apps.evaluating.scoring.RunConfig", few)
    monkeypatch.setattr("gscompleter.evaluation.methods.RegGSConfig", CoarseRegGS)
    out = tmp_path / "out"
    names = ("mvsplat-re10k", f"{ROOT / 'examples' / '07_own_reconstructor.py'}:Billboards")
    more = ("--reconstructor", *names, "--weights", f"mvsplat-re10k={weights}")
    every = ("--table", "all", "--figure", "all", "--generator", "warp-inpaint")
    assert reproduce(monkeypatch, clip, out, *every, *more) == 0
    steps = ("--table", "steps", "--preset", "re10k", "--limit", 1)
    tiny = ("--generator-weights", kontext, "--generator-depth", "context")
    assert reproduce(monkeypatch, clip, out, *steps, *tiny, *more) == 0
    for name, spec in PAPER.tables.items():
        table = json.loads((out / "tables" / f"{name}.json").read_text())
        assert {row["method"] for row in table["rows"]} == set(spec.methods)
        assert {row["model"] for row in table["rows"]} == set(names)
        assert set(table["cases"].values()) == {1}
        latex = (out / "tables" / f"{name}.tex").read_text()
        assert latex.count(r"\\") == 1 + len(table["rows"])
    for name in PAPER.figures:
        assert (read_pixels(out / "figures" / f"{name}.png") < 128).any()
        assert (out / "figures" / f"{name}.pdf").read_bytes().startswith(b"%PDF")
    text = (out / "results.md").read_text()
    assert all(spec.title in text for spec in (*PAPER.tables.values(), *PAPER.figures.values()))
    assert all(claim.says in text for claim in PAPER.claims)


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (("--table", "stress", "--protocol", "stress-2-70"), "no clip has the frames"),
        (("--reconstructor", "plane-sweep", "plane-sweep"), "is named twice"),
        (
            ("--table", "models", "--weights", "x.ckpt", "y.ckpt"),
            "x.ckpt belongs to no reconstructor",
        ),
        (("--preset", "re10k", "--weights", "a.ckpt", "b.ckpt", "c.ckpt"), "a.ckpt"),
    ],
)
def test_what_cannot_be_made_is_a_sentence(more, sentence, rooms, tmp_path, monkeypatch, capsys):
    assert reproduce(monkeypatch, rooms, tmp_path, *more) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert sentence in error
    assert "Traceback" not in error


@pytest.mark.slow
def test_the_steps_need_the_model_of_the_paper(rooms, tmp_path, monkeypatch, capsys):
    for package in ("diffusers", "transformers", "accelerate"):
        pytest.importorskip(package, reason="needs gscompleter[diffusion]")
    more = ("--table", "steps", "--generator", "warp-inpaint")
    assert reproduce(monkeypatch, rooms, tmp_path, *more) == 2
    assert "FLUX.1-Kontext" in capsys.readouterr().err


@pytest.mark.slow
def test_a_case_that_no_figure_can_show_is_named_once_the_cases_are_there(
    rooms, tmp_path, monkeypatch, capsys
):
    more = ("--figure", "seams", "--figure-cases", "x 0>1")
    assert reproduce(monkeypatch, rooms, tmp_path, *more) == 1
    error = " ".join(capsys.readouterr().err.split())
    assert "there are 'a 0+2>4', 'b 0+2>4'" in error
    assert "Traceback" not in error
