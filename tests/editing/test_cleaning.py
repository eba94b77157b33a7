"""Removal of Gaussians that make photographs worse: `gscompleter clean`."""

from __future__ import annotations

import json
from dataclasses import replace

import plyfile
import pytest
import torch

from command import run
from copies import watch_copies
from gscompleter.apps.cleaning import describe_cleaning
from gscompleter.apps.inputs import splat as splat_reading
from gscompleter.config import CleaningConfig
from gscompleter.editing.cleaning import find_removable, find_superfluous
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.render.cpu import CpuFrozenScene
from gscompleter.render.loading import load_renderer
from gscompleter.splats.ply import load_ply
from gscompleter.stages.error_budgets import compute_squared_error
from gscompleter.stages.superfluous import exclude_needed, predict_error_change
from gscompleter.system.files.mapping import is_mapped, move_to_file
from gscompleter.types import View, merge, sh_from_rgb
from scenes import Room, camera_at, gaussians_of, labelled, photographed, view_of

RENDERER = load_renderer("cpu")
SIZE = 64
CAMERAS = [camera_at(x, size=SIZE) for x in (-0.3, 0.0, 0.3)]
SURFACES = merge([gaussians_of(view_of(Room(), camera)) for camera in CAMERAS[::2]])


def drawn(scene, camera):
    """Render a photograph from Gaussians, so that none of them is wrong."""
    return View(RENDERER.render(scene, camera).image.clamp(0, 1), camera)


VIEWS = [drawn(SURFACES, camera) for camera in CAMERAS]


