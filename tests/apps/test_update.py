"""`update`: photographs add to a splat what it lacks, also such whose cameras are not known."""

import json
from pathlib import Path
from unittest.mock import Mock

import pytest
from PIL import Image

from command import run
from gscompleter import load_ply, save_ply
from gscompleter.apps.completing import update
from gscompleter.apps.completing.preparation import Loaded
from gscompleter.apps.completing.update import find_remade, hold_out, select_lacking
from gscompleter.apps.inputs.task import Opened
from gscompleter.apps.requests.completion import WorkRequest
from gscompleter.apps.requests.scene import SceneRequest
from gscompleter.data.formats import open_photographs
from gscompleter.evaluation.verdict import held_out
from gscompleter.evaluation.verdict.held_out import render_before_after as render
from gscompleter.parts import NOT_INVENTED
from gscompleter.stages.add_observed import MAX_RECONSTRUCTED
from gscompleter.system.errors import InputError
from gscompleter.system.files.image import write_image
from gscompleter.types import merge
from scenes import Room, camera_at, gaussians_of, photographed, room_without_a_box, view_of

SIZE = 128
CAMERAS = [camera_at(x=0.25 * i - 0.875, y=0.1 * (i % 3), size=SIZE) for i in range(8)]
NEW = (3, 5)
"""Cameras whose photographs come without them."""


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """Write photographs with cameras."""
    known = [camera for number, camera in enumerate(CAMERAS) if number not in NEW]
    return photographed(tmp_path_factory.mktemp("room"), known)


