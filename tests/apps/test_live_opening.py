"""A session of `live` that ended, or was killed, is opened again and goes on."""

from __future__ import annotations

import http.client
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from rich.console import Console

from command import run
from gscompleter import __version__, save_ply
from gscompleter.apps.commands.live import decide_live
from gscompleter.apps.commands.sessions import describe_value
from gscompleter.apps.live import saving, serving
from gscompleter.apps.live.journal import Journal
from gscompleter.apps.live.opening import SessionRequest
from gscompleter.apps.live.page import LivePage
from gscompleter.apps.live.session import Session, SessionStep, apply_step, redo_step, undo_step
from gscompleter.apps.live.strokes import list_steps, read_steps, read_strokes
from gscompleter.apps.viewer.packages import Libraries
from gscompleter.cli import parse_command
from gscompleter.config.generators import GeneratorOptions
from gscompleter.data.scene import describe_camera
from gscompleter.splats.edits import read_edits
from gscompleter.system.errors import InputError
from gscompleter.system.files.output_folder import list_session, read_listing, reserve_output
from gscompleter.system.files.result_format import RESULT_MARK
from gscompleter.types import Camera, Gaussians, merge
from live_marks import make_mark
from scenes import Room, camera_at, gaussians_of, photographed, view_of

SIZE = 48
CAMERAS = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in ((-0.3, 0), (0.1, 0), (0.4, 4))]
QUIET = Console(quiet=True)
CRATE = (-0.6, 0.2, 2.1, 0.4, 1.47, 3.1)
LEFT = (-2.0, -1.0, 2.0, -1.2, 2.0, 6.0)
SMALL = ("--resolution", SIZE, SIZE, "--near", 0.5, "--far", 20, "--context", 0, 1)


mark = partial(make_mark, SIZE)
"""Maker of a mask of the size of these cameras."""
SPOT = mark(slice(18, 30), slice(20, 32))
OTHER = mark(slice(2, 9), slice(34, 44))
STEPS = (
    SessionStep("remove", CAMERAS[0], box=CRATE),
    SessionStep("remove", CAMERAS[1], SPOT),
    SessionStep("remove", CAMERAS[1], OTHER),
)
"""Three steps that only remove, which takes no time."""
NO_START = saving.SessionStart({}, None, None, None, None, None)


def die(*_: object) -> None:
    raise KeyboardInterrupt


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    return photographed(tmp_path_factory.mktemp("opening") / "room", CAMERAS)


@pytest.fixture(scope="module")
def splat(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("splat") / "splat.ply"
    save_ply(path, merge([gaussians_of(view_of(Room(), camera)) for camera in CAMERAS]))
    return path


def find_opening(*words: object) -> SessionRequest:
    return decide_live(parse_command(["live", *map(str, words), "--no-open", "--quiet"])).session


class Program:
    """A session without its server, as `serve_live` runs it."""

    def __init__(self, *words: object) -> None:
        self.opening: SessionRequest = find_opening(*words)
        results = self.opening.completion.results
        with reserve_output(results.out, results.overwrite, "complete", saving.LIVE_RESULTS):
            self.ready = saving.prepare_session(self.opening, QUIET)
            begun = serving.open_session(self.ready, QUIET)
            self.journal: Journal = serving.open_journal(self.ready, begun)
        libraries = Libraries({}, {})
        self.page: LivePage = serving.build_page(self.ready, begun, libraries, QUIET, self.journal)

    @property
    def session(self) -> Session:
        return self.page.session

    def do(self, step: SessionStep) -> None:
        session, text = apply_step(self.session, step)
        self.page._change_session(session, text)

    def ask(self, action: str) -> dict:
        self.page.submit(json.dumps({"action": action}).encode())
        self.page.handle(self.page._requests.get())
        return self.page.channel.latest

    @property
    def scene(self) -> Gaussians:
        return self.session.latest.scene


def is_same(one: Gaussians, other: Gaussians) -> bool:
    names = ("means", "scales", "quats", "opacities", "sh", "generated")
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in names)


