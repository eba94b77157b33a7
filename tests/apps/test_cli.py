"""The command line: contracts on the output folder, exit codes and sentences."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import time
from dataclasses import fields, replace
from itertools import chain
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch

from command import run, run_on_terminal
from gscompleter import load_ply
from gscompleter.cli import COMMANDS, OptionClasses, parse_command
from gscompleter.config import CompleterConfig, load_config
from gscompleter.config.generators import GENERATORS, GeneratorSettings
from gscompleter.data.scene import write_cameras
from gscompleter.models.settings import DiffusersInpaintSettings, PEFieldSettings
from gscompleter.numerics.image_ops import dilate
from gscompleter.splats.formats import read_provenance
from gscompleter.system.files.image import read_pixels
from scenes import camera_at

SIZE = 64


@pytest.fixture(scope="module")
def scene(room) -> Path:
    """Return photographs of a room from three places; frame 2 sees what 0 and 1 do not."""
    return room


def complete(scene, out, *more, context=(0, 1), target=(2,)) -> list:
    return ["complete", scene, "--context", *context, "--target", *target, "--out", out, *more]


SMALL = ("--resolution", 32, "--near", 0.5, "--far", 20, "--quiet")
"""Options of fast runs whose result does not matter."""


@pytest.fixture(scope="module")
def completed(completed_room) -> Path:
    """Return the output of one plain run."""
    return completed_room


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("complete", "scene", "--out", "s3://bucket/out"), "out"),
        (("complete", "scene", "--out", "out", "--export-holes", "gs://bucket"), "export-holes"),
        (("batch", "scenes.csv", "--out", "s3://bucket/out"), "out"),
        (("convert", "a.ply", "https://site.org/a.spz"), "out"),
        (("view", "a.ply", "--save", "s3://bucket/page.html"), "save"),
    ],
)
def test_an_address_is_no_place_for_results(words, option, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *words) == 2
    said = capsys.readouterr().err
    assert " is an address, and results are written to a disk; name a path" in said
    assert f"--{option}" in said
    assert not list(tmp_path.iterdir())


def test_out_holds_all_that_the_contract_names(completed):
    assert {p.name for p in completed.iterdir()} == {
        "completed.ply",
        "context.ply",
        "edits.json",
        "generated.ply",
        "images",
        "report.html",
        "report.json",
        "summary.json",
        "targets.json",
        "trainer",
    }
    names = ("before", "after", "reference", "hole_mask", "gaps", "truth")
    images = {p.name for p in (completed / "images").iterdir()}
    assert images == {f"target1_{name}.png" for name in names}


def test_what_was_added_lies_beside_the_scene_alone(completed):
    scene, added = load_ply(completed / "completed.ply"), load_ply(completed / "generated.ply")
    whole = scene[scene.generated > 0]
    assert len(added) > 0
    for name in ("means", "quats", "encoded", "sh", "generated"):
        assert torch.equal(getattr(added, name), getattr(whole, name)), name


def test_the_summary_has_the_keys_of_the_contract_and_the_numbers_add_up(completed):
    summary = json.loads((completed / "summary.json").read_text())
    assert set(summary) >= {"version", "settings", "seed", "device", "context", "targets"}
    assert summary["held_out"] == []  # all three are used
    scores = {"psnr_before", "psnr_after", "ssim_before", "ssim_after"}
    assert [row["frame"] for row in summary["context"]] == [0, 1]
    assert all(
        set(row)
        == {
            "frame",
            "file",
            "exposure_gain",
            "dynamic_fraction",
            "given_depth",
            "ignored",
            "pose_error",
            *scores,
        }
        for row in summary["context"]
    )
    assert all(row["exposure_gain"] is None for row in summary["context"])  # as they were taken
    assert all(row["pose_error"] is None for row in summary["context"])  # two agree with any pose
    (target,) = summary["targets"]
    assert set(target) >= {"frame", "anchor", "anchor_fallback", "hole_fraction", "affine", *scores}
    assert (target["frame"], target["anchor"], target["anchor_fallback"]) == (2, 0, False)
    assert set(target["affine"]) == {"scale", "shift", "inliers", "method", "agreement"}
    assert target["hole_fraction"] > 0.1
    assert target["psnr_after"] > target["psnr_before"] + 1
    for row in summary["context"]:
        assert row["psnr_after"] >= row["psnr_before"] - 0.05
    stages = {"context", "generate", "lift", "register", "integrate", "total"}
    assert set(summary["seconds"]) == stages
    context, whole = load_ply(completed / "context.ply"), load_ply(completed / "completed.ply")
    assert summary["gaussians"] == {"context": len(context), "added": len(whole) - len(context)}
    assert (whole.generated[: len(context)] == 0).all()
    assert (whole.generated[len(context) :] == 1).all()


# `test_outcome.py` chooses such photographs, and scores fewer of them.
@pytest.mark.slow
def test_photographs_that_were_not_used_are_scored(scene, tmp_path, monkeypatch, capsys):
    folder, out = tmp_path / "scene", tmp_path / "out"
    folder.mkdir()
    content = json.loads((scene / "transforms.json").read_text())
    entries = []
    for number in range(13):  # from 2 on, all stand where the target does
        shutil.copy(scene / f"{min(number, 2)}.png", folder / f"{number:02}.png")
        entries.append({**content["frames"][min(number, 2)], "file_path": f"{number:02}.png"})
    (folder / "transforms.json").write_text(json.dumps({**content, "frames": entries}))
    (folder / "03.png").write_bytes(b"damaged")

    words = complete(folder, out, "--resolution", 48, 48, "--near", 0.5, "--far", 20)
    assert run(monkeypatch, *words) == 0
    summary = json.loads((out / "summary.json").read_text())
    rows, (target,) = summary["held_out"], summary["targets"]
    assert [row["frame"] for row in rows] == [*range(4, 12)]  # the closest that are whole
    for row in rows:
        assert not row["is_check"]
        assert 0 < row["covered_before"] < row["covered_after"] <= 1
        # What stays empty counts at the target, and not here.
        assert row["psnr_after"] >= target["psnr_after"]
        assert row["psnr_after"] > row["psnr_before"] + 1
    said = capsys.readouterr().out
    assert "the 8 nearest unused photographs gain " in said
    assert " dB where the scene covers them (" in said
    page = (out / "report.html").read_text()
    assert "At held-out photographs" in page
    assert ">mean<" in page

    splat = ("--scene", out / "context.ply", *SMALL)
    assert run(monkeypatch, *complete(folder, tmp_path / "again", *splat)) == 0
    again = json.loads((tmp_path / "again" / "summary.json").read_text())
    assert [(row["frame"], row["is_check"]) for row in again["held_out"]] == [
        (frame, True) for frame in range(4, 12)
    ]


# `test_results_in_python.py` compares a result of this command with one of Python.
@pytest.mark.slow
def test_the_same_command_gives_the_same_bytes(scene, completed, tmp_path, monkeypatch):
    arguments = complete(scene, tmp_path / "out", "--near", 0.5, "--far", 20, "--quiet")
    assert run(monkeypatch, *arguments) == 0
    for name in ("completed.ply", "context.ply", "report.json", "images/target1_after.png"):
        assert (tmp_path / "out" / name).read_bytes() == (completed / name).read_bytes(), name


# `test_photometric.py` strips a result to the byte, and `test_completer.py` compares the context.
@pytest.mark.slow
def test_a_given_ply_is_kept_bit_for_bit(scene, completed, tmp_path, monkeypatch):
    given = completed / "context.ply"
    out = tmp_path / "out"
    assert run(monkeypatch, *complete(scene, out, "--scene", given, "--no-recolor", *SMALL)) == 0
    assert (out / "context.ply").read_bytes() == given.read_bytes()
    mine, whole = load_ply(given), load_ply(out / "completed.ply")
    assert len(whole) > len(mine)
    for name in ("means", "quats", "scales", "opacities", "sh", "encoded"):
        assert torch.equal(getattr(whole, name)[: len(mine)], getattr(mine, name)), name
    # The result knows it by its hash, and gives it back.
    (made,) = read_provenance(out / "completed.ply").runs
    assert made.given == hashlib.sha256(given.read_bytes()).hexdigest()
    back = tmp_path / "back.ply"
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", back) == 0
    assert back.read_bytes() == given.read_bytes()


# `test_splat_alone.py` completes for a file with a camera.
@pytest.mark.slow
def test_cameras_from_a_file_are_completed_without_scores(scene, tmp_path, monkeypatch):
    file = tmp_path / "targets.json"
    write_cameras(file, [camera_at(0.7, yaw=12, size=SIZE), camera_at(-0.9, yaw=-12, size=SIZE)])
    out = tmp_path / "out"
    assert run(monkeypatch, *complete(scene, out, *SMALL, target=(file,))) == 0
    rows = json.loads((out / "summary.json").read_text())["targets"]
    assert [(row["frame"], row["psnr_after"]) for row in rows] == [(None, None), (None, None)]
    assert set(load_ply(out / "completed.ply").generated.tolist()) == {0, 1, 2}


@pytest.fixture(scope="module")
def told_by_the_oracle(scene, tmp_path_factory) -> Path:
    """Return the output of a run with the photograph of the target and a few single settings."""
    out = tmp_path_factory.mktemp("oracle") / "out"
    more = ("--generator", "oracle", "--config", "no-da", "--config.registration.iterations", 3)
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert run(monkeypatch, *complete(scene, out, *more, *SMALL)) == 0
    return out


def test_the_oracle_looks_at_the_photograph_and_says_so(told_by_the_oracle):
    out = told_by_the_oracle
    assert json.loads((out / "summary.json").read_text())["settings"]["uses_target_photographs"]
    shown = {
        name: read_pixels(out / "images" / f"target1_{name}.png")
        for name in ("reference", "truth", "before", "hole_mask")
    }
    # Outside of the hole with its seam, the picture of Φ was not used, and is not shown.
    is_hole = shown["hole_mask"][..., 0] > 0
    near = dilate(torch.from_numpy(is_hole), CompleterConfig().holes.dilation).numpy()
    assert is_hole.any()
    assert not near.all()
    assert (shown["reference"][near] == shown["truth"][near]).all()
    assert (shown["reference"][~near] == shown["before"][~near]).all()


def broken_scene(scene: Path, folder: Path, change) -> Path:
    """Copy the scene with a changed transforms.json."""
    folder.mkdir()
    for image in scene.glob("*.png"):
        (folder / image.name).write_bytes(image.read_bytes())
    content = json.loads((scene / "transforms.json").read_text())
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def refused(monkeypatch, capsys, out: Path, arguments, sentence: str) -> None:
    """Check that the command exits with 2, prints one sentence and writes nothing."""
    assert run(monkeypatch, *arguments) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert said.startswith("gscompleter: ")
    assert said.count("\n") == 1
    assert "Traceback" not in said
    assert not out.exists()
    assert [p.name for p in out.parent.iterdir() if p.name.startswith(".gscompleter")] == []


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        ({"context": (0,)}, "at least 2"),
        ({"context": ()}, "names no frame"),
        ({"context": (1, 1)}, "twice"),
        ({"context": (0, 9)}, "no frame 9"),
        ({"target": (9,)}, "no frame 9"),
        ({"target": (-1,)}, "-1"),
        ({"target": ("nowhere.json",)}, "nowhere.json"),
        ({"target": ("abc",)}, "is no target: name a photograph or its number"),
        ({"target": ("²",)}, "²"),
        ({"target": ("--2",)}, "--2"),
        ({"target": ("9" * 5000,)}, "9' is no target"),
        ({"target": ("x" * 5000,)}, "xxx"),
        ({"context": ("0,1",)}, "'0,1'"),
        ({"context": ("²", 1)}, "'²'"),
        ({"context": (-1, 0)}, "There is no frame -1"),
        ({"context": ("9" * 5000, 0)}, "--context"),
        ({"context": (10**12, 0)}, "There is no frame 1000000000000"),
    ],
)
def test_wrong_frames_are_refused(scene, tmp_path, monkeypatch, capsys, more, sentence):
    out = tmp_path / "out"
    refused(monkeypatch, capsys, out, complete(scene, out, **more), sentence)


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (("--near", 5, "--far", 1), "near"),
        (("--auto", 2), "--target and --auto are both given; use one of them"),
        (("--auto",), "again with the other.\n"),
        (("--near", 0), "near"),
        (("--generator", "oracle", "--generator=oracle"), "--generator is given twice"),
        (("--near", -1), "near"),
        (("--far", "nan"), "far"),
        (("--resolution", 0, 64), "resolution"),
        (("--resolution", 4, 64), "at least 16"),
        (("--config", "papper"), "no config 'papper'"),
        (("--generator", "dall-e"), "no generator 'dall-e'"),
        (("--reconstructor", "nerf"), "no reconstructor 'nerf'"),
        (("--scene", "nowhere.ply"), "nowhere.ply"),
        (("--seed", -1), "seed must be greater than or equal to 0, got -1 (--seed)."),
        (("--seed", 2**64), "seed must be less than 4611686018427387904"),
        (("--seed", 1.5), "--seed takes a whole number, and was given '1.5' (see gscompleter "),
        (("--sed", 1), "nearest is --seed INT (see gscompleter complete --help)."),
        (("a", "--sed"), "options: a, --sed; the nearest is --seed INT (see gscompleter complete"),
        (("--drop_nonfinit",), "options: --drop_nonfinit; the nearest is --drop-nonfinite (see"),
        (("--qwertz", 1), "Unrecognized options: --qwertz, 1 (see gscompleter complete --help)."),
        (("--depth", "none", "moge-2"), "moge-2 belongs to no option of complete, and"),
        (("--config.registration.hole-deptth", 1), "nearest is --config.registration.hole-depth"),
        (("--device", "tpu"), "--device takes auto, cpu, cuda or mps, and was given 'tpu' ("),
        (("--near", "a" * 5000), "aaa…aaa"),
        (("--config",), "--config takes a text, and none was given (see gscompleter "),
        (("--config", "c" * 5000), "no config 'ccc"),
        (("--config", "nowhere.yaml"), "nowhere.yaml"),
        (("--config.margin", 1e9), "got 1000000000.0 (--config.margin)."),
        (("--config.margin", "nan"), "config.margin must be a finite number"),
        (("--config.holes.max-alpha", 2), "config.holes.max_alpha must be less than or equal to 1"),
        (("--config.registration.iterations", 10**12), "(--config.registration.iterations)."),
        (("--config.registration.iterations", "many"), "'many'"),
        (("--config.registration.speed", 1), "--config.registration.speed"),
        (("--config.registration.hole-depth", "round"), "'round'"),
        (
            ("--config.paper-registration.iterations", 7),
            "gscompleter: The settings paper_registration are changed",
        ),
        (("--generator-steps", 8, "--generator", "oracle"), "choose pe-field or diffusers-inp"),
        (("--generator-steps", 0, "--generator", "pe-field"), "got 0 (--generator-steps)."),
        (("--generator-steps", "few"), "'few'"),
    ],
)
def test_wrong_options_are_refused(scene, tmp_path, monkeypatch, capsys, more, sentence):
    out = tmp_path / "out"
    refused(monkeypatch, capsys, out, complete(scene, out, *more), sentence)


def test_pillow_warns_of_no_damage_that_a_sentence_tells(
    scene, tmp_path, monkeypatch, capsys, recwarn
):
    damaged = shutil.copytree(scene, tmp_path / "damaged")
    description = struct.pack("<IHHHII", 8, 1, 270, 2, 10**6, 8)  # longer than the file
    (damaged / "0.png").write_bytes(b"II*\0" + description + bytes(4))
    out = tmp_path / "out"
    refused(monkeypatch, capsys, out, complete(damaged, out), "0.png is not an image")
    assert [warning.filename for warning in recwarn if "PIL" in warning.filename] == []


@pytest.mark.parametrize("words", [(), ("compleat",), ("complete",), ("models", "--all"), ("--x",)])
def test_what_is_no_command_gets_a_sentence_too(monkeypatch, capsys, words):
    assert run(monkeypatch, *words) == 2
    said = capsys.readouterr()
    assert said.err.startswith("gscompleter: ")
    assert said.err.count("\n") == 1
    assert "--help)." in said.err
    assert said.out == ""


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ("evaluate", "a", "--out", "b", "--overwrite"),
            "evaluate has no option --overwrite, which belongs to complete, live, update and 9 "
            "more; evaluate continues the run in its folder (see gscompleter evaluate --help).",
        ),
        (
            ("evaluate", "a", "--target=3"),
            "evaluate has no option --target, which belongs to complete, remove, repair (see",
        ),
        (("view", "a", "--out", "b"), "view has no option --out, which belongs to complete, "),
        (
            ("complete", "a", "--out", "b", "--wrokers", "3"),  # of batch
            "Unrecognized options: --wrokers, 3 (see gscompleter complete --help).",
        ),
        (
            ("inspect", "a", "--config", "bare"),
            "inspect has no option --config, which belongs to complete, live, update and 2 more",
        ),
        (("complete", "a", "--out", "b", "--confg", "bare"), "; the nearest is --config STR"),
    ],
)
def test_an_option_of_another_command_is_told_as_such(monkeypatch, capsys, words, sentence):
    assert run(monkeypatch, *words) == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("number", "sentence"),
    [
        ("-3", "auto must be greater than or equal to 1, got -3 (--auto)."),
        *(
            (number, f"--auto takes a whole number, and was given '{number}' (see gscompleter")
            for number in ("2.5", ".5", "5.", "1e1", "-.5", "-1e1")
        ),
    ],
)
def test_a_wrong_number_of_targets_is_told_as_that_of_its_option(
    monkeypatch, capsys, number, sentence
):
    assert run(monkeypatch, "complete", "a", "--auto", number, "--out", "b") == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            "view a --up 0 1",
            "--up takes 3 numbers, and 2 were given (see gscompleter view --help).",
        ),
        ("inspect a --resolution 48 64 32", "--resolution takes 2 whole numbers, and 3 were given"),
        (
            "complete a --out b --resolution 48 64 32",
            "--resolution takes 2 whole numbers, a whole number or full, and 3 were given (see",
        ),
        ("complete a --out b --resolution", "or full, and none was given (see"),
        ("complete a --out b --resolution 4 x", "or full, and was given '4 x' (see"),
        ("convert a b --rotate=0 90", "--rotate takes 3 numbers (X Y Z), and 2 were given (see"),
        ("convert a b --rotate 0 -90 x", "3 numbers (X Y Z), and was given '0 -90 x' (see"),
        ("convert a b --crop_sphere 1 --plain", "numbers (X Y Z RADIUS), and 1 was given (see"),
        ("convert a b --bands 7", "--bands takes 0, 1, 2 or 3, and was given '7' (see"),
    ],
)
def test_wrong_values_of_an_option_are_told_without_types(monkeypatch, capsys, words, sentence):
    assert run(monkeypatch, *words.split()) == 2
    assert sentence in capsys.readouterr().err


LONG_PATH = "/".join(["reconstructions"] * 8)


@pytest.mark.parametrize(
    ("word", "sentence"),
    [(LONG_PATH, LONG_PATH), ("--renderer-device", "takes cpu or cuda, and none was given")],
)
def test_an_error_is_whole_however_narrow_the_terminal_is(monkeypatch, capsys, word, sentence):
    monkeypatch.setenv("COLUMNS", "40")
    assert run(monkeypatch, "complete", "a", "--out", "b", word) == 2
    assert sentence in capsys.readouterr().err
    assert os.environ["COLUMNS"] == "40"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("complete a --resolutoin 256", "Missing from gscompleter complete: --out PATH"),
        ("complete a --out b --frames x", "--frames takes a whole number, and was given 'x'"),
        ("complete --frames --help", "--frames takes a whole number, and none was given"),
    ],
)
def test_an_error_on_a_terminal_is_a_plain_sentence(words, sentence):
    code, shown = run_on_terminal(*words.split())
    assert code == 2
    assert shown.split() == f"gscompleter: {sentence} (see gscompleter complete --help).".split()


def test_a_help_page_on_a_terminal_has_its_colours():
    code, shown = run_on_terminal("doctor", "--help")
    assert code == 0
    assert shown.startswith("\x1b[1musage:")


@pytest.mark.parametrize("word", ["compleat", "--verson"])
def test_the_commands_are_named_in_place_of_an_unknown_one(monkeypatch, capsys, word):
    assert run(monkeypatch, word) == 2
    assert f"no command {word}; choose one of complete, batch, live," in capsys.readouterr().err


def test_a_splat_in_place_of_the_photographs_is_sent_to_its_option(tmp_path, monkeypatch, capsys):
    splat, out = tmp_path / "a.ply", tmp_path / "out"
    splat.write_bytes(b"ply\n")
    told = "which goes to --scene; SCENE has to be the folder of its photographs"
    words = ("clean", splat, "--scene", splat, "--out", out)
    refused(monkeypatch, capsys, out, words, told)


def test_a_splat_that_is_not_there_is_told_as_missing(tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    refused(
        monkeypatch, capsys, out, ("complete", "none.ply", "--out", out), "There is no none.ply"
    )


def config_of(scene, tmp_path, monkeypatch, *more) -> CompleterConfig:
    """Return the settings of a command."""
    words = [str(word) for word in complete(scene, tmp_path / "out", *more)]
    return parse_command(words).config.decide(is_splat=False, has_photographs=True)


def test_single_settings_are_applied_over_those_that_are_named(scene, tmp_path, monkeypatch):
    assert config_of(scene, tmp_path, monkeypatch) == CompleterConfig()
    one = ("--config.registration.iterations", 7)
    config = config_of(scene, tmp_path, monkeypatch, *one)
    assert config == replace(
        CompleterConfig(), registration=replace(CompleterConfig().registration, iterations=7)
    )
    paper = CompleterConfig.paper()
    one = ("--config.paper-registration.iterations", 7)
    config = config_of(scene, tmp_path, monkeypatch, *one, "--config", "paper")
    changed = replace(paper.paper_registration, iterations=7)
    assert config == replace(paper, paper_registration=changed)
    file = tmp_path / "mine.yaml"
    file.write_text("base: paper\nmargin: 0.1\n")
    changes = ("--config.psnr-guard.max-drop", 0.5, "--config.paper_registration.rgb_weight", "0.2")
    config = config_of(scene, tmp_path, monkeypatch, f"--config={file}", *changes)
    assert (config.margin, config.psnr_guard.max_drop) == (0.1, 0.5)
    assert config.paper_registration == replace(paper.paper_registration, rgb_weight=0.2)


def test_a_single_setting_reaches_the_completion_and_its_summary(told_by_the_oracle):
    config = json.loads((told_by_the_oracle / "summary.json").read_text())["settings"]["config"]
    assert config["registration"]["iterations"] == 3
    assert config["alignment"]["align_at"] == "none"


def test_the_options_of_a_generator_are_its_settings(scene, tmp_path):
    words = ("--generator", "pe-field", "--generator-weights", "a/b", "--generator-steps", 8)
    words += (
        "--generator-retries",
        2,
        "--generator-depth",
        "monocular",
        "--generator-batch-size",
        3,
    )
    options = parse_command(
        [str(w) for w in complete(scene, tmp_path, *words, "--generator-offload")]
    )
    assert options.synthesis.make_settings() == PEFieldSettings("a/b", 2, True, 8, "monocular", 3)
    words = ("--generator", "diffusers-inpaint", "--generator-prompt", "a quiet street")
    options = parse_command([str(word) for word in complete(scene, tmp_path, *words)])
    assert options.synthesis.make_settings() == DiffusersInpaintSettings(prompt="a quiet street")
    options = parse_command([str(word) for word in complete(scene, tmp_path)])
    assert options.synthesis.make_settings() == GeneratorSettings()


OPTIONS_OF_ROWS = {
    "--generator",
    *(f"--generator-{name.replace('_', '-')}" for row in GENERATORS.values() for name in row.help),
}
"""Options whose help grows with each row of the table of generators."""


def count_lines(page: str) -> int:
    """Count the lines of a help page without those that rows of generators bring."""
    count = 0
    option = ""
    for line in page.splitlines():
        named = re.match(r"(?:  |│ )(--[a-z-]+)", line)
        if named is not None:
            option = named[1]
        elif not line.startswith(("│   ", "    ")):  # no further line of its help
            option = ""
        count += option not in OPTIONS_OF_ROWS
    return count


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_every_option_and_one_for_the_settings(monkeypatch, capsys, command):
    monkeypatch.setenv("COLUMNS", "100")
    assert run(monkeypatch, command, "--help") == 0
    said = capsys.readouterr().out
    assert count_lines(said) < 165
    assert "None" not in said
    shown = set(re.findall(r"^(?:  |│ )(?:-h, )?(--[a-z-]+)", said, re.MULTILINE))
    kind = OptionClasses()[command]
    known = {f"--{f.name.replace('_', '-')}" for f in fields(kind) if "Positional" not in f.type}
    positive = known - {"--ego-mask", "--masks", "--synthesis"}
    assert positive - shown <= {"--config"}
    assert run(monkeypatch, command, "--help-all") == 0
    said = capsys.readouterr().out
    full = set(re.findall(r"^(?:  |│ )(?:-h, )?(--[a-z.-]+)", said, re.MULTILINE))
    assert shown - {"--config"} <= full
    assert not any(option.startswith("--config.") for option in shown)


@pytest.mark.parametrize("words", [("--help-all",), ("doctor", "--help-all"), ("-h",)])
def test_every_command_has_both_kinds_of_help(monkeypatch, capsys, words):
    assert run(monkeypatch, *words) == 0
    assert capsys.readouterr().out.startswith("usage: gscompleter")


def test_the_page_of_all_commands_is_plain_where_the_output_has_no_boxes(monkeypatch):
    """A pipe on Windows has an encoding of few characters."""
    bytes_out = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(bytes_out, encoding="cp1252"))
    assert run(monkeypatch, "--help") == 0
    sys.stdout.flush()
    page = bytes_out.getvalue().decode("cp1252")
    assert page.isascii()
    assert "+- options ---" in page
    assert "  * complete  Fill the parts" in page


@pytest.mark.parametrize("word", ["--help", "-h", "--help-all"])
def test_help_is_no_name_of_a_config(monkeypatch, capsys, word):
    assert run(monkeypatch, "complete", word) == 0
    page = capsys.readouterr().out
    assert run(monkeypatch, "complete", "--config", word) == 0
    assert capsys.readouterr().out == page


def test_help_all_knows_every_setting(monkeypatch, capsys):
    assert run(monkeypatch, "complete", "--help-all") == 0
    said = capsys.readouterr().out
    for kind in (PEFieldSettings, DiffusersInpaintSettings):
        assert all(f"--generator-{f.name.replace('_', '-')}" in said for f in fields(kind))
    assert "--config.alignment.min-agreement" in said
    assert "Further seeds to try if" in said


@pytest.mark.parametrize(
    ("command", "adapt"),
    [
        ("update", lambda config: config),
        ("remove", CompleterConfig.for_removal),
        ("repair", CompleterConfig.for_marks),
    ],
)
def test_help_of_a_command_for_splats_shows_the_settings_that_it_has(
    monkeypatch, capsys, command, adapt
):
    monkeypatch.setenv("COLUMNS", "100")
    assert run(monkeypatch, command, "--help-all") == 0
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    config = adapt(load_config("default", is_splat=True))
    for name, value in (
        ("trust", config.trust),
        ("guards", " ".join(config.guards)),
        ("holes.max-alpha", config.holes.max_alpha),
    ):
        text = said.partition(f"--config.{name} ")[2].partition(" --config.")[0]
        assert f"(default: {value})" in text
    # Of what is off by default, pages say nothing.
    text = said.partition("--config.holes.forces-removed ")[2].partition(" --config.")[0]
    assert ("(default: True)" in text) == config.holes.forces_removed


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_refused(scene, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    refused(
        monkeypatch,
        capsys,
        out,
        complete(scene, out, "--device", "cuda"),
        "choose the device cpu (--device)",
    )


def test_a_missing_folder_is_refused(tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    refused(monkeypatch, capsys, out, complete(tmp_path / "nowhere", out), "nowhere")


def _without_baseline(content: dict) -> None:
    content["frames"][1]["transform_matrix"] = content["frames"][0]["transform_matrix"]


def _mirrored(content: dict) -> None:
    pose = np.array(content["frames"][0]["transform_matrix"])
    pose[:3, 0] *= -1
    content["frames"][0]["transform_matrix"] = pose.tolist()


def _sheared(content: dict) -> None:
    content["frames"][0]["transform_matrix"][0][1] = 0.5


def _without_frames(content: dict) -> None:
    content["frames"] = []


def _without_focal(content: dict) -> None:
    for entry in (content, *content["frames"]):
        for key in ("fl_x", "fl_y"):
            if key in entry:
                entry[key] = -1.0


def _missing_image(content: dict) -> None:
    content["frames"][0]["file_path"] = "00_gone.png"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (_without_baseline, "baseline"),
        (_mirrored, "reflection"),
        (_sheared, "rigid"),
        (_without_frames, "frames"),
        (_without_focal, "fl_x"),
        (_missing_image, "00_gone.png"),
    ],
)
def test_a_wrong_scene_is_refused(scene, tmp_path, monkeypatch, capsys, change, sentence):
    out = tmp_path / "out"
    folder = broken_scene(scene, tmp_path / "scene", change)
    refused(monkeypatch, capsys, out, complete(folder, out), sentence)


@pytest.mark.parametrize("content", [b"", b"no image at all", None])
def test_a_damaged_photograph_is_refused(scene, tmp_path, monkeypatch, capsys, content):
    folder = broken_scene(scene, tmp_path / "scene", lambda content: None)
    whole = (folder / "0.png").read_bytes()
    (folder / "0.png").write_bytes(whole[: len(whole) // 2] if content is None else content)
    out = tmp_path / "out"
    refused(monkeypatch, capsys, out, complete(folder, out), "0.png")


def test_a_ply_with_nan_is_refused_with_a_count_unless_they_are_dropped(
    scene, completed, tmp_path, monkeypatch, capsys
):
    """`clean` reads a splat as `complete` does."""
    gaussians = load_ply(completed / "context.ply")
    damaged, out = tmp_path / "damaged.ply", tmp_path / "out"
    content = plyfile.PlyData.read(completed / "context.ply")
    content["vertex"].data["x"][:3] = float("nan")
    content.write(damaged)
    arguments = complete(scene, out, *SMALL, "--scene", damaged)
    refused(monkeypatch, capsys, out, arguments, "--drop-nonfinite")
    words = ("clean", "--scene", damaged, "--out", out, "--drop-nonfinite", "--quiet")
    assert run(monkeypatch, *words) == 0
    counts = json.loads((out / "summary.json").read_text())["gaussians"]
    assert counts["kept"] + counts["removed"] == len(gaussians) - 3


def test_a_folder_with_something_in_it_is_kept_unless_overwritten(
    scene, completed, tmp_path, monkeypatch, capsys
):
    """`clean` writes its results as `complete` does."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("precious")
    assert run(monkeypatch, *complete(scene, out)) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert [p.name for p in out.iterdir()] == ["mine.txt"]
    words = ("clean", "--scene", completed / "context.ply", "--out", out, "--quiet")
    assert run(monkeypatch, *words) == 2
    assert [p.name for p in out.iterdir()] == ["mine.txt"]
    assert run(monkeypatch, *words, "--overwrite") == 0
    assert (out / "completed.ply").exists()
    assert (out / "mine.txt").read_text() == "precious"