@pytest.fixture(scope="module")
def new(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("new")
    for number in NEW:
        write_image(folder / f"{number}.png", view_of(Room(), CAMERAS[number]).image)
    return folder


@pytest.fixture(scope="module")
def cut(tmp_path_factory) -> Path:
    """Return a splat of the room without what stands near its middle."""
    path = tmp_path_factory.mktemp("splat") / "cut.ply"
    save_ply(path, room_without_a_box([CAMERAS[index] for index in (0, 4, 7)]))
    return path


def read_summary(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


def test_photographs_fill_a_splat_and_others_confirm_it(room, cut, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    words = ("update", room, "--scene", cut, "--far", 20, "--hold-out", 2, "--out", out)
    words += ("--resolution", 64)
    drawn = []
    monkeypatch.setattr(
        held_out, "render_before_after", lambda *given: drawn.append(given[1]) or render(*given)
    )
    assert run(monkeypatch, *words) == 0
    # Scores and pictures are of the same renders.
    assert len(drawn) == len({id(camera) for camera in drawn}) == 6
    summary = read_summary(out)
    assert summary["targets"] == []
    assert summary["gaussians"]["from_photographs"] == summary["gaussians"]["added"] > 100
    assert summary["settings"]["hold_out"] == 2

    # Photographs that were kept back are neither in the context nor among the checks.
    assert [row["frame"] for row in summary["held_out"]] == [1, 4]
    used = [row["frame"] for row in (*summary["context"], *summary["checks"])]
    assert sorted(used) == [0, 2, 3, 5]
    for row in (*summary["context"], *summary["held_out"]):
        assert row["psnr_after"] > row["psnr_before"] + 3
    assert "not used: 1 (1.png)" in capsys.readouterr().out

    # The page shows each of them, and first those that were not used.
    page = (out / "report.html").read_text()
    assert page.count(", used</h3>") == 4
    assert page.index("Photograph 1 (1.png), not used") < page.index("Photograph 0 (0.png), used")
    names = {path.name for path in (out / "images").iterdir()}
    assert {"photograph1_before.png", "photograph6_after.png", "photograph6_truth.png"} <= names

    back = tmp_path / "back.ply"
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", back, "--quiet") == 0
    assert back.read_bytes() == cut.read_bytes()


@pytest.mark.slow
def test_photographs_without_cameras_are_placed_and_used(
    room, new, cut, tmp_path, monkeypatch, capsys
):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    out = tmp_path / "out"
    words = ("update", room, "--scene", cut, "--far", 20, "--photos", new, "--out", out)
    assert run(monkeypatch, *words) == 0
    summary = read_summary(out)
    assert summary["scene"]["photographs"] == 8
    frames = {row["frame"] for row in summary["context"]}
    assert {6, 7} <= frames
    printed = capsys.readouterr()
    assert "2 of 2 new photographs were placed among those of the scene." in printed.err
    assert "context 6 (new0/3.png)" in printed.out
    for row in summary["context"]:
        assert row["psnr_after"] > row["psnr_before"] + 2
    assert bool((load_ply(out / "completed.ply").generated == NOT_INVENTED).any())
    assert (out / "colmap" / "images" / "3.png").is_file()


@pytest.mark.slow
def test_a_splat_that_lacks_nothing_stays(room, tmp_path, monkeypatch, capsys):
    known = [camera for number, camera in enumerate(CAMERAS) if number not in NEW]
    whole = merge([gaussians_of(view_of(Room(), camera)) for camera in known])
    path = tmp_path / "whole.ply"
    save_ply(path, whole)
    out = tmp_path / "out"
    assert run(monkeypatch, "update", room, "--scene", path, "--far", 20, "--out", out) == 0
    said = capsys.readouterr().out
    assert said.startswith("Nothing was gained, because photographs show nothing that the splat")


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (("--hold-out", 6), "there are 6 to choose from, and at least 2 of 6 have to be left"),
        (("--photos", "nowhere"), "There are no photographs in nowhere"),
        (("--config", "paper"), "nothing is added from photographs, as in the config paper"),
        (("--config", "paper"), "With config.add_observed off nothing is added from photographs"),
        (("--target", 1), "update has no option --target, which belongs to"),
    ],
)
def test_wrong_options_are_refused_in_a_sentence(
    room, cut, tmp_path, monkeypatch, capsys, more, sentence
):
    out = tmp_path / "out"
    assert run(monkeypatch, "update", room, "--scene", cut, "--out", out, *more) == 2
    assert sentence in capsys.readouterr().err
    assert not out.exists()


def open_room(folder: Path) -> Opened:
    photographs = open_photographs(folder)
    return Opened(SceneRequest(folder, resolution=64), photographs, "nerfstudio", len(photographs))


def test_a_photograph_that_a_mask_hides_wholly_is_not_kept_back(tmp_path):
    folder = photographed(tmp_path / "masked", CAMERAS)
    assert hold_out(open_room(folder), 2, None, ()).held_out == (2, 6)
    (folder / "masks").mkdir()
    for name in ("2.png", "4.png"):
        Image.new("L", (SIZE, SIZE)).save(folder / "masks" / name)
    held = hold_out(open_room(folder), 2, None, ()).held_out
    assert len(held) == 2
    assert not {2, 4} & set(held)
    with pytest.raises(InputError, match="there are 6 to choose from, and at least 2 of 6"):
        hold_out(open_room(folder), 6, None, ())


def test_new_photographs_leave_room_for_those_of_the_scene_that_show_a_lack(monkeypatch):
    context = (0, 1)
    new = list(range(30, 50))
    # All lack something, and new photographs and the context most.
    shares = {frame: 0.1 + 0.001 * frame for frame in range(50)} | dict.fromkeys(context, 0.9)
    asked = []

    def make_task(opened, frames, *others, **options):
        asked.append(frames)
        raise InputError("enough is known")

    monkeypatch.setattr(update, "measure_lacks", lambda loaded: shares)
    monkeypatch.setattr(update, "count_pixels", lambda photographs, resolution: SIZE * SIZE)
    monkeypatch.setattr(update, "make_task", make_task)
    # All stand in one place, so that shares alone decide.
    cameras = dict.fromkeys(range(50), CAMERAS[0])
    loaded = Mock(
        spec=Loaded, opened=Mock(held_out=()), task=Mock(context_frames=context), cameras=cameras
    )
    with pytest.raises(InputError, match="enough is known"):
        update.choose_evidence(Mock(spec=WorkRequest), None, loaded, new, ())
    joined = range(30 - update.MAX_LACKING, 30)
    assert asked == [(*context, *joined, *new)]

    # A scene of ours is made anew, and takes what one reconstruction does.
    del asked[:]
    with pytest.raises(InputError, match="enough is known"):
        update.choose_evidence(Mock(spec=WorkRequest), None, loaded, new, context)
    assert asked == [(*context, 28, 29, *new)]
    assert len(asked[0]) == MAX_RECONSTRUCTED


def test_photographs_that_lack_as_much_are_taken_apart_from_each_other():
    cameras = {frame: camera_at(x=0.1 * frame, size=SIZE) for frame in range(20)}
    shares = dict.fromkeys(cameras, 1.0)
    assert select_lacking(shares, cameras, {18, 19}, 3) == [0, 9, 4]
    assert select_lacking({**shares, 3: 0.001}, cameras, {0}, 19) != sorted(cameras)
    # Nothing is missing where little is.
    assert select_lacking(dict.fromkeys(cameras, 0.001), cameras, {0}, 3) == []
    # What lacks much is better than what stands farthest.
    assert select_lacking({4: 0.9, 19: 0.05}, cameras, {0}, 1) == [4]


@pytest.mark.parametrize(("count", "own"), [(1, (0, 1)), (30, ())])
def test_a_scene_of_ours_is_made_anew_unless_photographs_are_too_many(monkeypatch, count, own):
    monkeypatch.setattr(update, "read_edits", lambda path: None)
    monkeypatch.setattr(update, "find_own_photographs", lambda *asked: (0, 1))
    monkeypatch.setattr(update, "count_pixels", lambda photographs, resolution: SIZE * SIZE)
    work = Mock(spec=WorkRequest)
    opened = Mock(spec=Opened, photographs=None, request=Mock())
    new = range(10, 10 + count)
    assert find_remade(work, opened, new) == own
    work.config.add_observed = False
    assert find_remade(work, opened, new) == ()


def test_a_photograph_that_cannot_be_read_is_not_kept_back_in_silence(tmp_path):
    folder = photographed(tmp_path / "damaged", CAMERAS)
    path = folder / "2.png"
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match=r"2\.png"):
        hold_out(open_room(folder), 2, None, ())


def test_a_scene_without_cameras_has_no_place_for_new_photographs(
    new, cut, tmp_path, monkeypatch, capsys
):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    bare = tmp_path / "bare"
    bare.mkdir()
    for number in (0, 1, 2, 4, 6, 7):
        write_image(bare / f"{number}.png", view_of(Room(), CAMERAS[number]).image)
    words = ("update", bare, "--scene", cut, "--photos", new, "--out", tmp_path / "out")
    assert run(monkeypatch, *words) == 2
    assert "put all photographs into one folder" in capsys.readouterr().err