def actions_in(out: Path, key: str = "frames") -> list[str]:
    return [row["action"] for row in json.loads((out / "strokes.json").read_text())[key]]


def test_a_size_of_nothing_is_not_taken_for_none(room, tmp_path):
    words = ["live", str(room), "--resolution", "0", "--out", str(tmp_path / "out")]
    session = decide_live(parse_command(words)).session
    assert session.completion.source.scene.resolution == 0  # which opening the scene refuses


@pytest.mark.slow
def test_each_step_is_kept_at_once_and_a_session_goes_on(room, splat, tmp_path):
    out = tmp_path / "out"
    begun = Program(room, "--scene", splat, "--out", out, *SMALL)
    assert not out.exists()
    for count, step in enumerate(STEPS, start=1):
        begun.do(step)
        assert len(actions_in(out)) == count

    # Nothing of the first program ended: it may have been killed.
    again = Program(out)
    assert [step.box for step in again.session.steps] == [CRATE, None, None]
    assert [step.mask for step in again.session.steps] == [None, SPOT, OTHER]
    assert is_same(again.scene, begun.scene)
    said = again.page.channel.latest
    assert (said["steps"], said["revision"], said["saved"]) == (3, 1, False)
    assert "3 steps" in said["text"]
    for left in (2, 1, 0):
        assert again.ask("undo")["steps"] == left
        assert len(actions_in(out)) == left
    assert is_same(again.scene, begun.session.completions[0].scene)
    # What was undone can be done again by the next program, too.
    again.ask("redo")
    third = Program(out)
    assert (len(third.session.steps), len(third.session.undone)) == (1, 2)
    assert "1 step of the session is done again; go on" in third.page.channel.latest["text"]
    assert third.ask("redo")["steps"] == 2
    third.ask("redo")
    assert is_same(third.scene, begun.scene)


@pytest.fixture(scope="module")
def program(room, splat, tmp_path_factory) -> Program:
    """Return a program that saved its session, and did a further step."""
    out = tmp_path_factory.mktemp("saved") / "out"
    program = Program(room, "--scene", splat, "--out", out, *SMALL)
    program.do(STEPS[0])
    assert "Saved in" in program.ask("save")["text"]
    assert program.page.channel.latest["saved"] is True
    program.do(STEPS[1])
    return program


@pytest.fixture(scope="module")
def saved(program) -> Path:
    """Return the folder of the session."""
    return program.opening.out


@pytest.fixture
def begun(program) -> Session:
    """Return the session without steps."""
    session = program.session
    return replace(session, completions=session.completions[:1], steps=())


def test_a_completed_splat_of_a_session_is_opened_as_the_session(saved, tmp_path):
    for name in (saved, saved / "completed.ply", saved / "strokes.json"):
        words = ("--strokes", name) if name.suffix == ".json" else (name,)
        opening = find_opening(*words)
        assert opening.out == saved
        assert len(opening.steps) == 2
        assert opening.completion.source.scene.resolution == (SIZE, SIZE)
        assert opening.completion.source.context == (0, 1)
    # Elsewhere, what is saved there is not what the new folder has.
    elsewhere = find_opening(saved, "--out", tmp_path / "new")
    assert (len(elsewhere.steps), elsewhere.saved) == (2, None)
    assert find_opening(saved).saved is not None


def test_what_a_session_saved_and_did_since_is_told_apart(saved, program, begun):
    opening = find_opening(saved)
    assert read_listing(saved) >= {"completed.ply", "strokes.json", "images/stroke2.png"}
    files = json.loads((saved / "summary.json").read_text())["files"]
    assert "images/stroke2.png" not in files
    steps = opening.steps
    journal = Journal(saved, program.journal._start, opening.saved)
    assert not journal.is_saved(begun)
    assert journal.is_saved(replace(begun, steps=steps[:1]))
    assert not journal.is_saved(replace(begun, steps=steps))
    state, command = serving.describe_end(replace(begun, steps=steps), journal)
    assert "Not saved" in state
    assert command == f"To go on: gscompleter live {saved}"
    assert serving.describe_end(replace(begun, steps=steps[:1]), journal)[0].startswith("Saved")
    assert serving.describe_end(begun, Journal(saved / "other", program.journal._start)) == []


