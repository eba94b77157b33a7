"""Results of earlier versions are read and replaced, and those of later ones are named as such.

`fixtures/results` has one small result of each state in which `summary.json` was written: without
the files of its run, with them, and as it was before formats had numbers. Scenes keep a few rows,
pictures are of 8x8 pixels.
"""

import json
import os
import shutil
from pathlib import Path

import pytest

from command import run
from gscompleter import InputError
from gscompleter.apps.live.strokes import read_strokes
from gscompleter.apps.viewer.exhibit import load_viewer_completion
from gscompleter.data.scene import load_cameras, write_cameras
from gscompleter.system.files.output_folder import (
    check_output,
    open_output_folder,
    read_command,
    reserve_output,
)
from paths import TESTS
from scenes import camera_at

RESULTS = TESTS / "fixtures" / "results"
COMPLETIONS = ("without-listing", "with-listing", "before-formats")
LATER = r"was written by a later version of gscompleter \(format 99, this one reads up to 1\)"


@pytest.fixture(params=COMPLETIONS)
def earlier(request, tmp_path) -> Path:
    """Copy the result of an earlier version."""
    return Path(shutil.copytree(RESULTS / request.param, tmp_path / "out"))


@pytest.fixture
def later(completed_room, tmp_path) -> Path:
    """Copy a result, and let a later version have written it."""
    out = Path(shutil.copytree(completed_room, tmp_path / "out"))
    for name in ("summary.json", "targets.json", "report.json"):
        change(out / name, {"format": 99})
    return out


def change(path: Path, entries: dict[str, object]) -> None:
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, **entries}))


def test_view_reads_the_result_of_an_earlier_version(earlier):
    content = load_viewer_completion(earlier, drop_nonfinite=False)
    assert content.before is not None
    assert (len(content.before), len(content.after)) == (3, 5)
    assert content.after.generated.tolist() == [0, 0, 0, 1, 1]
    assert [camera.name for camera in content.cameras] == ["target-1"]
    # The photographs were named relative to where the command ran.
    (note,) = content.notes
    assert note.endswith("because room is not in this folder, and was named from another.")


def test_report_makes_the_page_of_an_earlier_version_again(earlier, monkeypatch, capsys):
    assert run(monkeypatch, "report", earlier) == 0, capsys.readouterr().err
    page = (earlier / "report.html").read_text()
    verdict = "An early version completed this scene, and gave no verdict."
    assert (verdict in page) == (
        "outcome" not in json.loads((earlier / "summary.json").read_text())
    )


def test_inspect_reads_the_result_of_an_earlier_version(earlier, monkeypatch, capsys):
    assert run(monkeypatch, "inspect", earlier, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["gaussians"], answer["invented"]) == (5, 2)
    (picture,) = answer["pictures"]
    assert picture["camera"].startswith("Target 1: photograph 2")


def test_strip_gives_the_given_scene_of_an_earlier_version_back(earlier, monkeypatch, tmp_path):
    words = ("strip", earlier / "completed.ply", "--out", tmp_path / "stripped.ply", "--quiet")
    assert run(monkeypatch, *words) == 0
    assert (tmp_path / "stripped.ply").read_bytes() == (earlier / "context.ply").read_bytes()


def test_overwrite_replaces_the_result_of_an_earlier_version_and_nothing_else(earlier):
    (earlier / "mine.txt").write_text("mine")
    (earlier / "images" / "holiday.png").write_text("mine")
    assert read_command(earlier) == "complete"
    with reserve_output(earlier, True, "complete", ["*.ply", "images/target*.png"]) as output:
        # The steps of a session were copied beside the result.
        others = {name for name in output.others if "stroke" not in name}
        assert others == {"mine.txt", "images/holiday.png"}
        with output.write() as folder:
            (folder / "completed.ply").write_text("new")
    left = {path.relative_to(earlier).as_posix() for path in earlier.rglob("*") if path.is_file()}
    assert {name for name in left if "stroke" not in name} == {
        *("completed.ply", "summary.json"),
        *("mine.txt", "images/holiday.png"),
    }


def test_overwrite_replaces_a_cleaned_splat_of_an_earlier_version(tmp_path):
    out = Path(shutil.copytree(RESULTS / "cleaned-without-listing", tmp_path / "out"))
    assert read_command(out) == "clean"
    with open_output_folder(out, overwrite=True, command="clean") as folder:
        (folder / "completed.ply").write_text("new")
    assert sorted(os.listdir(out)) == ["completed.ply", "summary.json"]


def test_overwrite_replaces_cameras_that_an_earlier_version_found(tmp_path):
    written = ("images/a_b.jpg", "images/c.heic.png", "sparse/0/images.bin", "summary.json")
    for name in (*written, "images/mine.jpg"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("old")
    content = {"poses": {}, "photographs": {"a b.jpg": [1, 2], "c.heic": [1, 2]}}
    (tmp_path / "summary.json").write_text(json.dumps(content))
    with open_output_folder(tmp_path, overwrite=True, command="poses") as folder:
        (folder / "images").mkdir()
        (folder / "images" / "a_b.jpg").write_text("new")
    assert sorted(os.listdir(tmp_path / "images")) == ["a_b.jpg", "mine.jpg"]
    assert not (tmp_path / "sparse").exists()


def test_what_an_early_version_did_not_write_is_no_damage(earlier, monkeypatch, capsys):
    content = json.loads((earlier / "summary.json").read_text())
    del content["coverage"]
    (earlier / "summary.json").write_text(json.dumps(content))
    assert run(monkeypatch, "report", earlier) == 2
    said = capsys.readouterr().err
    assert "summary.json was written by an early version, and has no coverage; complete" in said


def test_strokes_of_an_earlier_version_are_read(tmp_path):
    strokes = read_strokes(RESULTS / "before-formats" / "strokes.json")
    assert [row.action for row in strokes.frames] == ["repair", "remove"]
    path = tmp_path / "strokes.json"
    shutil.copy(RESULTS / "before-formats" / "strokes.json", path)
    change(path, {"format": 99})
    with pytest.raises(InputError, match=f"{path} {LATER}; update it"):
        read_strokes(path)


def test_cameras_of_a_later_version_are_refused_and_those_of_other_programs_are_not(tmp_path):
    path = tmp_path / "targets.json"
    write_cameras(path, [camera_at(0.0)])
    change(path, {"format": 99})
    with pytest.raises(InputError, match=LATER):
        load_cameras(path)
    change(path, {"program": "another"})
    assert len(load_cameras(path)) == 1


def test_every_file_of_a_result_says_its_format(completed_room):
    for name in ("summary.json", "targets.json", "report.json"):
        content = json.loads((completed_room / name).read_text())
        assert (content["program"], content["format"]) == ("gscompleter", 1)


@pytest.mark.parametrize("command", ["report", "inspect", "view"])
def test_a_result_of_a_later_version_is_not_called_damaged(later, monkeypatch, capsys, command):
    if command == "view":
        with pytest.raises(InputError, match=LATER):
            load_viewer_completion(later, drop_nonfinite=False)
        return
    assert run(monkeypatch, command, later) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "(format 99, this one reads up to 1); update it." in said
    assert "damaged" not in said


def test_a_result_of_a_later_version_is_not_overwritten(later):
    before = sorted(os.listdir(later))
    with pytest.raises(InputError, match=LATER):
        check_output(later, overwrite=True)
    assert sorted(os.listdir(later)) == before
