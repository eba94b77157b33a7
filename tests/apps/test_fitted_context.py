"""A context that the command chooses is fitted to further photographs, and half of the rest."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from command import run
from exact_room import make_cameras, write_transforms
from gscompleter import GSCompleter, InputError
from gscompleter.apps.inputs.reading import MAX_FIT_VIEWS, add_fit_views, read_task
from gscompleter.apps.inputs.selection import limit_fitted_context
from gscompleter.apps.inputs.task import Opened
from gscompleter.apps.requests.scene import SceneRequest
from gscompleter.data.formats import open_photographs
from knowing_models import KnowingReconstructor
from scenes import Room, camera_at, view_of

SIZE = 48


def open_room(folder: Path, count: int, **changes) -> Opened:
    """Write and open a room with `count` photographs."""
    folder.mkdir()
    write_transforms(folder, make_cameras(count, width=SIZE, height=SIZE, focal=SIZE))
    photographs = open_photographs(folder)
    return Opened(SceneRequest(folder), photographs, "nerfstudio", count, **changes)


def add_to(opened: Opened, context: tuple[str, ...]) -> list[int | None]:
    """Add photographs to a context; return their frames."""
    task = read_task(opened, context, (), "cpu", False, is_fitted=True)
    return [view.frame for view in add_fit_views(task, opened).check_views or ()]


def test_half_of_what_is_left_stays_unused(tmp_path):
    opened = open_room(tmp_path / "room", 9)
    frames = add_to(opened, ("0", "4", "8"))
    assert len(frames) == 3
    assert not {*frames} & {0, 4, 8}


def test_there_are_at_most_so_many(tmp_path):
    opened = open_room(tmp_path / "room", 2 * MAX_FIT_VIEWS + 8)
    assert len(add_to(opened, ("0", "1", "2"))) == MAX_FIT_VIEWS


def test_a_pair_and_what_is_kept_back_are_left_alone(tmp_path):
    opened = open_room(tmp_path / "room", 7, held_out=(1, 2, 3))
    assert add_to(opened, ("0", "6")) == []
    assert add_to(opened, ("0", "4", "6")) == []  # one is left, which scores
    # Of two that are left, one is fitted to.
    assert add_to(open_room(tmp_path / "other", 8, held_out=(1, 2, 3)), ("0", "4", "6")) in (
        [5],
        [7],
    )


def test_others_take_the_place_of_damaged_photographs(tmp_path):
    opened = open_room(tmp_path / "room", 9)
    chosen = add_to(opened, ("0", "4", "8"))
    for frame in chosen:
        file = opened.photographs.frame(frame).image
        assert file is not None
        Path(file).write_bytes(b"no image")
    # Half of the three that are left.
    others = add_to(open_again(opened), ("0", "4", "8"))
    assert len(others) == 1
    assert not {*others} & {0, 4, 8, *chosen}


def open_again(opened: Opened) -> Opened:
    """Open the same folder again, without what was read of it."""
    folder = opened.request.folder
    return Opened(opened.request, open_photographs(folder), "nerfstudio", opened.num_photographs)


def count_context(opened: Opened, is_fitted: bool, targets: tuple[str, ...] = ()) -> int:
    """Count the photographs of the context that is chosen for targets, or for the whole scene."""
    return len(read_task(opened, None, targets, "cpu", False, is_fitted).views)


def test_three_quarters_of_the_photographs_are_the_context_of_a_fitted_scene(tmp_path):
    few = open_room(tmp_path / "few", 9)
    more = open_room(tmp_path / "more", 24)
    many = open_room(tmp_path / "many", 40)
    assert count_context(few, is_fitted=True) == 8
    assert count_context(more, is_fitted=True) == 18
    assert count_context(many, is_fitted=True) == 24
    # A network was trained with few.
    assert count_context(many, is_fitted=False) == 8


def test_up_to_eight_photographs_are_the_context_of_a_scene_fitted_for_targets(tmp_path):
    few = open_room(tmp_path / "few", 5)
    more = open_room(tmp_path / "more", 13)
    many = open_room(tmp_path / "many", 24)
    assert count_context(few, True, ("2",)) == 3
    assert count_context(more, True, ("6",)) == 6
    assert count_context(many, True, ("12",)) == 8
    assert count_context(many, False, ("12",)) == 3


def test_large_photographs_are_no_more_than_before():
    def limit(width: int, height: int) -> int:
        camera = replace(camera_at(0.0), width=width, height=height)
        return limit_fitted_context([camera] * 100, 3 / 4, 24)

    assert limit(640, 320) == 24
    assert limit(640, 480) == 16
    assert limit(800, 600) == 10
    # Whatever is asked at least is more than that.
    assert limit(1920, 1080) == 2


@pytest.mark.slow
def test_a_run_says_what_it_was_fitted_to_and_scores_others(tmp_path, monkeypatch, capsys):
    opened = open_room(tmp_path / "room", 14)
    out = tmp_path / "out"
    room = opened.request.folder
    assert run(monkeypatch, "complete", room, "--auto", 1, "--out", out) == 0
    said = capsys.readouterr()
    assert "fitted to 2 more" in said.out + said.err
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["scene"]["fitted"] == 2
    assert len(summary["held_out"]) == 2
    named = tmp_path / "named"
    context = [str(row["frame"]) for row in summary["context"]]
    chosen = ["--context", *context]
    assert run(monkeypatch, "complete", room, *chosen, "--auto", 1, "--out", named) == 0
    assert json.loads((named / "summary.json").read_text(encoding="utf-8"))["scene"]["fitted"] == 0


def test_a_model_that_cannot_fit_refuses_check_views_without_a_scene():
    views = [view_of(Room(), camera_at(x, size=32)) for x in (-0.3, 0.0, 0.3, 0.5)]
    completer = GSCompleter(KnowingReconstructor())
    with pytest.raises(InputError, match="Check views need a scene that they check"):
        completer(views[:3], camera_at(0.6, size=32), check_views=views[3:])
