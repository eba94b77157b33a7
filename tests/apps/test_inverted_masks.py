"""Masks the other way round stop every command before it computes; `--invert-masks` turns them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from command import run
from gscompleter import save_ply
from gscompleter.data.scene import write_cameras
from gscompleter.evaluation.verdict.numbers import describe_measured
from gscompleter.evaluation.verdict.outcome import describe_gain
from gscompleter.evaluation.verdict.rows import HeldOutRow
from gscompleter.system.files.image import write_image
from scenes import Room, camera_at, gaussians_of, photographed, view_of

SIZE = 48
CAMERAS = [camera_at(x, size=SIZE) for x in (-0.3, 0.0, 0.3)]
WAYS_OUT = "if it is the other way round, add --invert-masks; if it is meant so, add --large-masks"
SPOT = (slice(18, 32), slice(16, 34))
"""Rows and columns of something in the photographs."""


def paint_spot(is_inverted: bool) -> torch.Tensor:
    mask = torch.full((SIZE, SIZE), float(is_inverted))
    mask[SPOT] = 1.0 - mask[SPOT]
    return mask


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """Write photographs with and without masks, a splat, and masks of what is to go."""
    home = tmp_path_factory.mktemp("inverted")
    photographed(home / "plain", CAMERAS)
    # White on something to be ignored, as programs of segmentation write it.
    scene = photographed(home / "masked", CAMERAS)
    (scene / "masks").mkdir()
    for number in range(len(CAMERAS)):
        write_image(scene / "masks" / f"{number}.png", paint_spot(is_inverted=False))
    save_ply(home / "splat.ply", gaussians_of(view_of(Room(), CAMERAS[1])))
    write_cameras(home / "camera.json", [CAMERAS[1]])
    kinds = {
        "right": paint_spot(False),
        "wrong": paint_spot(True),
        "black": torch.zeros(SIZE, SIZE),
    }
    labels = torch.zeros(SIZE, SIZE)
    labels[SPOT] = 0.5
    labels[:8] = 1.0
    for kind, mask in (kinds | {"labels": labels}).items():
        (home / kind).mkdir()
        write_image(home / kind / "1.png", mask)
    return home


SPLAT = ("--scene", "splat.ply")
COMMANDS = {
    "complete": ("complete", "masked", "--context", 0, 1, "--target", 2),
    "update": ("update", "masked", *SPLAT),
    "clean": ("clean", "masked", *SPLAT),
    "remove": ("remove", "masked", *SPLAT, "--sphere", 0, 0, 3, 1),
    "repair": ("repair", "masked", *SPLAT, "--target", "camera.json", "--mask", "right/1.png"),
    "evaluate": ("evaluate", "masked", "--protocol", "n-1"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_masks_of_photographs_stop_every_command(name, home, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(home)
    assert run(monkeypatch, *COMMANDS[name], "--out", tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert "Masks hide 89 % of the photographs (masked/masks), where what is black is" in said
    # Beside `--mask` the option turns the masks of that.
    assert (WAYS_OUT in said) == (name != "repair")
    assert "Traceback" not in said
    assert not (tmp_path / "out").exists()


def test_the_search_for_cameras_does_not_begin(home, monkeypatch, capsys, tmp_path):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    bare = tmp_path / "bare"
    for name in ("0.png", "1.png", "2.png", "masks/0.png", "masks/1.png", "masks/2.png"):
        (bare / name).parent.mkdir(parents=True, exist_ok=True)
        (bare / name).write_bytes((home / "masked" / name).read_bytes())
    for words in (("poses", bare), ("complete", bare)):
        assert run(monkeypatch, *words, "--out", tmp_path / "out") == 2
        assert "Masks hide 89 % of the photographs" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        ("wrong", f"select 89 % of the photographs, where what is white goes; {WAYS_OUT}"),
        ("black", "is black everywhere, and what masks show white goes; paint white what is to go"),
        ("labels", "is no mask of black and white but a map of labels: beside its darkest and its"),
    ],
)
def test_masks_of_what_goes_stop_a_removal(kind, sentence, home, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(home)
    words = ("remove", "plain", *SPLAT, "--mask", kind, "--out", tmp_path / "out")
    assert run(monkeypatch, *words) == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize("command", ["complete", "repair"])
@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        ("wrong", "select 89 % of the images of their cameras, where what is white g"),
        ("black", "black/1.png is black everywhere, and what masks show white goes; paint white"),
        ("labels", "labels/1.png is no mask of black and white but a map of labels"),
    ],
)
def test_marks_stop_a_repair(command, kind, sentence, home, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(home)
    words = (command, "splat.ply", "--target", "camera.json", "--mask", f"{kind}/1.png")
    assert run(monkeypatch, *words, "--out", tmp_path / "out") == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.slow
def test_inverted_masks_remove_and_repair_what_right_ones_do(home, monkeypatch, tmp_path):
    monkeypatch.chdir(home)
    near = ("--near", 0.5, "--far", 20, "--quiet")
    commands = {
        "remove": ("remove", "plain", *SPLAT, "--target", 1, *near, "--mask"),
        "repair": ("repair", "splat.ply", "--target", "camera.json", *near, "--mask"),
    }
    for name, words in commands.items():
        place = "{}/1.png" if name == "repair" else "{}"
        for kind, more in (("right", ()), ("wrong", ("--invert-masks",))):
            out = tmp_path / f"{name}-{kind}"
            assert run(monkeypatch, *words, place.format(kind), *more, "--out", out) == 0
        results = [tmp_path / f"{name}-{kind}" / "completed.ply" for kind in ("right", "wrong")]
        assert results[0].read_bytes() == results[1].read_bytes()
    settings = json.loads((out / "summary.json").read_text())["settings"]
    assert settings["invert_masks"]
    assert not settings["large_masks"]


def test_a_selection_of_most_of_the_splat_is_asked_about(home, monkeypatch, capsys, tmp_path):
    """Less than half of the photographs, but most of the Gaussians."""
    monkeypatch.chdir(home)
    camera = CAMERAS[1]
    small = gaussians_of(view_of(Room(), camera))
    rows = torch.arange(len(small)).reshape(SIZE, SIZE)[10:38, 10:40].flatten()
    save_ply(tmp_path / "small.ply", small[rows])
    words = ("repair", tmp_path / "small.ply", "--target", "camera.json", "--mask", "half.png")
    mask = torch.zeros(SIZE, SIZE)
    mask[8:38, 12:40] = 1.0
    write_image(home / "half.png", mask)
    assert run(monkeypatch, *words, "--out", tmp_path / "out") == 2
    assert "of the Gaussians of the splat, where what is white goes" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("complete", "plain"), "No mask is used for the photographs that could be read the other"),
        (("complete", "masked", "--no-masks"), "--no-masks leaves out the masks that would be re"),
        (("complete", "splat.ply"), "no --mask is given; leave it out"),
        (("evaluate", "plain", "--protocol", "n-1"), "No scene has masks that could be read"),
    ],
)
def test_an_inversion_of_nothing_is_refused(words, sentence, home, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(home)
    assert run(monkeypatch, *words, "--invert-masks", "--out", tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert "--invert-masks" in said


def test_masks_of_photographs_are_inverted_or_taken_as_they_are(
    home, monkeypatch, capsys, tmp_path
):
    monkeypatch.chdir(home)
    words = ("complete", "masked", "--context", 0, 1, "--target", 2, "--dry-run")
    for option, share in (("--invert-masks", "10.9 %"), ("--large-masks", "89.1 %")):
        assert run(monkeypatch, *words, option, "--out", tmp_path / option[2:]) == 0
        lines = capsys.readouterr().err.splitlines()
        (line,) = [line for line in lines if line.startswith("Masks:")]
        assert f"what they hide, up to {share} of a photograph" in line


def test_a_headline_names_the_share_that_was_measured():
    def describe(*unmasked: float) -> str:
        rows = [
            HeldOutRow(number, 18.69, 29.43, 0.5, 0.9, unmasked=share)
            for number, share in enumerate(unmasked)
        ]
        return describe_gain("The scene is completed", rows)

    assert describe(0.24) == (
        "The scene is completed: the unused photograph 0 gains 10.7 dB where the scene covers "
        "it (18.69 dB before, 29.43 dB after, over the 24 % of the picture that masks leave)"
    )
    assert "over the 50 % of the picture that masks leave" in describe(0.2, 0.8)
    assert "masks" not in describe(1.0, 0.95)
    assert describe_measured([0.95, 0.95]) == ""