def copy_of(saved: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(saved, tmp_path / "copy"))


def test_a_session_goes_on_and_undo_reaches_back_to_the_input(program, saved, begun, tmp_path):
    """Nothing of the first program ended: it may have been killed."""
    out = copy_of(saved, tmp_path)
    again = Program(out)
    assert [(step.box, step.mask) for step in again.session.steps] == [(CRATE, None), (None, SPOT)]
    assert is_same(again.scene, program.scene)
    said = again.page.channel.latest
    assert (said["steps"], said["revision"], said["saved"]) == (2, 1, False)
    assert "2 steps" in said["text"]
    again.do(STEPS[2])
    assert len(actions_in(out)) == 3
    for left, is_saved in ((2, False), (1, True), (0, False)):
        said = again.ask("undo")
        assert (said["steps"], said["saved"]) == (left, is_saved)
        assert (len(actions_in(out)), len(actions_in(out, "undone"))) == (left, 3 - left)
    assert is_same(again.scene, begun.latest.scene)
    assert "All steps are undone" in again.ask("save")["text"]
    opening = find_opening(out)
    assert [step.mask for step in opening.undone] == [None, SPOT, OTHER]


def test_a_splat_that_was_changed_since_is_a_splat_of_its_own(saved, tmp_path):
    out = copy_of(saved, tmp_path)
    with (out / "completed.ply").open("r+b") as file:
        file.seek(-1, os.SEEK_END)
        file.write(b"\x01")
    opening = find_opening(out / "completed.ply", "--out", tmp_path / "new")
    assert (opening.steps, opening.completion.work.splat.path) == ((), out / "completed.ply")
    notes = find_opening(out).notes
    assert any("changed by another program" in note for note in notes)


def test_a_completed_splat_without_steps_is_opened_itself(saved, tmp_path):
    out = copy_of(saved, tmp_path)
    (out / "strokes.json").unlink()
    for name in (out, out / "completed.ply"):
        opening = find_opening(name, "--out", tmp_path / "new")
        assert (opening.steps, opening.completion.work.splat.path) == ((), out / "completed.ply")
    assert len(read_edits(opening.completion.work.splat.path).edits) == 1


def test_steps_are_done_on_a_scene_that_is_named(saved, room, splat, tmp_path):
    words = (room, "--scene", splat, "--strokes", saved, "--out", tmp_path / "new")
    opening = find_opening(*words)
    assert (len(opening.steps), opening.completion.source.scene.folder) == (2, room)
    assert opening.completion.source.context == (0, 1)
    with pytest.raises(InputError, match="holds a session, which knows its scene"):
        find_opening(saved, "--scene", splat, "--out", tmp_path / "new")
    with pytest.raises(InputError, match="steps of its own"):
        other = tmp_path / "strokes.json"
        shutil.copyfile(saved / "strokes.json", other)
        find_opening(saved, "--strokes", other)
    with pytest.raises(InputError, match="holds steps of its own"):
        find_opening(saved, "--strokes", tmp_path / "missing.json")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--near", 0.7), "began with"),
        (("--resolution", 64, 64), "began with"),
        (("--no-recolor",), "began with"),
        (("--seed", 3), "began with"),
        (("--generator", "smooth"), "began with"),
        (("--config", "paper"), "began with"),
    ],
)
def test_a_session_goes_on_with_its_own_settings(saved, words, said):
    with pytest.raises(InputError, match=said):
        find_opening(saved, *words)
    find_opening(saved, "--near", 0.5, "--device", "cpu", "--threads", 1)


