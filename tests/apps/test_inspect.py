"""`inspect`: what is in a splat, what of it is invented, by what, and how much of pictures."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

import gscompleter as gsc
from command import run
from gscompleter import load_ply, save_ply, save_splat
from gscompleter.apps.completing.keeping import save_compactly
from gscompleter.apps.completing.maker import record_model
from gscompleter.apps.inspection import MadeRow, describe_run_row
from gscompleter.data.scene import write_cameras
from gscompleter.splats.formats import read_provenance
from gscompleter.splats.provenance import ModelRecord, Provenance, RunRecord
from gscompleter.types import Gaussians, make_observed, sh_from_rgb
from scenes import camera_at
from splat_files import plausible

OURS = ModelRecord("plane-sweep", None, "Apache-2.0")
RUN = RunRecord("gscompleter", "0.1.0", (1, 2), OURS, None, ModelRecord("mine"), "Ann", 7, "ab")


def inspected(monkeypatch, capsys, *words) -> dict:
    capsys.readouterr()
    assert run(monkeypatch, "inspect", *words, "--json") == 0
    return json.loads(capsys.readouterr().out)


def walls(labels: list[int], xs: list[float]) -> Gaussians:
    """Make opaque Gaussians beside each other, each with a label."""
    count = len(labels)
    means = torch.tensor([[x, 0.0, 3.0] for x in xs])
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4).contiguous()
    scales = torch.full((count, 3), 0.1)
    colors = sh_from_rgb(torch.rand(count, 3, generator=torch.Generator().manual_seed(0)))
    gaussians = make_observed(means, quats, scales, torch.full((count,), 0.99), colors)
    return replace(gaussians, generated=torch.tensor(labels, dtype=torch.uint8))


def test_a_completion_says_what_it_invented_and_with_what(
    completed_room, monkeypatch, capsys, tmp_path
):
    found = inspected(monkeypatch, capsys, completed_room)
    scene = load_ply(completed_room / "completed.ply")
    assert found["gaussians"] == len(scene)
    assert found["invented"] == int((scene.generated == 1).sum()) > 0
    assert found["sh_degree"] == scene.sh_degree
    (row,) = found["runs"]
    assert row["gaussians"] == found["invented"]
    assert row["labels"] == [1, 1]
    made_by = row["made_by"]
    assert made_by["tool"] == "gscompleter"
    assert made_by["reconstructor"] == {**vars(OURS)}
    assert made_by["generator"] == {
        "name": "warp-inpaint",
        "weights": None,
        "licence": "Apache-2.0",
    }
    assert made_by["seed"] == 0
    assert made_by["given"] is None
    # The target is where the hole was, and the photographs are where the scene was.
    target, *photographs = found["pictures"]
    assert target["camera"].startswith("Target 1")
    assert len(photographs) == 2
    assert target["invented"] > max(one["invented"] for one in photographs)
    for one in found["pictures"]:
        total = sum(one[kind] for kind in ("invented", "from_photographs", "given", "empty"))
        assert abs(total - 1) < 1e-3
    # The context has nothing of it, and the additions nothing else.
    assert b"comment" not in (completed_room / "context.ply").read_bytes()[:500]
    alone = inspected(monkeypatch, capsys, completed_room / "generated.ply")
    assert alone["invented"] == alone["gaussians"] == found["invented"]
    assert all(one["given"] == 0 for one in alone["pictures"])


def test_pictures_count_each_kind_by_what_it_covers(tmp_path, monkeypatch, capsys):
    scene = walls([0, 1, 255, 0], [-0.6, -0.2, 0.2, 0.6])
    save_splat(tmp_path / "a.ply", scene, Provenance((RUN,)))
    camera = camera_at(size=64)
    write_cameras(tmp_path / "cameras.json", [camera])
    found = inspected(
        monkeypatch, capsys, tmp_path / "a.ply", "--cameras", tmp_path / "cameras.json"
    )
    (picture,) = found["pictures"]
    assert picture["invented"] > 0.005
    assert picture["from_photographs"] == pytest.approx(picture["invented"], rel=0.05)
    assert picture["given"] == pytest.approx(2 * picture["invented"], rel=0.05)
    assert found["from_photographs"] == 1
    assert np.allclose(found["extent"][0], [-0.6, 0.6])


def test_what_nobody_claims_is_said(tmp_path, monkeypatch, capsys):
    save_splat(tmp_path / "a.ply", walls([0, 1, 2, 5], [0, 1, 2, 3]), Provenance((RUN,)))
    found = inspected(monkeypatch, capsys, tmp_path / "a.ply")
    assert [(row["gaussians"], row["labels"]) for row in found["runs"]] == [
        (2, [1, 2]),
        (1, [5, 5]),
    ]
    assert found["runs"][1]["made_by"] is None
    assert found["pictures"] == []
    assert run(monkeypatch, "inspect", tmp_path / "a.ply") == 0
    shown = capsys.readouterr().out
    assert "1 of label 5: the file does not say" in shown
    assert "2 of labels 1 to 2; plane-sweep (Apache-2.0); mine (licence not known)" in shown
    assert "painted by Ann; seed 7; given SHA-256 ab" in shown
    save_ply(tmp_path / "b.ply", plausible(5, 2))
    assert run(monkeypatch, "inspect", tmp_path / "b.ply") == 0
    shown = capsys.readouterr().out
    assert "5, harmonics of degree 2" in shown
    assert "the file does not say" in shown


def test_rows_that_are_not_finite_are_counted_and_left_out(tmp_path, monkeypatch, capsys):
    scene = plausible(30, 0)
    save_splat(tmp_path / "a.splat", scene)
    data = bytearray((tmp_path / "a.splat").read_bytes())
    data[0:4] = np.float32("nan").tobytes()
    data[32:36] = np.float32("inf").tobytes()
    (tmp_path / "a.splat").write_bytes(data)
    save_ply(tmp_path / "a.ply", scene)
    head, end, rows = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    (tmp_path / "a.ply").write_bytes(head + end + np.float32("nan").tobytes() + rows[4:])
    for name, count in (("a.splat", 2), ("a.ply", 1)):
        found = inspected(monkeypatch, capsys, tmp_path / name)
        assert (found["gaussians"], found["nonfinite"]) == (30, count)
        assert np.isfinite(found["extent"]).all()


def test_a_run_that_names_neither_models_nor_a_seed_is_one_clause():
    assert describe_run_row(MadeRow(0, None, RunRecord("mine", "2", None))) == (
        "mine 2 (nothing invented)"
    )


def test_a_damaged_record_does_not_hide_the_rest(tmp_path, monkeypatch, capsys):
    save_ply(tmp_path / "a.ply", plausible(5, 0))
    data = (tmp_path / "a.ply").read_bytes()
    line = b"comment gscompleter-provenance/1 {\nelement"
    (tmp_path / "a.ply").write_bytes(data.replace(b"element", line, 1))
    found = inspected(monkeypatch, capsys, tmp_path / "a.ply")
    assert found["gaussians"] == 5
    assert "is no JSON" in found["record_defect"]


def test_a_file_without_anything_finite_is_refused(tmp_path, monkeypatch, capsys):
    save_ply(tmp_path / "a.ply", plausible(2, 0))
    head, end, rows = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    (tmp_path / "a.ply").write_bytes(head + end + b"\xff" * len(rows))
    assert run(monkeypatch, "inspect", tmp_path / "a.ply") == 2
    assert "no Gaussian that is finite" in capsys.readouterr().err


def test_a_file_without_gaussians_is_refused_as_that(tmp_path, monkeypatch, capsys):
    save_ply(tmp_path / "a.ply", walls([0], [0.0])[:0])
    assert run(monkeypatch, "inspect", tmp_path / "a.ply") == 2
    assert "holds no Gaussians; name another file" in capsys.readouterr().err


def test_models_are_named_with_their_licences(tmp_path):
    (tmp_path / "weights").mkdir()
    assert record_model("mvsplat-re10k", None).licence is None
    assert record_model("lama", None) == ModelRecord("lama", "lama", "Apache-2.0")
    klein = "black-forest-labs/FLUX.2-klein-4B@e7b7"
    assert record_model("flux2-klein", klein).licence == "Apache-2.0"
    assert "non-commercial" in record_model("pe-field", None).licence
    # A path tells about the machine, and its name nothing about a licence.
    own = record_model("lama", tmp_path / "weights")
    assert own == ModelRecord("lama", "weights")
    assert record_model("my_package:load", None) == ModelRecord("my_package:load")


@pytest.mark.parametrize("weights", ["{}/flux.1", "~/flux.1", ".", "../flux.1"])
def test_paths_of_models_are_recorded_without_their_folders(tmp_path, monkeypatch, weights):
    (tmp_path / "flux.1").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    monkeypatch.chdir(tmp_path / "flux.1")
    own = record_model(f"{tmp_path}/own.py:paint", weights.format(tmp_path))
    assert own == ModelRecord("own.py:paint", "flux.1")


def my_painter(nearest, target, context):
    """Return the least of generators."""
    return torch.full((target.height, target.width, 3), 0.5)


@pytest.mark.parametrize("generator", [pytest.param(None, marks=pytest.mark.slow), my_painter])
def test_a_completion_in_python_names_its_models(room, tmp_path, generator):
    views = gsc.load_views(room, frames=[0, 1], resolution=(32, 32))
    target = gsc.load_camera(room, frame=2, resolution=(32, 32))
    named = {} if generator is None else {"generator": generator}
    completion = gsc.GSCompleter(seed=5, **named)(views, target)
    completion.save(tmp_path / "out")
    (made,) = read_provenance(tmp_path / "out" / "completed.ply").runs
    assert made.reconstructor.name == "plane-sweep"
    assert made.reconstructor.licence == "Apache-2.0"
    assert made.seed == 5
    if len(completion.added):
        expected = "warp-inpaint" if generator is None else "my_painter"
        assert made.generator.name == expected
        assert made.generator.licence == ("Apache-2.0" if generator is None else None)
    assert generator is not None or len(completion.added)


def test_the_folder_of_the_demo_is_that_of_its_completion(
    completed_room, tmp_path, monkeypatch, capsys
):
    shutil.copytree(completed_room, tmp_path / "demo" / "completion")
    (tmp_path / "demo" / "summary.json").write_text('{"command": "demo"}', encoding="utf-8")
    found = inspected(monkeypatch, capsys, tmp_path / "demo")
    assert found["file"] == str(tmp_path / "demo" / "completion" / "completed.ply")
    assert found["pictures"]


@pytest.mark.parametrize("suffix", [".spz", ".sog"])
def test_a_folder_whose_scene_has_another_ending_is_inspected_as_a_completion(
    completed_room, tmp_path, monkeypatch, capsys, suffix
):
    folder = tmp_path / "completion"
    shutil.copytree(completed_room, folder)
    save_compactly(folder, suffix, json.loads((folder / "summary.json").read_bytes()), None)
    found = inspected(monkeypatch, capsys, completed_room)
    for path in (folder, folder / f"completed{suffix}", tmp_path):
        small = inspected(monkeypatch, capsys, path)
        assert small["file"] == str(folder / f"completed{suffix}")
        assert [row["camera"] for row in small["pictures"]] == [
            row["camera"] for row in found["pictures"]
        ]


def test_a_cleaned_splat_is_inspected_without_cameras(tmp_path, monkeypatch, capsys):
    save_ply(tmp_path / "splat.ply", plausible(300, 0))
    out = tmp_path / "cleaned"
    assert run(monkeypatch, "clean", "--scene", tmp_path / "splat.ply", "--out", out) == 0
    for path in (out, out / "completed.ply"):
        found = inspected(monkeypatch, capsys, path)
        assert found["file"] == str(out / "completed.ply")
        assert not found["pictures"]


@pytest.mark.parametrize("command", ["inspect", "view"])
def test_a_size_of_images_needs_cameras(tmp_path, monkeypatch, capsys, command):
    save_ply(tmp_path / "splat.ply", walls([0], [0.0]))
    words = (command, tmp_path / "splat.ply", "--resolution", 8, 8)
    assert run(monkeypatch, *words) == 2
    assert "--resolution is the size of images at --cameras" in capsys.readouterr().err
