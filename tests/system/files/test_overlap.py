"""An output is never an input, holds none and lies in none, under whatever name."""

import json
import os
from pathlib import Path

import pytest

from gscompleter import InputError
from gscompleter.system.files.overlap import do_overlap, refuse_input_file, refuse_overlap


@pytest.fixture
def scene(tmp_path) -> Path:
    """Make a folder of photographs, whose depth is linked from another disk."""
    folder = tmp_path / "scene"
    (folder / "images").mkdir(parents=True)
    (folder / "images" / "a.jpg").write_text("mine")
    (tmp_path / "archive" / "depth").mkdir(parents=True)
    return folder


def write_listing(folder: Path, *files: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("old")
    (folder / "summary.json").write_text(
        json.dumps({"command": "complete", "files": [*files, "summary.json"]})
    )


@pytest.mark.parametrize(
    ("out", "relation"),
    [
        ("scene", "is"),
        ("scene/", "is"),
        ("scene/../scene", "is"),
        ("scene/images", "lies in"),
        ("scene/images/out", "lies in"),
        ("scene/not/yet/there", "lies in"),
        (".", "holds"),
        ("..", "holds"),
    ],
)
def test_an_output_folder_apart_from_its_input_is_demanded(
    scene, tmp_path, monkeypatch, out, relation
):
    monkeypatch.chdir(tmp_path)
    for given in (scene, Path("scene"), tmp_path / "archive" / ".." / "scene"):
        with pytest.raises(InputError, match=f" {relation} the input "):
            refuse_overlap(Path(out), [given])


@pytest.mark.parametrize("out", ["other", "scene2", "sce", "archive/out", "scene.out"])
def test_other_folders_are_accepted(scene, tmp_path, monkeypatch, out):
    monkeypatch.chdir(tmp_path)
    refuse_overlap(Path(out), [scene, Path("missing"), Path("a" * 300), Path("nul\0")])


@pytest.mark.linux
def test_outputs_that_do_not_exist_yet_may_overlap(tmp_path):
    assert do_overlap(tmp_path / "r", tmp_path / "r")
    assert do_overlap(tmp_path / "r" / "holes", tmp_path / "r")
    assert do_overlap(tmp_path / "r", tmp_path / "r" / "out")
    assert not do_overlap(tmp_path / "r", tmp_path / "s")


def test_links_hide_no_overlap(scene, tmp_path):
    (tmp_path / "link").symlink_to(scene)
    (scene / "depth").symlink_to(tmp_path / "archive" / "depth")
    for out in (tmp_path / "link", tmp_path / "link" / "out", tmp_path / "archive" / "depth"):
        with pytest.raises(InputError, match="the input"):
            refuse_overlap(out, [scene])
    with pytest.raises(InputError, match=r"is the input .*link"):
        refuse_overlap(scene, [tmp_path / "link"])
    with pytest.raises(InputError, match="to which .*scene links"):
        refuse_overlap(tmp_path / "archive", [scene])


def test_another_spelling_is_the_same_folder_where_the_disk_ignores_case(
    scene, tmp_path, monkeypatch
):
    """The disk is asked, not the names: here it answers as one that ignores case."""
    real = os.stat
    monkeypatch.setattr(os, "stat", lambda path, **more: real(str(path).lower(), **more))
    with pytest.raises(InputError, match="is the input"):
        refuse_overlap(tmp_path / "SCENE", [scene])
    with pytest.raises(InputError, match="lies in the input"):
        refuse_overlap(tmp_path / "Scene" / "out", [scene])


def test_a_file_is_no_place_and_its_folder_none_either(scene, tmp_path):
    video = tmp_path / "video.mp4"
    video.write_text("mine")
    for out, relation in ((video, "is"), (tmp_path, "holds")):
        with pytest.raises(InputError, match=f" {relation} the input"):
            refuse_overlap(out, [video])
    refuse_overlap(tmp_path / "out", [video])


def test_a_result_of_an_earlier_run_is_completed_in_place(tmp_path):
    out = tmp_path / "out"
    write_listing(out, "completed.ply", "scene/images/a.jpg")
    write_listing(out / "colmap", "images/a.jpg")
    (out / "mine.ply").write_text("mine")
    refuse_overlap(out, [out / "completed.ply", out / "colmap"])
    for given in (out / "mine.ply", out / "scene", out / "scene" / "images"):
        with pytest.raises(InputError, match="holds the input"):
            refuse_overlap(out, [given])
    with pytest.raises(InputError, match="holds the input"):
        refuse_overlap(out, [out / "completed.ply"], may_continue=False)


def test_an_output_file_is_no_input_and_no_part_of_one(scene, tmp_path):
    splat, out = tmp_path / "a.ply", tmp_path / "out"
    splat.write_text("mine")
    write_listing(out, "report.html")
    for file, given, relation in (
        (splat, splat, "is"),
        (scene / "index.json", scene, "lies in"),
        (out / "report.html", out, "is a part of"),
    ):
        with pytest.raises(InputError, match=f" {relation} the input"):
            refuse_input_file(file, [given])
    refuse_input_file(out / "view.html", [out])
    refuse_input_file(tmp_path / "b.ply", [splat, tmp_path / "missing"])