def gscompleter(*arguments) -> subprocess.Popen:
    """Start the command in a process of its own."""
    command = [sys.executable, "-c", "from gscompleter.cli import main; main()"]
    return subprocess.Popen(
        [*command, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.parametrize("words", [["--help"], ["complete", "--help"], ["evaluate", "--help-all"]])
def test_help_does_not_wait_for_torch(words):
    code = (
        f"import sys; sys.argv = ['gscompleter', *{words}]\n"
        "from gscompleter.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'numba', 'cv2', 'skimage', 'numpy', 'pydantic', 'typeguard'}\n"
        "heavy &= set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "complete" in done.stdout


def num_written(folder: Path) -> int:
    """Count files and folders with a dot in their names, in a folder that others write to."""
    return sum("." in name for _, *names in os.walk(folder) for name in chain(*names))


# `tests/system/files/test_output_folder.py` kills smaller processes.
@pytest.mark.slow
@pytest.mark.linux
@pytest.mark.skipif(os.name != "posix", reason="kills with a POSIX signal")
@pytest.mark.parametrize("written", [2, 8])
def test_a_kill_leaves_no_half_written_scene(scene, tmp_path, written):
    """The process is killed after it has begun to write this many files and folders."""
    out = tmp_path / "out"
    process = gscompleter(*complete(scene, out, *SMALL))
    while process.poll() is None and num_written(tmp_path) < written:
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    for name in ("completed.ply", "context.ply"):
        if (out / name).exists():
            assert len(load_ply(out / name)) > 0
    if out.exists():
        json.loads((out / "summary.json").read_text())


def test_a_target_that_sees_nothing_ends_in_a_sentence(room, tmp_path, monkeypatch, capsys):
    away, out = tmp_path / "away.json", tmp_path / "out"
    write_cameras(away, [camera_at(0.0, yaw=180, size=48)])
    frames = ("--context", 0, 1, "--out", out, *SMALL)
    assert run(monkeypatch, "complete", room, *frames, "--target", away) == 2
    said = capsys.readouterr().err
    assert "sees surfaces of the scene in 0.0% of its image" in said
    assert not out.exists()


# `test_completer.py` completes a target beside one that sees nothing.
@pytest.mark.slow
def test_a_target_that_sees_nothing_beside_others_is_in_the_summary(room, tmp_path, monkeypatch):
    away, out = tmp_path / "away.json", tmp_path / "out"
    write_cameras(away, [camera_at(0.0, yaw=180, size=64)])
    frames = ("--context", 0, 1, "--near", 0.5, "--far", 20, "--out", out, "--quiet")
    assert run(monkeypatch, "complete", room, *frames, "--target", 2, away) == 0
    first, second = json.loads((out / "summary.json").read_text())["targets"]
    assert first["refused"] is None
    assert "at least 2% are needed" in second["refused"]
    assert second["added"] == 0