def change(out: Path, **session: object) -> None:
    content = json.loads((out / "strokes.json").read_text())
    content["session"].update(session)
    (out / "strokes.json").write_text(json.dumps(content))


def begin(out: Path, *words: object) -> Path:
    """Begin a session without steps, as a program that was killed leaves it."""
    opening = find_opening(*words, "--out", out)
    out.mkdir()
    content = {
        **RESULT_MARK,
        "version": __version__,
        "resolution": opening.resolution,
        "session": opening.record,
        "frames": [],
    }
    (out / "strokes.json").write_text(json.dumps(content))
    return out


@pytest.mark.parametrize(
    "words",
    [
        ("--config.refine.iterations", 7),
        ("--config.refine.iterations", 7, "--no-recolor", "--holes", "enclosed"),
        ("--config", "paper", "--holes", "all"),
    ],
)
@pytest.mark.parametrize("has_splat", [False, True])
def test_a_setting_that_is_given_again_is_that_of_the_session(
    room, splat, tmp_path, words, has_splat
):
    scene = (room, "--scene", splat) if has_splat else (room,)
    out = begin(tmp_path / "out", *scene, *words)
    begun = find_opening(out).completion.work.config
    assert find_opening(out, *words).completion.work.config == begun
    with pytest.raises(InputError, match="began with") as told:
        find_opening(out, "--config.refine.iterations", 8)
    assert told.value.argument == "config"


@pytest.mark.parametrize(
    ("words", "kind"),
    [
        ((), "auto"),
        (("--config.holes.kind", "all"), "all"),
        (("--config.holes.kind", "enclosed"), "enclosed"),
        (("--holes", "all"), "all"),
    ],
)
def test_holes_of_a_splat_alone_are_those_that_the_session_began_with(splat, tmp_path, words, kind):
    out = begin(tmp_path / "out", splat, *words)
    for given in ((), words):
        assert find_opening(out, *given).completion.source.holes == kind


def test_an_option_that_an_early_session_did_not_know_is_refused_and_not_ignored(
    room, splat, tmp_path
):
    out = begin(tmp_path / "out", room)
    content = json.loads((out / "strokes.json").read_text())
    del content["session"]["geometry"]
    del content["session"]["synthesis"]["generator_retries"]
    (out / "strokes.json").write_text(json.dumps(content))
    for words in (("--geometry", splat), ("--generator-retries", 2)):
        with pytest.raises(InputError, match="began with"):
            find_opening(out, *words)
    assert find_opening(out).completion.work.geometry is None


def test_settings_that_an_early_session_did_not_know_are_no_difference(splat, tmp_path):
    words = ("--config.refine.iterations", 7)
    out = begin(tmp_path / "out", splat, *words)
    content = json.loads((out / "strokes.json").read_text())
    del content["session"]["config"]["margin"]
    del content["session"]["config"]["refine"]["rel_tol"]
    (out / "strokes.json").write_text(json.dumps(content))
    for given in (
        (out,),
        (out, *words),
        (splat, "--strokes", out, "--out", tmp_path / "b", *words),
    ):
        opening = find_opening(*given)
        assert opening.completion.work.config.refine.iterations == 7
        (note,) = opening.notes
        assert note.startswith("Going on")
    for other in (("--config.refine.iterations", 8), ("--config.margin", 0.3)):
        with pytest.raises(InputError, match="began with"):
            find_opening(out, *other)


