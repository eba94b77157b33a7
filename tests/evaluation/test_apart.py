"""What a file keeps apart is used by --apart alone, which is written down and counted."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from apart import read_used_cases, select_scenes
from command import run
from gscompleter.apps.commands.evaluate import decide_evaluation
from gscompleter.apps.evaluating import cases as collecting
from gscompleter.cli import parse_command
from gscompleter.data.formats import open_photographs
from gscompleter.data.photographs import Photographs
from gscompleter.evaluation.apart import APART_HEAD, LEDGER, record_uses
from gscompleter.evaluation.case_file import read_case_file, read_scene_file
from gscompleter.evaluation.cases import ScenePlace, list_places, read_cases
from gscompleter.system.errors import InputError, OutputError
from paths import ROOT
from scenes import Room, camera_at, photographed

SIZE = 32
QUICK = ("--methods", "context", "--device", "cpu")


@pytest.fixture(scope="module")
def rooms(tmp_path_factory) -> Path:
    """Write two rooms, of which one is kept apart, as cases and as scenes."""
    root = tmp_path_factory.mktemp("rooms")
    cameras = [camera_at(x, size=SIZE) for x in (-0.3, 0.1, 0.5)]
    for name in ("seen", "unseen"):
        photographed(root / name, cameras, Room())
    write_cases(root / "cases.json", apart=["unseen"])
    (root / "scenes.json").write_text(json.dumps({"scenes": ["seen", "unseen"], "apart": ["seen"]}))
    return root


def count_uses(ledger: Path, file: Path) -> int:
    """Count the lines of a ledger that name a file of cases."""
    rows = ledger.read_text().splitlines()
    return sum(line.startswith("| ") and f" | {file.name} | " in line for line in rows)


def write_cases(path: Path, **keys: object) -> Path:
    """Write a file of a case in each room."""
    case = {"context": [0, 1], "target": 2, "near": 0.5, "far": 20.0}
    rows = [{"scene": name, **case} for name in ("seen", "unseen")]
    path.write_text(json.dumps({"resolution": [SIZE, SIZE], "cases": rows, **keys}))
    return path


def read_run(out: Path) -> tuple[set[str], dict[str, object]]:
    """Return the scenes of a run and the origin of its cases."""
    rows = [json.loads(path.read_text()) for path in out.glob("tasks/*/*.json")]
    source = json.loads((out / "run.json").read_text())["source"]
    return {row["task"]["name"].split()[0] for row in rows}, source


@pytest.mark.parametrize(
    ("apart", "expected"),
    [
        ([], (False, False)),
        (["unseen"], (False, True)),
        (True, (True, True)),
        (False, (False,) * 2),
    ],
)
def test_a_file_keeps_apart_the_scenes_that_it_names(tmp_path, apart, expected):
    path = write_cases(tmp_path / "cases.json", apart=apart)
    assert tuple(row.is_apart for row in read_case_file(path).rows) == expected
    assert tuple(case.apart_by == path for case in read_cases(path)) == expected
    path.write_text(json.dumps({"scenes": ["a/seen", "unseen"], "apart": apart}))
    assert tuple(row.is_apart for row in read_scene_file(path)) == expected
    places = [ScenePlace(tmp_path / "a" / "seen"), ScenePlace(tmp_path / "unseen")]
    assert [place.path for place in list_places(path)] == [place.path for place in places]


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ({"apart": ["unsen"]}, 'apart names "unsen", which is none of its scenes (seen, unseen)'),
        ({"apart": "unseen"}, 'apart has to be true or a list of names of scenes, and is "unseen"'),
        ({"apart": [1]}, "and is [1]."),
    ],
)
def test_a_misspelt_scene_is_refused_instead_of_used(tmp_path, content, sentence):
    for path in (write_cases(tmp_path / "cases.json", **content), tmp_path / "scenes.json"):
        path.write_text(json.dumps({"scenes": ["seen", "unseen"], **content}))
    with pytest.raises(InputError, match=re.escape(sentence)):
        read_case_file(write_cases(tmp_path / "cases.json", **content))
    with pytest.raises(InputError, match=re.escape(sentence)):
        read_scene_file(tmp_path / "scenes.json")


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ({"scenes": []}, "scenes has to be a list of folders, and is []."),
        ({"scenes": ["a", "a"]}, 'scene 2 is "a"; name different folders'),
        ({"scenes": ["a", "./a/"]}, 'scene 2 is "./a/"; name different folders'),
        ({"scenes": [""]}, 'scene 1 is "";'),
        ({"scene": ["a"]}, "has the key 'scene', which is none of scenes, about, apart"),
        ([], "it has to be an object with scenes."),
    ],
)
def test_a_mistake_in_a_file_of_scenes_is_one_sentence(tmp_path, content, sentence):
    (tmp_path / "s.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=re.escape(sentence)):
        read_scene_file(tmp_path / "s.json")


def test_evaluate_leaves_out_what_is_apart_and_says_so(rooms, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    assert run(monkeypatch, "evaluate", rooms / "cases.json", *QUICK, "--out", out) == 0
    assert "1 case is left out, because" in capsys.readouterr().err
    scenes, source = read_run(out)
    assert scenes == {"seen"}
    assert "apart" not in source
    assert "kept apart" not in (out / "tables.md").read_text()
    assert not (rooms / LEDGER).exists()


def test_a_use_is_written_down_and_counted_once(tmp_path, rooms, monkeypatch, capsys):
    # The ledger is the one above the file of cases.
    folder = tmp_path / "cases"
    folder.mkdir()
    (tmp_path / LEDGER).write_text(APART_HEAD)
    for name in ("seen", "unseen"):
        (folder / name).symlink_to(rooms / name)
    cases = write_cases(folder / "apart.json", apart=["unseen"])
    out = tmp_path / "out"
    words = ("evaluate", cases, *QUICK, "--apart", "--out", out)
    assert run(monkeypatch, *words) == 0
    scenes, source = read_run(out)
    assert scenes == {"seen", "unseen"}
    assert source["apart"] == 1
    for name in ("tables.md", "tables.tex", "timings.md"):
        said = "1 case that is kept apart was used (apart_uses.md)"
        assert said in (out / name).read_text()
    assert json.loads((out / "tables.json").read_text())["made_with"]["num_apart"] == 1
    assert count_uses(tmp_path / LEDGER, cases) == 1
    row = (tmp_path / LEDGER).read_text().splitlines()[-1]
    assert row.endswith("| apart.json | 1 | evaluate --methods context |")

    # Reading the scores of an earlier run is no further use; scoring again is.
    assert run(monkeypatch, *words) == 0
    assert count_uses(tmp_path / LEDGER, cases) == 1
    assert run(monkeypatch, *words, "--rerun", "scores") == 0
    assert count_uses(tmp_path / LEDGER, cases) == 2
    assert not (folder / LEDGER).exists()
    # What was scored with them is not continued without.
    capsys.readouterr()
    assert run(monkeypatch, "evaluate", cases, *QUICK, "--out", out) == 2
    assert "name another folder" in capsys.readouterr().err


def test_a_file_of_scenes_is_data_of_a_protocol(rooms, tmp_path, monkeypatch, capsys):
    words = ("evaluate", rooms / "scenes.json", "--protocol", "n-1", "--resolution", 32, 32, *QUICK)
    assert run(monkeypatch, *words, "--out", tmp_path / "out") == 0
    assert "1 scene is left out" in capsys.readouterr().err
    assert read_run(tmp_path / "out")[0] == {"unseen"}


def test_scenes_that_are_opened_in_vain_are_said_beside_what_is_apart(
    rooms, tmp_path, monkeypatch, capsys
):
    index = {"version": 1, "protocol": "mine", "scenes": {"elsewhere": None, "left": None}}
    (tmp_path / "index.json").write_text(json.dumps(index))
    reasons = {
        "n-9": "n-9 chooses none of its 3 frames",
        tmp_path / "index.json": "the index mine does not name it",
    }
    for protocol, reason in reasons.items():
        words = ("evaluate", rooms / "scenes.json", "--protocol", protocol, *QUICK)
        assert run(monkeypatch, *words, "--out", tmp_path / "out") != 0
        said = capsys.readouterr().err
        assert "1 scene is left out" in said
        assert f"Skipped unseen: {reason}." in said


def test_a_scene_is_opened_once_wherever_its_cases_stand(rooms, monkeypatch):
    rows = [("seen", [0, 1], 2), ("unseen", [0, 1], 2), ("seen", [1, 2], 0)]
    keys = ("scene", "context", "target")
    content = {"cases": [dict(zip(keys, row, strict=True)) for row in rows]}
    (rooms / "mixed.json").write_text(json.dumps({"resolution": [SIZE, SIZE], **content}))
    opened = []

    def open_scene(place: Path) -> Photographs:
        opened.append(place.name)
        return open_photographs(place)

    monkeypatch.setattr(collecting, "open_photographs", open_scene)
    options = parse_command(["evaluate", str(rooms / "mixed.json"), "--out", "out"])
    tasks = collecting.collect_tasks(decide_evaluation(options).cases, [], [])
    assert [task.scene for task in tasks] == ["seen", "unseen", "seen"]
    assert opened == ["seen", "unseen"]


def test_boxes_that_a_scene_lacks_are_refused_for_cases(rooms, tmp_path, monkeypatch, capsys):
    words = ("evaluate", rooms / "cases.json", "--ignore-moving", "--out", tmp_path / "out")
    assert run(monkeypatch, *words) == 2
    assert "seen has no boxes of moving objects" in capsys.readouterr().err


def test_nothing_but_what_is_apart_is_refused(tmp_path, monkeypatch, capsys):
    cases = write_cases(tmp_path / "cases.json", apart=True)
    assert run(monkeypatch, "evaluate", cases, *QUICK, "--out", tmp_path / "out") == 2
    assert "All of the 2 cases are kept apart by" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_use_that_cannot_be_counted_is_refused(tmp_path):
    cases = read_cases(write_cases(tmp_path / "cases.json", apart=True))
    (tmp_path / LEDGER).mkdir()
    with pytest.raises(OutputError, match="cannot be noted in"):
        record_uses(cases, "a test")


def test_scripts_leave_out_what_our_files_keep_apart(monkeypatch, capsys):
    monkeypatch.setenv("GSCOMPLETER_DATA", "/photographs")
    before = (ROOT / "benchmarks" / LEDGER).read_bytes()
    used = read_used_cases(ROOT / "benchmarks" / "development.json", uses_apart=False)
    assert len(used) == 18
    apart = {"re10k_000c3ab1", "redkitchen"}
    assert not apart & {case.scene.name for case in used}
    assert select_scenes([*apart, "fox", "a scene of yours"], False) == {"fox", "a scene of yours"}
    assert "2 scenes are left out" in capsys.readouterr().err
    with pytest.raises(InputError, match="All of the 16 cases are kept apart"):
        read_used_cases(ROOT / "benchmarks" / "held_out.json", uses_apart=False)
    for path in (ROOT / "benchmarks" / "many").glob("*.json"):
        assert {case.scene.name for case in read_cases(path) if case.apart_by} == apart
    assert (ROOT / "benchmarks" / LEDGER).read_bytes() == before
