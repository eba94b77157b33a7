"""Measurements of completions and their reports, without assertions on times."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import measure_completions
from completions.cases import (
    BenchCase,
    GrowthValues,
    Manifest,
    copy_photographs,
    multiply_gaussians,
    read_manifest,
    write_input_splat,
)
from completions.measure import (
    PROCESS,
    REST,
    Sample,
    make_yardstick,
    measure_beside,
    measure_in_rounds,
    run_command,
)
from completions.report import (
    Measured,
    Report,
    fit_exponent,
    format_report,
)
from gscompleter.evaluation.methods import Models
from gscompleter.generators import load_generator
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from gscompleter.render.loading import load_renderer
from gscompleter.splats.ply import load_ply, save_ply
from gscompleter.system.errors import InputError
from paths import ROOT
from scenes import Room, camera_at, gaussians_of, photographed, view_of

SIZE = 64
CAMERAS = (camera_at(-0.2, size=SIZE), camera_at(0.2, size=SIZE), camera_at(0.5, size=SIZE))
PERFORMANCE = ROOT / "benchmarks" / "performance.json"
AXES = ("gaussians", "pixels", "views", "targets")
CASE = BenchCase("room", Path("room"), (0, 1), (4, 5), (64, 96))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return photographed(tmp_path_factory.mktemp("bench") / "room", CAMERAS)


def measure(*words: object) -> int:
    """Run the script with these words, and return its exit code."""
    return measure_completions.main([str(word) for word in words])


def write_cases(scene: Path, **more) -> Path:
    """Write a file with the room as its only case."""
    row = {"name": "room", "scene": scene.name, "context": [0, 1], "targets": [2]}
    path = scene.parent / "cases.json"
    path.write_text(json.dumps({"cases": [{**row, "resolution": [SIZE, SIZE], **more}]}))
    return path


@pytest.fixture(scope="module")
def quick(scene, tmp_path_factory):
    """Return the files of a quick run on a room."""
    out = tmp_path_factory.mktemp("bench") / "out"
    cases = write_cases(scene, near=0.5, far=20)
    assert measure("--cases", cases, "--quick", "--quiet", "--out", out) == 0
    return out


def sample(seconds: float, yardstick: float = 0.5) -> Sample:
    counts = {"context": 1, "added": 2}
    return Sample({"lift": seconds / 4, PROCESS: seconds}, yardstick, 2 * seconds, 2**30, counts)


@pytest.mark.slow
def test_a_quick_run_tells_every_stage_of_its_case(quick):
    report = json.loads((quick / "bench.json").read_text())
    (case,) = report["cases"]
    (one,) = case["samples"]
    assert {"context", "generate", "lift", "register", "integrate", "total"} < set(one["seconds"])
    assert one["gaussians"]["context"] == 2 * SIZE * SIZE
    assert report["growth"] == {}
    assert report["machine"]["cores"] >= 1
    assert report["settings"]["repeats"] == 1


@pytest.mark.slow
def test_completions_in_one_process_have_no_start_up(scene, tmp_path):
    cases, out = write_cases(scene, near=0.5, far=20, gaussians=3000), tmp_path / "out"
    words = ("--cases", cases, "--growth", "targets", "--repeats", 2, "--quiet")
    assert measure(*words, "--in-process", "--out", out) == 0
    report = json.loads((out / "bench.json").read_text())
    assert report["settings"]["in_process"]
    for one in report["cases"][0]["samples"]:
        assert one["gaussians"]["context"] == 3000
        assert 0 <= one["seconds"][REST] < 0.5 * one["seconds"][PROCESS]


# `quick` measures the same case with one generator.
@pytest.mark.slow
def test_generators_are_compared_in_the_same_holes(scene, tmp_path, monkeypatch, capsys):
    cases, out = write_cases(scene, near=0.5, far=20), tmp_path / "out"
    words = ("--cases", cases, "--quick", "--quiet", "--generators", "warp-inpaint")
    assert measure(*words, "--out", out) == 0
    (filling,) = json.loads((out / "bench.json").read_text())["warp-inpaint"]
    assert filling["seconds"] > 0
    assert filling["hole"]["psnr"] > 12
    table = (out / "tables.md").read_text()
    assert table == capsys.readouterr().out.rstrip("\n") + "\n"
    assert (
        f"| warp-inpaint | 1 | {filling['seconds']:.2f} | {filling['hole']['psnr']:.2f} |" in table
    )
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    assert measure(*words, "nothing") == 2
    assert "There is no generator 'nothing'" in capsys.readouterr().err


@pytest.mark.slow
def test_the_rest_of_a_process_is_what_its_completion_does_not_count(quick):
    (case,) = json.loads((quick / "bench.json").read_text())["cases"]
    seconds = case["samples"][0]["seconds"]
    assert seconds["total"] + seconds[REST] == pytest.approx(seconds[PROCESS])
    assert seconds[REST] > 0


def test_the_tables_have_a_row_for_each_case(scene, tmp_path):
    words = ("--cases", write_cases(scene, near=0.5, far=20), "--quick", "--in-process", "--quiet")
    assert measure(*words, "--out", tmp_path / "out") == 0
    assert (tmp_path / "out" / "tables.md").read_text().count("| room |") == 1


def test_a_crowd_of_copies_looks_like_the_scene():
    view = view_of(Room(), CAMERAS[0])
    scene, renderer = gaussians_of(view), load_renderer("cpu")
    crowd = multiply_gaussians(scene, 10 * len(scene) + 7)
    assert len(crowd) == 10 * len(scene) + 7
    one, many = (renderer.render(g, view.camera) for g in (scene, crowd))
    assert (one.image - many.image).square().mean() < 0.2 * one.image.var()
    assert (one.alpha - many.alpha).abs().mean() < 0.02


def test_a_crowd_is_the_same_for_the_same_seed_and_may_be_smaller():
    scene = gaussians_of(view_of(Room(), CAMERAS[0]))
    assert torch.equal(
        multiply_gaussians(scene, 100, 3).means, multiply_gaussians(scene, 100, 3).means
    )
    assert not torch.equal(
        multiply_gaussians(scene, 100, 3).means, multiply_gaussians(scene, 100, 4).means
    )
    few = multiply_gaussians(scene, 100)
    assert torch.allclose(few.opacities, torch.full((100,), 0.95), atol=1e-6)


def test_the_yardstick_renders_one_gaussian_per_pixel_of_three_cameras():
    counts, renderer = [], load_renderer("cpu")

    class Counting:
        freeze = renderer.freeze

        def render(self, gaussians, camera):
            counts.append(len(gaussians))
            return renderer.render(gaussians, camera)

    yardstick = make_yardstick(Counting(), "cpu")
    found, unit = measure_beside(yardstick, lambda: "found")
    assert set(counts) == {3 * 256 * 256}
    assert found == "found"
    assert unit > 0


def test_the_slope_of_a_power_is_its_exponent():
    sizes = [10, 20, 40, 80]
    assert fit_exponent(sizes, [0.3 * n**1.5 for n in sizes]) == pytest.approx(1.5)
    assert fit_exponent(sizes, [2.0] * 4) == pytest.approx(0)
    assert fit_exponent(sizes, [0.0, 0.0, 0.0, 1.0]) is None
    assert fit_exponent([5, 5], [1.0, 2.0]) is None


def test_a_sample_in_yardsticks_is_its_seconds_over_theirs():
    measured = Measured("case", [sample(1.0, 0.5), sample(3.0, 0.5), sample(10.0, 2.0)])
    assert measured.seconds[PROCESS] == 3.0
    assert measured.ratio == 5.0
    assert measured.peak_bytes == 2**30
    table = format_report(Report({}, {"repeats": 3}, (measured,), {}))
    assert "| case | 0.75 | 3.00 | 5.0 (2.0–6.0) | 6.0 | 1.07 | 1 | 2 |" in table


def test_everything_has_its_turn_before_anything_has_two():
    turns = []

    def task(name):
        return lambda: turns.append(name) or sample(1.0)

    found = measure_in_rounds({"a": task("a"), "b": task("b")}, 2)
    assert turns == ["a", "b", "a", "b"]
    assert [len(found[name]) for name in "ab"] == [2, 2]


def test_a_case_that_several_series_share_is_measured_once():
    values = GrowthValues((5, 6), ((64, 96), (9, 9)), ((0, 1), (0, 1, 2, 3)), ((4,), (4, 5)))
    growth = Manifest((CASE,), values).make_series(AXES)
    base = replace(CASE, targets=(4,))
    different = {base, *(case for found in growth.values() for case in found.values())}
    assert len(different) == 1 + 2 + 1 + 1 + 1  # each but Gaussians holds the base
    assert {size: c.context for size, c in growth["views"].items()} == {2: (0, 1), 4: (0, 1, 2, 3)}
    assert {size: c.targets for size, c in growth["targets"].items()} == {1: (4,), 2: (4, 5)}


def test_growth_is_told_with_its_exponents():
    series = {n: Measured(f"{n}", [sample(0.1 * n)]) for n in (1, 2, 4)}
    report = Report({"cores": 2}, {"repeats": 1}, (series[1],), {"targets": series})
    assert "| exponent | 1.00 | 1.00 | 1.00 | 1.00 | 0.00 |" in format_report(report)


def test_the_cases_of_the_documentation_can_be_read():
    manifest = read_manifest(PERFORMANCE)
    assert len(manifest.cases) == 6
    assert manifest.cases[0].resolution == (256, 256)
    assert len(manifest.cases[4].targets) == 8
    assert manifest.cases[5].gaussians == 4_000_000
    series = read_manifest(PERFORMANCE.with_name("growth.json")).make_series(AXES)
    for axis in AXES:
        assert max(series[axis]) == 16 * min(series[axis])
    assert len(series["views"][32].context) == 32
    given = read_manifest(PERFORMANCE.with_name("given_splats.json"))
    assert [*given.make_series(AXES)["gaussians"]] == [100_000, 1_000_000, 4_000_000]
    assert given.cases[0].splat == given.cases[0].scene / "splat.ply"


def test_photographs_of_a_case_are_copied_without_the_others(tmp_path):
    scene = tmp_path / "room"
    photographed(scene, [camera_at(x=0.1 * number, size=SIZE) for number in range(11)], Room())
    # As names, 10 comes before 2.
    case = BenchCase("room", scene, (2, 10), (0,), (SIZE, SIZE), splat=Path("splat.ply"))
    copied = copy_photographs(case, tmp_path)
    photographs = copied.open()
    assert len(photographs) == 3
    for frame, before in zip((*copied.context, *copied.targets), (2, 10, 0), strict=True):
        (view,) = photographs.views([frame], (SIZE, SIZE))
        (known,) = case.open().views([before], (SIZE, SIZE))
        assert torch.equal(view.image, known.image)
        assert torch.allclose(view.camera.c2w, known.camera.c2w, atol=1e-6)


def test_copies_of_a_trained_splat_are_what_is_completed(tmp_path):
    trained = replace(gaussians_of(view_of(Room(), CAMERAS[0])), encoded=None)
    save_ply(tmp_path / "splat.ply", trained)
    case = replace(CASE, gaussians=3 * len(trained), splat=tmp_path / "splat.ply")
    models = Models(PlaneSweep(), load_generator("warp-inpaint"), load_renderer("cpu"))
    copies = load_ply(write_input_splat(case, tmp_path, models, "cpu"))
    assert len(copies) == 3 * len(trained)
    nearest = torch.cdist(copies.means, trained.means).amin(dim=1)
    assert (nearest < trained.scales.max()).all()


@pytest.mark.slow
def test_a_process_that_refuses_its_input_says_why(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        run_command(["complete", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")])


@pytest.mark.slow
def test_a_process_tells_its_own_memory_and_not_its_parents():
    ballast = torch.ones(2**28)  # 1 GiB
    seconds, cpu, peak_bytes = run_command(["models", "--json"])
    assert 0.05 < cpu < 60
    assert seconds > 0
    assert peak_bytes is None or 0 < peak_bytes < ballast.numel() * 4


ROW = {"name": "a", "scene": "room", "context": [0, 1], "targets": [2], "resolution": [64, 64]}


@pytest.mark.parametrize(
    "text",
    [
        "no JSON",
        "[]",
        '{"cases": []}',
        json.dumps({"cases": [{**ROW, "context": []}]}),
        json.dumps({"cases": [{**ROW, "resolution": [64]}]}),
        json.dumps({"cases": [{**ROW, "targets": [2.5]}]}),
        json.dumps({"cases": [{**ROW, "near": "close"}]}),
        json.dumps({"cases": [ROW], "growth": {"case": "a"}}),
        json.dumps({"cases": [ROW], "growth": {"pixels": [64]}}),
        json.dumps({"cases": [ROW]}),
    ],
)
def test_a_file_that_names_no_cases_is_refused(tmp_path, capsys, text):
    path = tmp_path / "manifest.json"
    path.write_text(text)
    assert measure("--cases", path) == 2
    assert_a_sentence(capsys)


@pytest.mark.parametrize(
    ("case", "words", "sentence"),
    [
        ({"targets": [9]}, [], "no frame 9"),
        ({}, ["--repeats", 0], "repeats"),
    ],
)
def test_what_cannot_be_measured_is_refused(scene, capsys, case, words, sentence):
    assert measure("--cases", write_cases(scene, **case), *words) == 2
    assert sentence in assert_a_sentence(capsys)


def test_results_are_not_replaced_unasked(scene, capsys):
    assert measure("--cases", write_cases(scene), "--out", scene) == 2
    assert "not empty" in assert_a_sentence(capsys)


def assert_a_sentence(capsys) -> str:
    """Check that stderr is one sentence and stdout is empty, and return stderr."""
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("gscompleter: ")
    assert captured.err.count("\n") == 1
    return captured.err