def floaters():
    """Make a few Gaussians halfway to the walls, in arbitrary colours."""
    view = view_of(Room(), CAMERAS[1])
    found = gaussians_of(view, 0.5 * view.depth)[SIZE * SIZE // 2 + 5 :: SIZE * 5]
    colours = torch.tensor([1.0, 0.0, 0.0]).repeat(len(found), 1)
    return replace(found, sh=sh_from_rgb(colours), scales=3 * found.scales, encoded=None)


FLOATERS = floaters()
SCENE = merge([SURFACES[:1000], FLOATERS, SURFACES[1000:]])
FLOAT = (torch.arange(len(SCENE)) >= 1000) & (torch.arange(len(SCENE)) < 1000 + len(FLOATERS))
NONE = torch.zeros(len(SCENE), dtype=torch.bool)
ONLY_HARMFUL = CleaningConfig(idle=0.0)


def losses(scene, taken, views=VIEWS):
    """Compute the PSNR that each photograph loses, in dB."""
    return [
        psnr(RENDERER.render(scene, v.camera).image, v.image)
        - psnr(RENDERER.render(scene[~taken], v.camera).image, v.image)
        for v in views
    ]


def test_what_stays_is_not_copied_to_be_drawn_without_the_rest(monkeypatch):
    copied = watch_copies(monkeypatch)
    removed = exclude_needed(SCENE, FLOAT, VIEWS, [1.0] * len(VIEWS), RENDERER)
    assert torch.equal(removed, FLOAT)
    assert sum(copied) <= len(FLOATERS)


def test_photographs_within_their_limits_are_drawn_once_and_have_no_plan(monkeypatch):
    drawn = []
    composite = CpuFrozenScene.composite

    def counted(frozen, new):
        drawn.append(new)
        return composite(frozen, new)

    monkeypatch.setattr(CpuFrozenScene, "composite", counted)
    monkeypatch.delattr(CpuFrozenScene, "vary_opacities")
    removed = exclude_needed(SCENE, FLOAT, VIEWS, [1.0] * len(VIEWS), RENDERER)
    assert torch.equal(removed, FLOAT)
    assert len(drawn) == len(VIEWS)


def find_all(*arguments) -> torch.Tensor:
    """Find what is superfluous, whatever the reason."""
    return torch.stack(list(find_superfluous(*arguments).values())).any(dim=0)


def test_floaters_go_and_nothing_else():
    """Single Gaussians of the wall behind them may go, too, as photographs hardly change."""
    assert len(FLOATERS) > 3
    taken = find_all(SCENE, VIEWS, RENDERER, ONLY_HARMFUL)
    assert taken[FLOAT].all()
    assert (taken & ~FLOAT).float().mean() < 1e-3


def test_walls_are_not_blamed_for_the_floaters_before_them():
    at_first = find_removable(SCENE, NONE, VIEWS, RENDERER, ONLY_HARMFUL)
    taken = find_all(SCENE, VIEWS, RENDERER, ONLY_HARMFUL)
    assert (taken & ~FLOAT).sum() < 0.2 * (at_first & ~FLOAT).sum()


def test_what_is_idle_goes_too_and_no_photograph_gets_worse():
    taken = find_all(SCENE, VIEWS, RENDERER)
    assert taken[FLOAT].all()
    assert max(losses(SCENE, taken)) <= CleaningConfig().tolerance


def test_each_removed_gaussian_has_one_reason():
    """Floaters are harmful; of the same surface twice, one is not needed."""
    twice = merge([SCENE, SURFACES])
    reasons = find_superfluous(twice, VIEWS, RENDERER)
    assert set(reasons) == {"harmful", "not needed"}
    assert not (reasons["harmful"] & reasons["not needed"]).any()
    is_float = torch.cat([FLOAT, torch.zeros(len(SURFACES), dtype=torch.bool)])
    assert reasons["harmful"][is_float].float().mean() > 0.5
    assert reasons["not needed"][~is_float].any()


def test_a_scene_that_is_right_stays_as_it_is():
    assert not find_all(SURFACES, VIEWS, RENDERER, ONLY_HARMFUL).any()


def test_what_no_photograph_shows_or_what_was_generated_stays():
    behind = replace(FLOATERS, means=FLOATERS.means - torch.tensor([0.0, 0.0, 20.0]))
    ours = replace(FLOATERS, generated=torch.ones_like(FLOATERS.generated))
    taken = find_all(merge([SURFACES, behind, ours]), VIEWS, RENDERER)
    assert not taken[len(SURFACES) :].any()


def test_the_change_is_the_one_that_drawing_shows():
    view, generator = VIEWS[0], torch.Generator().manual_seed(1)
    plan = RENDERER.freeze(SCENE[:0], view.camera).vary_opacities(SCENE)
    change, _ = predict_error_change(plan, SCENE.opacities, NONE, view, 64, generator)

    def error(scene):
        return compute_squared_error(RENDERER.render(scene, view.camera).image, view.image).item()

    for row in (*torch.nonzero(FLOAT)[:3, 0].tolist(), *change.topk(3).indices.tolist()):
        alone = torch.arange(len(SCENE)) == row
        assert change[row].item() == pytest.approx(error(SCENE[~alone]) / error(SCENE) - 1, rel=0.4)


def test_without_the_guard_photographs_would_get_worse():
    """Each of three Gaussians in one place can be removed, but not all."""
    thrice = merge([SURFACES] * 3)
    views = [view_of(Room(), camera) for camera in CAMERAS]
    config = CleaningConfig(idle=1e3)
    none = torch.zeros(len(thrice), dtype=torch.bool)
    doubtful = find_removable(thrice, none, views, RENDERER, config)
    assert max(losses(thrice, doubtful, views)) > 1.0
    unguarded = find_all(thrice, views, RENDERER, replace(config, tolerance=10.0))
    guarded = find_all(thrice, views, RENDERER, config)
    assert max(losses(thrice, unguarded, views)) > 0.05
    assert guarded.any()
    assert max(losses(thrice, guarded, views)) <= config.tolerance


def clean(scene, splat, out, *more):
    return ["clean", scene, "--scene", splat, "--out", out, "--quiet", *more]


@pytest.fixture
def scene(tmp_path):
    return photographed(tmp_path / "scene", CAMERAS)


def test_the_command_cleans_and_strip_puts_back(scene, tmp_path, monkeypatch):
    splat, out = labelled(tmp_path / "splat.ply", SCENE), tmp_path / "out"
    assert run(monkeypatch, *clean(scene, splat, out)) == 0
    kept, removed = load_ply(out / "completed.ply"), load_ply(out / "removed.ply")
    assert len(kept) + len(removed) == len(SCENE)
    labels = plyfile.PlyData.read(str(out / "removed.ply"))["vertex"].data["label"]
    assert sum(FLOAT[label].item() for label in labels) > len(FLOATERS) / 2
    summary = json.loads((out / "summary.json").read_text())
    counts = {"given": len(SCENE), "kept": len(kept), "removed": len(removed)}
    assert summary["gaussians"] == counts
    assert [row["frame"] for row in summary["photographs"]] == [0, 1, 2]
    for row in summary["photographs"]:
        assert row["psnr_after"] > row["psnr_before"] - 0.05
    assert summary["settings"]["config"]["tolerance"] == CleaningConfig().tolerance
    assert summary["seconds"]["total"] > 0
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", tmp_path / "back.ply") == 0
    assert (tmp_path / "back.ply").read_bytes() == splat.read_bytes()


def test_a_photograph_that_is_ignored_everywhere_has_no_part_in_the_mean():
    rows = [
        {"psnr_before": None, "psnr_after": None, "ignored": 1.0},
        {"psnr_before": 20.0, "psnr_after": 21.0, "ignored": 0.0},
    ]
    summary = {
        "gaussians": {"removed": 1, "given": 2},
        "seconds": {"total": 0.1},
        "reasons": {"idle": 1},
        "photographs": rows,
    }
    line = describe_cleaning(summary, "removed")
    assert line.endswith("20.00 dB before, 21.00 dB after, worst change +1.000 dB")
    nowhere = describe_cleaning({**summary, "photographs": rows[:1]}, "removed")
    assert nowhere.endswith("the photographs are ignored everywhere, and tell no PSNR")


@pytest.mark.linux
@pytest.mark.parametrize("has_photographs", [True, False])
def test_colours_of_a_large_splat_lie_in_a_file_and_nothing_else_changes(
    scene, tmp_path, monkeypatch, has_photographs
):
    splat = labelled(tmp_path / "splat.ply", SCENE)
    results = []
    mapped = []

    def move(values, beside):
        moved = move_to_file(values, beside)
        mapped.append(is_mapped(moved))
        return moved

    monkeypatch.setattr(splat_reading, "move_to_file", move)
    for worth in (len(SCENE) + 1, len(SCENE)):
        monkeypatch.setattr(splat_reading, "MIN_PROXY_GAUSSIANS", worth)
        out = tmp_path / str(worth)
        words = clean(scene, splat, out)
        assert run(monkeypatch, *(words if has_photographs else ["clean", *words[2:]])) == 0
        names = ("completed.ply", "removed.ply", "removed.png")
        results.append([(out / name).read_bytes() for name in names])
        assert mapped == [True] * (worth == len(SCENE))
    assert results[0] == results[1]


def test_the_command_says_what_it_did(scene, tmp_path, monkeypatch, capsys):
    splat = labelled(tmp_path / "splat.ply", SCENE)
    words = [word for word in clean(scene, splat, tmp_path / "out") if word != "--quiet"]
    assert run(monkeypatch, *words, "--context", 0, 2) == 0
    said = capsys.readouterr()
    assert "Gaussians removed" in said.out
    assert "compared with 2 photographs" in said.err


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (("--context", 0, 0), "twice"),
        (("--context", 9), "frame"),
        (("--config.tolerance", -1), "tolerance"),
        (("--resolution", 8), "at least 16"),
        (("--near", 5, "--far", 2), "not before"),
    ],
)
def test_wrong_input_gets_a_sentence(scene, tmp_path, monkeypatch, capsys, more, sentence):
    splat, out = labelled(tmp_path / "splat.ply", SCENE), tmp_path / "out"
    assert run(monkeypatch, *clean(scene, splat, out, *more)) == 2
    said = capsys.readouterr().err
    assert said.startswith("gscompleter: ")
    assert sentence in said
    assert said.count("\n") == 1
    assert not out.exists()


def test_a_splat_that_is_not_there_is_refused(scene, tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, *clean(scene, tmp_path / "missing.ply", tmp_path / "out")) == 2
    assert "missing.ply" in capsys.readouterr().err


def test_a_folder_with_something_in_it_is_kept(scene, tmp_path, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    splat = labelled(tmp_path / "splat.ply", SCENE)
    assert run(monkeypatch, *clean(scene, splat, out)) == 2
    assert [file.name for file in out.iterdir()] == ["mine.txt"]
