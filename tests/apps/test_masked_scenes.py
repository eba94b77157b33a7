"""Masks in every command: what they hide is neither reconstructed nor scored."""

from __future__ import annotations

import json
import shutil
from collections import UserDict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from command import run
from exact_room import ExactCamera, make_cameras, write_colmap, write_transforms
from gscompleter import InputError, load_ply
from gscompleter.apps.inputs.reading import read_photographs
from gscompleter.apps.inputs.task import Opened
from gscompleter.apps.requests.scene import SceneRequest
from gscompleter.data.formats import open_photographs
from gscompleter.evaluation.store import list_row_paths
from gscompleter.system.files.image import read_pixels

WIDTH, HEIGHT = 96, 72
HIDDEN_ROWS = HEIGHT // 4
SIZE = ("--resolution", HEIGHT, WIDTH)


def small_cameras() -> list[ExactCamera]:
    return make_cameras(8, width=WIDTH, height=HEIGHT, focal=78.0)


def spoil_with_masks(scene: Path) -> None:
    """Show something else in the upper quarter of each photograph, and mask it."""
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:HIDDEN_ROWS] = 0
    (scene / "masks").mkdir()
    for number, path in enumerate(sorted((scene / "images").iterdir())):
        pixels = read_pixels(path).copy()
        pixels[:HIDDEN_ROWS] = np.random.default_rng(number).integers(0, 255, 3)
        Image.fromarray(pixels).save(path)
        Image.fromarray(mask).save(scene / "masks" / path.name)


def make_transparent(scene: Path) -> None:
    """Make the upper quarter of each photograph transparent, over black."""
    for path in (scene / "images").iterdir():
        pixels = np.dstack([read_pixels(path), np.full((HEIGHT, WIDTH), 255, np.uint8)])
        pixels[:HIDDEN_ROWS] = 0
        Image.fromarray(pixels).save(path)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> dict[str, Path]:
    """Write the room with nothing in the way, with masks, and with an alpha channel."""
    home = tmp_path_factory.mktemp("masked")
    cameras = small_cameras()
    found = {
        "whole": write_colmap(home / "whole", cameras, n_points=300),
        "masks": write_colmap(home / "masks", cameras, n_points=300),
        "alpha": write_transforms(home / "alpha", cameras),
    }
    spoil_with_masks(found["masks"])
    make_transparent(found["alpha"])
    return found


class Completed(UserDict[str, Path]):
    """Completions of the scenes for the same target, each made when it is first asked for."""

    def __init__(self, scenes: dict[str, Path], home: Path) -> None:
        super().__init__()
        self.scenes, self.home = scenes, home

    def __missing__(self, kind: str) -> Path:
        words = ("--context", 1, 3, "--target", 5, *SIZE, "--quiet", "--out", self.home / kind)
        with pytest.MonkeyPatch.context() as monkeypatch:
            assert run(monkeypatch, "complete", self.scenes[kind], *words) == 0
        self[kind] = self.home / kind
        return self[kind]


@pytest.fixture(scope="module")
def completed(scenes, tmp_path_factory) -> Completed:
    return Completed(scenes, tmp_path_factory.mktemp("completed"))


def read_summary(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


def compute_lower_psnr(out: Path) -> float:
    """Compute PSNR at the target below what is masked, in dB."""
    truth = make_cameras(8, width=WIDTH, height=HEIGHT, focal=78.0)[5].photograph
    image = read_pixels(out / "images" / "target1_after.png")
    error = (image[HIDDEN_ROWS:].astype(float) - truth[HIDDEN_ROWS:]) / 255
    return -10 * np.log10(np.square(error).mean())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["masks", "alpha"])
def test_what_is_masked_changes_nothing_beside_it(completed, kind):
    """The rest is completed as well as without anything in the way, and only it is scored."""
    summary = read_summary(completed[kind])
    assert [row["ignored"] for row in summary["context"]] == [0.25, 0.25]
    (target,) = summary["targets"]
    lower = compute_lower_psnr(completed[kind])
    assert target["psnr_after"] == pytest.approx(lower, abs=0.1)
    assert lower > compute_lower_psnr(completed["whole"]) - 0.6
    assert min(row["psnr_after"] for row in summary["context"]) > 30
    assert [row["ignored"] for row in read_summary(completed["whole"])["context"]] == [0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["masks", "alpha"])
def test_no_gaussian_is_made_of_what_is_masked(completed, kind):
    """Each pixel of a context photograph makes one Gaussian, unless it is masked."""
    whole = len(load_ply(completed["whole"] / "context.ply"))
    assert len(load_ply(completed[kind] / "context.ply")) == 0.75 * whole