def test_functions_of_ones_own_are_named_again_from_any_folder(room, tmp_path, monkeypatch):
    """The same word names another program in another folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("own.py", "elsewhere/own.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("def paint(*words):\n    return None\n\n\nkeep = paint\n")
    words = ("--generator", "own.py:paint", "--config.guards", "psnr", "own.py:keep")
    out = begin(tmp_path / "out", room, *words)
    monkeypatch.chdir(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="a program"):
        find_opening(out)
    with pytest.raises(InputError, match="began with"):
        find_opening(out, *words)
    same = [f"../{word}" if ".py:" in word else word for word in words]
    work = find_opening(out, *same).completion.work
    assert work.models.generator == f"{tmp_path}/own.py:paint"
    assert work.config.guards == ("psnr", f"{tmp_path}/own.py:keep")


def test_what_differs_from_the_session_is_said_where_a_scene_is_named(room, splat, tmp_path):
    out = begin(tmp_path / "out", room, "--scene", splat, "--seed", 3, "--generator", "oracle")
    words = (room, "--scene", splat, "--strokes", out, "--out", tmp_path / "new")
    (note,) = find_opening(*words, "--seed", 3, "--generator", "oracle").notes
    assert note.startswith("Going on")
    _, note = find_opening(*words).notes
    assert note.startswith("The session began with other values of --seed, --generator;")

    # Another splat is known as such, also by its folder.
    content = json.loads((out / "strokes.json").read_text())
    (out / "strokes.json").write_text(json.dumps({**content, "scene_sha256": "0" * 64}))
    alone = tmp_path / "alone"
    alone.mkdir()
    shutil.copyfile(splat, alone / "splat.ply")
    notes = find_opening(alone, "--strokes", out, "--out", tmp_path / "new").notes
    assert any("splat.ply is another file than the session began with" in note for note in notes)


def test_a_session_from_elsewhere_runs_no_program(saved, tmp_path, monkeypatch):
    out = copy_of(saved, tmp_path)
    # Named once more it is run, as a program of the user's own.
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evil.py").write_text("def run(views):\n    return None\n")
    change(out, reconstructor="evil.py:run")
    with pytest.raises(InputError, match="a program"):
        find_opening(out)
    opening = find_opening(out, "--reconstructor", "evil.py:run")
    assert opening.completion.work.models.reconstructor == "evil.py:run"


def test_what_is_missing_or_damaged_is_said(saved, tmp_path):
    out = copy_of(saved, tmp_path)
    change(out, scene=str(tmp_path / "moved.ply"))
    with pytest.raises(InputError, match=r"moved\.ply is missing"):
        find_opening(out)
    change(out, scene="/x" * 3000)
    with pytest.raises(InputError, match="is missing"):
        find_opening(out)
    change(out, seed="x")
    with pytest.raises(InputError, match="damaged"):
        find_opening(out)
    change(out, scene=None, folder=None)
    with pytest.raises(InputError, match="does not tell of which scene"):
        find_opening(out)
    content = json.loads((out / "strokes.json").read_text())
    del content["session"]
    (out / "strokes.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="does not tell of which scene"):
        find_opening(out)


def test_a_session_is_not_begun_over(saved, splat, tmp_path, monkeypatch, capsys):
    words = ("live", splat, "--out", saved, "--no-open")
    assert run(monkeypatch, *words) == 2
    assert f"go on with it by `gscompleter live {saved}`" in capsys.readouterr().err
    assert find_opening(splat, "--out", saved, "--overwrite").steps == ()
    with pytest.raises(InputError, match="holds the input"):
        find_opening(splat, "--out", splat.parent)


def test_a_program_that_is_killed_while_it_writes_leaves_whole_steps(begun, tmp_path, monkeypatch):
    """Another mask takes the place of one that was undone."""
    journal = Journal(tmp_path / "out", NO_START)
    two = begun.extended(begun.latest, STEPS[1]).extended(begun.latest, STEPS[2])
    journal.write(two)
    back = undo_step(two)
    journal.write(back)
    assert (actions_in(tmp_path / "out"), actions_in(tmp_path / "out", "undone")) == (
        ["remove"],
        ["remove"],
    )

    monkeypatch.setattr("gscompleter.apps.live.journal.write_masks", die)
    with pytest.raises(KeyboardInterrupt):
        journal.write(back.extended(begun.latest, SessionStep("fill", CAMERAS[1], SPOT)))
    # The step that was undone is given up before its mask is.
    assert actions_in(tmp_path / "out") == ["remove"]
    assert actions_in(tmp_path / "out", "undone") == []
    monkeypatch.undo()
    journal.write(undo_step(back))
    assert list_session(tmp_path / "out") >= {"strokes.json", "images/stroke1.png"}
    assert redo_step(undo_step(back)).steps == back.steps
    assert list_steps(undo_step(back)) == list_steps(two)[:2]


def test_a_session_that_goes_on_touches_no_mask_that_it_has(begun, tmp_path, monkeypatch):
    """A program that is killed while it begins would damage the steps that it goes on from."""
    two = begun.extended(begun.latest, STEPS[1]).extended(begun.latest, STEPS[2])
    Journal(tmp_path, NO_START).write(two)
    written = tmp_path / "images" / "stroke1.png"
    os.utime(written, (0, 0))
    Journal(tmp_path, NO_START).write(two)
    assert written.stat().st_mtime == 0
    assert actions_in(tmp_path) == ["remove", "remove"]
    # A session that begins anew in the folder drops the steps whose masks it replaces.
    monkeypatch.setattr("gscompleter.apps.live.journal.write_masks", die)
    with pytest.raises(KeyboardInterrupt):
        Journal(tmp_path, NO_START).write(begun.extended(begun.latest, STEPS[2]))
    assert actions_in(tmp_path) == []


def test_a_folder_that_somebody_removed_gets_all_masks_again(begun, tmp_path):
    journal = Journal(tmp_path / "out", NO_START)
    one = begun.extended(begun.latest, STEPS[1])
    journal.write(one)
    shutil.rmtree(tmp_path / "out")
    journal.write(one.extended(begun.latest, STEPS[2]))
    rows = read_strokes(tmp_path / "out" / "strokes.json").frames
    assert [step.mask for step in read_steps(rows, tmp_path / "out")] == [SPOT, OTHER]


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"box": [1, 1, 1, 0, 0, 0]}, "is damaged (frames.0: A box needs six numbers"),
        ({"box_rotation": [0, 0, 0, 0]}, "is damaged (frames.0: A rotation is a quaternion"),
        ({"box": None, "box_rotation": [0, 1, 0, 0]}, "(frames.0: A step without a box has a rot"),
        ({"action": "fill"}, "(frames.0: Only Remove takes a box, and fill has one"),
        ({"mask_path": "images/stroke1.png"}, "(frames.0: A step with a box"),
        ({"mask_path": "../stroke1.png"}, "only files beside it are read"),
        ({"mask_path": "C:/stroke1.png"}, "only files beside it are read"),
        ({"fl_x": -1.0}, "(frames.0: There is no such camera"),
        ({"w": 0}, "(frames.0: There is no such camera"),
        ({"transform_matrix": [[2.0, 0, 0, 0]] * 4}, "(frames.0: There is no such camera"),
    ],
)
def test_a_row_that_is_no_step_is_named_before_anything_is_opened(begun, tmp_path, values, said):
    Journal(tmp_path, NO_START).write(begun.extended(begun.latest, STEPS[0]))
    path = tmp_path / "strokes.json"
    content = json.loads(path.read_text())
    content["frames"][0].update(values)
    path.write_text(json.dumps(content))
    with pytest.raises(InputError) as told:
        read_strokes(path)
    assert said in str(told.value)
    assert str(told.value).startswith(str(path))
    # Whoever goes on with a session has no --box to correct.
    assert told.value.argument is None


def test_a_step_without_a_mask_leaves_none_of_the_step_in_its_place(begun, tmp_path):
    journal = Journal(tmp_path, NO_START)
    journal.write(begun.extended(begun.latest, STEPS[1]))
    journal.write(begun.extended(begun.latest, STEPS[0]))
    assert list_session(tmp_path) == {"strokes.json"}


@contextmanager
def served(*words: object) -> Iterator[tuple[subprocess.Popen, Callable[[str, bytes], dict]]]:
    """Serve a page in a process, and ask it as the page does, until the block kills it."""
    # The page itself is not looked at, so that it needs no libraries.
    # A background job ignores SIGINT.
    program = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"
        "from gscompleter.apps.viewer import packages as p; from gscompleter.cli import main;"
        "p.load_libraries = lambda: p.Libraries({}, {}); main()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program, "live", *map(str, words), "--no-open"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    found = re.match(r"http://(.*)/\?token=(\S+)", process.stdout.readline())
    assert found is not None
    host, token = found.groups()

    def ask(action: str, body: bytes) -> dict:
        """Ask for an action, and wait for its last message."""
        events = http.client.HTTPConnection(host, timeout=120)
        events.request("GET", f"/events?token={token}")
        heard = events.getresponse()
        last = json.loads(next_data(heard))
        if action:
            asking = http.client.HTTPConnection(host, timeout=120)
            headers = {"Content-Type": "application/json"}
            asking.request("POST", f"/do?token={token}", body, headers)
            assert asking.getresponse().status == 202
            last = json.loads(next_data(heard))
            while last["busy"]:
                last = json.loads(next_data(heard))
        events.close()
        return last

    try:
        yield process, ask
    finally:
        process.kill()
        process.communicate()


def next_data(response: http.client.HTTPResponse) -> bytes:
    line = response.readline()
    while not line.startswith(b"data: "):
        line = response.readline()
    return line.removeprefix(b"data: ")


def request_for(action: str, camera: Camera, **more: object) -> bytes:
    told = {"camera_model": "PINHOLE", "frames": [describe_camera(camera)]}
    return json.dumps({"action": action, "client": "me", "camera": told, **more}).encode()


@pytest.mark.slow
def test_a_killed_program_loses_no_step(room, splat, tmp_path):
    """SIGKILL after each of three steps; then undo three times gives the input."""
    out = tmp_path / "out"
    words: tuple[object, ...] = (room, "--scene", splat, "--out", out, *SMALL)
    boxes = (CRATE, LEFT, (1.2, -1.0, 2.0, 2.0, 2.0, 6.0))
    for count, box in enumerate(boxes, start=1):
        with served(*words) as (process, ask):
            assert ask("", b"")["steps"] == count - 1
            said = ask("remove", request_for("remove", CAMERAS[0], box=box))
            assert (said["steps"], said["saved"]) == (count, False), said["text"]
            os.kill(process.pid, signal.SIGKILL)
        words = (out,)
    with served(out) as (process, ask):
        assert ask("", b"")["steps"] == 3
        for left in (2, 1, 0):
            said = ask("undo", b'{"action": "undo"}')
            assert said["steps"] == left
        assert ask("redo", b'{"action": "redo"}')["steps"] == 1
        assert "Saved in" in ask("save", b'{"action": "save"}')["text"]
        assert ask("undo", b'{"action": "undo"}')["saved"] is False
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    *_, state, command = errors.splitlines()
    assert state.startswith("Not saved")
    assert command == f"To go on: gscompleter live {out}"
    # Nothing is left in the way.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]
    assert not [path for path in out.iterdir() if path.name.startswith(".")]
    assert read_listing(out) >= {"completed.ply", "strokes.json"}


def test_weights_and_depths_of_ones_own_are_kept_by_their_whole_paths(tmp_path, monkeypatch):
    """A later run may be elsewhere; a word that is no file stays a word."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "network").mkdir()
    given = GeneratorOptions(generator_weights="network", generator_depth="network")
    described = describe_value("synthesis", given)
    assert (
        described["generator_weights"] == described["generator_depth"] == str(tmp_path / "network")
    )
    (tmp_path / "monocular").mkdir()
    named = GeneratorOptions(generator_depth="monocular")
    assert describe_value("synthesis", named)["generator_depth"] == "monocular"
