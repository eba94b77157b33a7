"""`convert`: joined, cut, turned and reduced splats, and what the result does not keep."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest
import torch

from command import run
from gscompleter import load_splat, save_ply, save_splat
from gscompleter.apps import converting
from gscompleter.splats.formats import read_provenance
from gscompleter.splats.provenance import Provenance, RunRecord
from scenes import random_gaussians
from splat_files import plausible, sog_files, write_degree_4_ply, write_sog

SCENE = random_gaussians(400, seed=1, sh_degree=2)


def labelled_scene(count: int, labels: list[int], tool: str) -> tuple:
    scene = random_gaussians(count, seed=count)
    generated = torch.tensor(labels).repeat(count)[:count].to(torch.uint8)
    record = Provenance((RunRecord(tool, "1", (1, max(n for n in labels if n < 255))),))
    return replace(scene, generated=generated), record


def test_a_ply_is_edited_some_rows_at_a_time_as_all_at_once(tmp_path, monkeypatch):
    """Both ways, through memory and through the file, give the same bytes."""
    given = tmp_path / "given.ply"
    save_ply(given, SCENE)
    options = ("--bands", 1, "--crop-sphere", 0, 0, 3, 2, "--rotate", 10, 20, 30, "--scale", 2)
    words = ("convert", given, tmp_path / "streamed.ply", *options, "--quiet")
    monkeypatch.setattr("gscompleter.splats.ply.CHUNK_ROWS", 64)
    assert run(monkeypatch, *words) == 0
    monkeypatch.setattr(converting, "can_convert_rows", lambda *_: False)
    assert run(monkeypatch, "convert", given, tmp_path / "whole.ply", *options, "--quiet") == 0
    streamed, whole = (load_splat(tmp_path / name) for name in ("streamed.ply", "whole.ply"))
    assert 0 < len(streamed) < len(SCENE)
    assert streamed.sh_degree == 1
    for name in ("means", "quats", "scales", "opacities", "sh"):
        ours, theirs = getattr(streamed, name), getattr(whole, name)
        assert (ours - theirs).abs().max() <= 1e-6 * theirs.abs().max()


def test_small_gaussians_are_shifted_exactly(tmp_path, monkeypatch):
    """Float32 would round their new positions by more than a hundredth of their size."""
    small = replace(SCENE, means=SCENE.means * 1e-3, scales=SCENE.scales * 1e-3, encoded=None)
    given, out = tmp_path / "given.ply", tmp_path / "out.ply"
    save_ply(given, small)
    assert run(monkeypatch, "convert", given, out, "--translate", 900.5, 0, 0, "--quiet") == 0
    moved = load_splat(out)
    assert moved.origin is not None
    shift = torch.tensor([900.5, 0, 0], dtype=torch.float64) - torch.tensor(moved.origin)
    wanted = load_splat(given).means.double() + shift
    assert (moved.means.double() - wanted).abs().max() < 1e-2 * moved.scales.amax(dim=1).median()


def test_a_cut_keeps_the_rows_of_a_ply_bit_for_bit(tmp_path, monkeypatch):
    given, out = tmp_path / "given.ply", tmp_path / "out.ply"
    save_ply(given, SCENE)
    box = ("--crop-box", -9, -9, -9, 0, 9, 9)
    assert run(monkeypatch, "convert", given, out, *box, "--quiet") == 0
    save_ply(tmp_path / "wanted.ply", load_splat(given)[SCENE.means[:, 0] <= 0])
    assert out.read_bytes() == (tmp_path / "wanted.ply").read_bytes()


def test_nothing_left_is_refused(tmp_path, monkeypatch, capsys):
    for name in ("given.ply", "given.splat"):
        save_splat(tmp_path / name, random_gaussians(20))
        words = ("convert", tmp_path / name, tmp_path / "out.ply", "--crop-sphere", 99, 0, 0, 1)
        assert run(monkeypatch, *words, "--quiet") == 2
        assert "is left; change what is cut off" in capsys.readouterr().err
        assert not (tmp_path / "out.ply").exists()


def test_targets_of_joined_splats_are_numbered_on(tmp_path, monkeypatch, capsys):
    first, made_first = labelled_scene(30, [0, 1, 2, 255], "one")
    second, made_second = labelled_scene(20, [0, 1, 255], "two")
    save_splat(tmp_path / "a.ply", first, made_first)
    save_splat(tmp_path / "b.ply", second, made_second)
    out = tmp_path / "both.ply"
    words = ("convert", tmp_path / "a.ply", out, "--merge", tmp_path / "b.ply")
    assert run(monkeypatch, *words) == 0
    assert "50 Gaussians" in capsys.readouterr().out
    both = load_splat(out)
    assert both.generated[:30].tolist() == first.generated.tolist()
    wanted = second.generated.where(second.generated != 1, 3)
    assert both.generated[30:].tolist() == wanted.tolist()
    assert [(r.tool, r.labels) for r in read_provenance(out).runs] == [
        ("one", (1, 2)),
        ("two", (3, 3)),
    ]


def test_a_target_whose_gaussians_are_gone_gives_its_number_to_no_other(tmp_path, monkeypatch):
    first, made_first = labelled_scene(30, [0, 1, 2], "one")
    second, made_second = labelled_scene(20, [0, 1], "two")
    save_splat(tmp_path / "a.ply", first[first.generated != 2], made_first)
    save_splat(tmp_path / "b.ply", second[second.generated != 1], made_second)
    save_splat(tmp_path / "c.ply", second, made_second)
    out = tmp_path / "all.ply"
    parts = ("--merge", tmp_path / "b.ply", tmp_path / "c.ply")
    assert run(monkeypatch, "convert", tmp_path / "a.ply", out, *parts, "--quiet") == 0
    assert load_splat(out).generated.unique().tolist() == [0, 1, 4]
    labels = [run_record.labels for run_record in read_provenance(out).runs]
    assert labels == [(1, 2), (3, 3), (4, 4)]


def test_too_many_targets_are_refused_and_go_without_labels(tmp_path, monkeypatch, capsys):
    for name in ("a.ply", "b.ply"):
        save_splat(tmp_path / name, *labelled_scene(20, [0, 200], "many"))
    words = ("convert", tmp_path / "a.ply", tmp_path / "o.ply", "--merge", tmp_path / "b.ply")
    assert run(monkeypatch, *words, "--quiet") == 2
    assert "more than 254 targets; leave the labels out" in capsys.readouterr().err
    assert run(monkeypatch, *words, "--quiet", "--plain") == 0
    assert not load_splat(tmp_path / "o.ply").generated.any()


@pytest.mark.parametrize("name", ["out.spz", "out.sog", "out.compressed.ply"])
def test_the_largest_rounding_is_said(tmp_path, monkeypatch, capsys, name):
    """Sizes below the smallest of a .spz are enlarged, which it says."""
    scales = SCENE.scales.clone()
    scales[7] = 3e-5
    given = tmp_path / "given.ply"
    save_ply(given, replace(SCENE, scales=scales))
    assert run(monkeypatch, "convert", given, tmp_path / name, "--json") == 0
    rounding = json.loads(capsys.readouterr().out)["rounding"]
    read = load_splat(tmp_path / name).means
    # Formats may reorder Gaussians: each has one as near as the rounding says.
    apart = (read[:, None].double() - SCENE.means).norm(dim=2).min(dim=1).values.max().item()
    assert 0 < apart / 3**0.5 <= rounding["position"] < 0.01 * SCENE.means.abs().max()
    if name == "out.spz":
        assert rounding["size"][0] == pytest.approx(3e-5, rel=1e-3)
        assert rounding["size"][1] == pytest.approx(4.54e-5, rel=1e-2)
    words = ("convert", given, tmp_path / name, "--overwrite")
    assert run(monkeypatch, *words) == 0
    line = r"Largest rounding: \S+ of a coordinate, and a size of \S+ became \S+\."
    assert re.match(line, capsys.readouterr().out)


def test_what_is_exact_says_nothing(tmp_path, monkeypatch, capsys):
    save_ply(tmp_path / "given.ply", SCENE)
    assert run(monkeypatch, "convert", tmp_path / "given.ply", tmp_path / "out.glb") == 0
    assert "rounding" not in capsys.readouterr().out


def test_what_does_not_fit_the_result_any_more_is_said(tmp_path, monkeypatch, capsys):
    given = tmp_path / "given.ply"
    save_ply(given, SCENE)
    data = given.read_bytes().replace(b"ply\n", b"ply\n", 1)
    data = data.replace(b"\nelement", b"\ncomment Vertical Axis: z\nelement", 1)
    given.write_bytes(data)
    (tmp_path / "cameras.json").write_text("[]")
    out = tmp_path / "out.ply"
    assert run(monkeypatch, "convert", given, out, "--rotate", 90, 0, 0) == 0
    said = capsys.readouterr().out
    assert "The cameras.json of given.ply is for the splat as it was" in said
    # z, turned about x by a quarter, is -y, which is up in most files: nothing to be said.
    assert "--up" not in said
    assert run(monkeypatch, "convert", given, out, "--overwrite") == 0
    said = capsys.readouterr().out
    assert (
        "given.ply says which way is up, which out.ply does not keep: name it with --up 0 0 1."
        in said
    )
    assert "cameras.json" not in said


def test_cameras_of_a_trainer_lie_above_its_iterations(tmp_path, monkeypatch, capsys):
    iteration = tmp_path / "point_cloud" / "iteration_7000"
    iteration.mkdir(parents=True)
    save_ply(iteration / "point_cloud.ply", SCENE)
    (tmp_path / "cameras.json").write_text("[]")
    words = ("convert", iteration / "point_cloud.ply", tmp_path / "out.ply", "--scale", 2)
    assert run(monkeypatch, *words) == 0
    assert "The cameras.json of point_cloud.ply is for the splat as it was" in (
        capsys.readouterr().out
    )


def test_a_result_that_is_changed_says_that_strip_cannot_undo_it(tmp_path, monkeypatch, capsys):
    save_ply(tmp_path / "completed.ply", SCENE)
    save_ply(tmp_path / "removed.ply", SCENE[:3])
    words = ("convert", tmp_path / "completed.ply", tmp_path / "out.ply")
    assert run(monkeypatch, *words, "--decimate", "50%") == 0
    assert "`strip` cannot take back" in capsys.readouterr().out
    assert run(monkeypatch, *words, "--overwrite") == 0
    assert "strip" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--decimate", "many"), "is no number of Gaussians"),
        (("--decimate", "0%"), "is no number of Gaussians"),
        (("--level", 0), "has no levels of detail"),
        (("--scale", 0), "scale"),
        (("--crop-box", 1, 0, 0, 0, 1, 1), "smallest x, y and z"),
        (("--merge", "nowhere.ply"), "nowhere.ply"),
    ],
)
def test_wrong_options_get_a_sentence(tmp_path, monkeypatch, capsys, options, sentence):
    save_ply(tmp_path / "given.ply", SCENE)
    words = ("convert", tmp_path / "given.ply", tmp_path / "out.spz", "--quiet", *options)
    assert run(monkeypatch, *words) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out.spz").exists()


def test_a_level_and_three_bands_have_to_be_asked_for(tmp_path, monkeypatch, capsys):
    """Other commands name `convert`, and it names its options."""
    index = {"lodLevels": 1, "filenames": ["0_0/meta.json"]}
    index["tree"] = {"lods": {"0": {"file": 0, "offset": 0, "count": 40}}}
    folder = tmp_path / "garden"
    folder.mkdir()
    write_sog(folder / "0_0", sog_files(plausible(40)))
    (folder / "lod-meta.json").write_text(json.dumps(index))
    out = tmp_path / "out.ply"
    assert run(monkeypatch, "convert", folder, out, "--quiet") == 2
    assert "is the finest (--level)" in capsys.readouterr().err
    assert run(monkeypatch, "inspect", folder) == 2
    assert "with `gscompleter convert`" in capsys.readouterr().err
    assert run(monkeypatch, "convert", folder, out, "--level", 0, "--quiet") == 0
    assert len(load_splat(out)) == 40

    wide = tmp_path / "wide.ply"
    write_degree_4_ply(wide, random_gaussians(20, sh_degree=3))
    # Both ways, through memory and through the file, and whether it is edited on the way or not.
    edits = ((), ("--crop-sphere", 0, 0, 0, 1000), ("--translate", 1, 0, 0), ("--decimate", "50%"))
    for number, edit in enumerate(edits):
        for ending in (".ply", ".spz"):
            out = tmp_path / f"b{number}{ending}"
            words = ("convert", wide, out, *edit, "--quiet")
            assert run(monkeypatch, *words) == 2
            assert "left out: 3 (--bands)" in capsys.readouterr().err
            assert not out.exists()
            assert run(monkeypatch, *words, "--bands", 3) == 0
            assert load_splat(out).sh_degree == 3


def test_a_file_of_a_streamed_scene_is_not_written_over(tmp_path, monkeypatch, capsys):
    """The index is the input that was named, and its files are read as well."""
    write_sog(tmp_path / "fine.sog", sog_files(plausible(40)))
    given = (tmp_path / "fine.sog").read_bytes()
    index = {"lodLevels": 1, "filenames": ["fine.sog"]}
    index["tree"] = {"lods": {"0": {"file": 0, "offset": 0, "count": 30}}}
    path = tmp_path / "lod-meta.json"
    path.write_text(json.dumps(index))
    words = ("convert", path, tmp_path / "fine.sog", "--level", 0, "--overwrite", "--quiet")
    assert run(monkeypatch, *words) == 2
    assert "fine.sog is the input" in capsys.readouterr().err
    assert (tmp_path / "fine.sog").read_bytes() == given
    # Beside them there is room.
    assert run(monkeypatch, "convert", path, tmp_path / "30.ply", "--level", 0, "--quiet") == 0
    assert len(load_splat(tmp_path / "30.ply")) == 30

    for content in ("[]", '{"filenames": 3}'):
        path.write_text(content)
        assert run(monkeypatch, "convert", path, tmp_path / "b.ply", "--level", 0) == 2
        assert "is no index of levels" in capsys.readouterr().err


def test_a_plain_ply_of_another_name_is_named(tmp_path, monkeypatch, capsys):
    save_ply(tmp_path / "plain.ply", SCENE)
    path = (tmp_path / "plain.ply").rename(tmp_path / "scene.compressed.ply")
    assert run(monkeypatch, "inspect", path) == 0
    assert "It is named .compressed.ply, and holds a plain .ply." in capsys.readouterr().out


def test_a_log_says_that_it_converts_a_large_file(tmp_path, monkeypatch, capsys):
    """The line is repeated while a large file takes long; without a stage there would be none."""
    save_ply(tmp_path / "a.ply", random_gaussians(20, seed=0))
    words = ("convert", tmp_path / "a.ply", tmp_path / "b.splat")
    assert run(monkeypatch, *words) == 0
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(converting, "MIN_LOGGED_BYTES", 1)
    words = (*words, "--overwrite")
    assert run(monkeypatch, *words) == 0
    assert capsys.readouterr().err == "converting\n"
    assert run(monkeypatch, *words, "--quiet") == 0
    assert capsys.readouterr().err == ""