def test_the_page_shows_what_is_ignored(completed, completed_room):
    page = (completed["masks"] / "report.html").read_text()
    assert "Photograph 1 (photo_001.png): 25.0 % of the image is ignored" in page
    # The headline says what its scores were measured on.
    measured = "dB after, over the 75 % of the picture that masks leave"
    assert measured in page
    assert measured in read_summary(completed["masks"])["outcome"]["headline"]
    assert "masks leave" not in (completed_room / "report.html").read_text()
    assert "Photograph" in page
    ignored = read_pixels(completed["masks"] / "images" / "context1_ignored.png")
    assert (ignored[:HIDDEN_ROWS] == (255, 0, 255)).all()


@pytest.mark.slow
def test_one_line_says_what_was_found(scenes, tmp_path, monkeypatch, capsys):
    words = ("--context", 1, 3, "--target", 5, *SIZE, "--dry-run")
    for kind, said in (("masks", "masks of 3 photographs"), ("alpha", "the alpha channel of 3")):
        assert run(monkeypatch, "complete", scenes[kind], *words, "--out", tmp_path / kind) == 0
        lines = capsys.readouterr().err.splitlines()
        (line,) = [line for line in lines if line.startswith("Masks:")]
        assert said in line
        assert "25.0 %" in line
    assert run(monkeypatch, "complete", scenes["whole"], *words, "--out", tmp_path / "whole") == 0
    assert "Masks:" not in capsys.readouterr().err


def test_a_plan_leaves_masks_out_on_request(scenes, tmp_path, monkeypatch, capsys):
    words = ("--context", 1, 3, "--target", 5, *SIZE, "--dry-run", "--no-masks")
    assert run(monkeypatch, "complete", scenes["masks"], *words, "--out", tmp_path) == 0
    assert "Masks:" not in capsys.readouterr().err


# The plan before leaves them out, too.
@pytest.mark.slow
def test_masks_are_left_out_on_request(scenes, tmp_path, monkeypatch):
    words = ("--context", 1, 3, "--target", 5, *SIZE, "--quiet", "--no-masks", "--out", tmp_path)
    # What the masks hid contradicts the other photographs: the scene does not reconstruct.
    assert run(monkeypatch, "complete", scenes["masks"], *words) == 1
    summary = read_summary(tmp_path)
    assert summary["outcome"]["status"] == "not-reconstructed"
    assert [row["ignored"] for row in summary["context"]] == [0, 0]
    assert summary["targets"][0]["psnr_after"] < 18


def test_a_context_photograph_that_is_hidden_is_not_chosen(scenes, tmp_path, monkeypatch, capsys):
    scene = write_transforms(tmp_path / "scene", small_cameras()[:5])
    (scene / "masks").mkdir()
    for number in (1, 2):
        black = Image.new("L", (WIDTH, HEIGHT))
        black.save(scene / "masks" / f"photo_{number:03d}.png")
    words = ("complete", scene, "--target", 4, *SIZE, "--quiet", "--dry-run")
    assert run(monkeypatch, *words, "--out", tmp_path / "a") == 0
    assert run(monkeypatch, *words, "--context", 0, 1, "--out", tmp_path / "b") == 2
    assert "All of frame 1 of scene (images/photo_001.png) is masked" in capsys.readouterr().err

    # `clean` takes all photographs but these, unless it is told which.
    photographs = open_photographs(scene)
    opened = Opened(SceneRequest(scene), photographs, "nerfstudio", len(photographs))
    assert read_photographs(opened, None, "cpu").context_frames == (0, 3, 4)
    with pytest.raises(InputError, match="All of frame 1 of scene"):
        read_photographs(opened, (0, 1), "cpu")


def test_photographs_of_which_none_can_be_used_have_their_reason(tmp_path):
    scene = write_transforms(tmp_path / "scene", small_cameras()[:3])
    (scene / "masks").mkdir()
    for photograph in (scene / "images").iterdir():
        Image.new("L", (WIDTH, HEIGHT)).save(scene / "masks" / photograph.name)
    photographs = open_photographs(scene)
    opened = Opened(SceneRequest(scene), photographs, "nerfstudio", len(photographs))
    with pytest.raises(InputError, match="Masks hide all of each photograph of .*add --no-masks"):
        read_photographs(opened, None, "cpu")
    shutil.rmtree(scene / "images")
    opened = replace(opened, photographs=open_photographs(scene))
    with pytest.raises(InputError, match=r"None of the 3 photographs .* 3 are missing \(images/ph"):
        read_photographs(opened, None, "cpu")


def read_scores(out: Path) -> dict:
    (path,) = list_row_paths(out)
    return json.loads(path.read_text())["steps"][0]["scores"]


# `test_cases_read_masks` reads them, and the plan above leaves them out.
@pytest.mark.slow
def test_evaluate_reads_masks_unless_told_otherwise(scenes, tmp_path, monkeypatch, capsys):
    words = ("--protocol", "n-2", "--limit", 1, "--methods", "context", *SIZE)
    for out, more in (("masked", ()), ("all", ("--no-masks",))):
        place = ("--out", tmp_path / out)
        assert run(monkeypatch, "evaluate", scenes["masks"], *words, *more, *place) == 0
    assert "masks: masks of" in capsys.readouterr().err
    masked, everything = (read_scores(tmp_path / out) for out in ("masked", "all"))
    assert masked["context_psnr"][0]["after"] > 30
    assert masked["target_after"]["psnr"] > everything["target_after"]["psnr"] + 2
    assert masked["hole_fraction"] > everything["hole_fraction"] + 0.1


def test_evaluate_of_boxes_names_the_option_of_masks(scenes, tmp_path, monkeypatch, capsys):
    words = ("--protocol", "n-2", "--ignore-moving", "--out", tmp_path / "out")
    assert run(monkeypatch, "evaluate", scenes["masks"], *words) == 2
    said = capsys.readouterr().err
    assert "has no boxes of moving objects" in said
    assert "leave --ignore-moving out (masks are read without it)" in said


@pytest.mark.slow
def test_cases_read_masks(scenes, tmp_path, monkeypatch, capsys):
    case = {"scene": str(scenes["alpha"]), "context": [1, 3], "target": 5, "neighbours": [4]}
    content = {"resolution": [HEIGHT, WIDTH], "cases": [case]}
    (tmp_path / "cases.json").write_text(json.dumps(content))
    words = ("--methods", "context", "--out", tmp_path / "out")
    assert run(monkeypatch, "evaluate", tmp_path / "cases.json", *words) == 0
    assert "alpha: the alpha channel of 4 photographs" in capsys.readouterr().err
    assert read_scores(tmp_path / "out")["context_psnr"][0]["after"] > 30


@pytest.mark.slow
def test_batch_reads_masks(scenes, tmp_path, monkeypatch):
    manifest = tmp_path / "scenes.csv"
    manifest.write_text(f"folder,context,target\n{scenes['masks']},1 photo_003,photo_005.png\n")
    words = ("batch", manifest, "--out", tmp_path / "out", "--each", "resolution=72 96", "--quiet")
    assert run(monkeypatch, *words, "--workers", 1) == 0
    summary = read_summary(tmp_path / "out" / "jobs" / "masks")
    assert [row["ignored"] for row in summary["context"]] == [0.25, 0.25]
    assert [row["file"] for row in summary["targets"]] == ["photo_005.png"]


@pytest.mark.slow
def test_clean_compares_nothing_with_what_is_masked(
    scenes, completed, tmp_path, monkeypatch, capsys
):
    splat = completed["whole"] / "completed.ply"
    words = ("--scene", splat, *SIZE, "--quiet", "--near", 0.5, "--far", 20)
    words += ("--context", 0, 1, 2, 3)
    assert run(monkeypatch, "clean", scenes["masks"], *words, "--out", tmp_path / "out") == 0
    rows = read_summary(tmp_path / "out")["photographs"]
    assert [row["ignored"] for row in rows] == [0.25] * 4
    assert rows[1]["file"] == "photo_001.png"
    assert rows[1]["psnr_before"] > 30
    # With all pixels, the splat does not even fit its photographs.
    everything = ("--no-masks", "--out", tmp_path / "all")
    assert run(monkeypatch, "clean", scenes["masks"], *words, *everything) == 2
    assert "does not show what the photographs show" in capsys.readouterr().err


@pytest.mark.slow
def test_the_masks_of_a_removal_hide_nothing(scenes, completed, tmp_path, monkeypatch, capsys):
    """Users keep them in `masks`, too: white is what goes."""
    scene = write_colmap(tmp_path / "scene", small_cameras(), n_points=50)
    (scene / "masks").mkdir()
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[40:, 30:50] = 255
    Image.fromarray(mask).save(scene / "masks/photo_003.png")
    words = ("remove", scene, "--scene", completed["whole"] / "context.ply", *SIZE, "--quiet")
    words += ("--near", 0.5, "--far", 20, "--target", 3, "--mask", scene / "masks")
    assert run(monkeypatch, *words, "--out", tmp_path / "out") == 0
    assert read_summary(tmp_path / "out")["gaussians"]["removed"] > 100
    Image.fromarray(mask[:, :40]).save(scene / "masks/photo_003.png")
    assert run(monkeypatch, *words, "--out", tmp_path / "other") == 2
    assert "another aspect ratio" in capsys.readouterr().err
