"""`gscompleter live` without a browser: steps, undo and saving."""

from __future__ import annotations

import base64
import gzip
import http.client
import io
import json
import re
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial, partialmethod
from pathlib import Path
from socketserver import BaseServer
from types import SimpleNamespace
from urllib.parse import urlsplit

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console
from scipy.spatial.transform import Rotation

from command import run
from gscompleter import load_cameras, load_ply, save_ply
from gscompleter.apps.commands.live import LiveOptions, decide_live
from gscompleter.apps.live import saving, serving
from gscompleter.apps.live.addresses import Address, resolve_host
from gscompleter.apps.live.difference import PageScene
from gscompleter.apps.live.journal import Journal
from gscompleter.apps.live.page import BUSY, LivePage
from gscompleter.apps.live.request import parse_request
from gscompleter.apps.live.saving import PreparedSession
from gscompleter.apps.live.server import LiveServer
from gscompleter.apps.live.session import (
    Session,
    SessionStep,
    apply_step,
    describe_outcome,
    redo_step,
    save_camera,
    undo_step,
)
from gscompleter.apps.viewer import http as served
from gscompleter.apps.viewer.packages import Libraries
from gscompleter.apps.viewer.page import read_asset
from gscompleter.cli import parse_command
from gscompleter.config import CompleterConfig
from gscompleter.data.scene import describe_camera
from gscompleter.numerics.geometry import project
from gscompleter.splats.alignment.similarity import make_similarity, transform_camera
from gscompleter.splats.formats import load_splat
from gscompleter.splats.transform import transform_gaussians
from gscompleter.system.errors import InputError
from gscompleter.system.progress import notify_of_stages
from gscompleter.system.timing import STAGES
from gscompleter.types import Camera, ContextScene, Gaussians, merge
from live_marks import make_mark
from scenes import Room, camera_at, gaussians_of, photographed, view_of

SIZE = 48
CAMERAS = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in ((-0.3, 0), (0.1, 0), (0.4, 4))]
HOLES = [camera_at(0.7, 0.1, 0.05, yaw=14, size=SIZE), camera_at(-0.7, yaw=-16, size=SIZE)]
"""Cameras at holes of the room, to the right and to the left of the photographs."""
ELSEWHERE = make_similarity(
    0.3, Rotation.from_rotvec([0.9, -1.7, 0.4]).as_matrix(), np.array([5.0, 3.0, -2.0])
)
QUIET = Console(quiet=True)
FIELDS = ("means", "scales", "quats", "opacities", "sh", "generated")


def complete_camera(session: Session, camera: Camera) -> tuple[Session, str]:
    """Complete the scene for a camera in the frame of the result."""
    return apply_step(session, SessionStep("complete", save_camera(session, camera)))


mark = partial(make_mark, SIZE)
"""Maker of a mask of the size of these cameras."""
SPOT = mark(slice(18, 30), slice(20, 32))
"""A mark in the middle of an image."""


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    return photographed(tmp_path_factory.mktemp("live") / "room", CAMERAS)


def options_for(room: Path, out: Path, **others) -> LiveOptions:
    size = (SIZE, SIZE)
    given = {"context": (0, 1), "near": 0.5, "far": 20.0, "resolution": size, "quiet": True}
    return LiveOptions(folder=room, out=out, **{**given, **others})


def prepare(options: LiveOptions) -> PreparedSession:
    return saving.prepare_session(decide_live(options).session, QUIET)


@pytest.fixture(scope="module")
def ready(room, tmp_path_factory) -> PreparedSession:
    return prepare(options_for(room, tmp_path_factory.mktemp("outs") / "out"))


@pytest.fixture(scope="module")
def begun(ready) -> Session:
    return serving.begin_session(ready)


@pytest.fixture(scope="module")
def completed(begun) -> tuple[Session, str, list[str], int]:
    """Return the session with a hole completed, what is said, the stages heard, and how many."""
    heard: list[str] = []
    with notify_of_stages(heard.append):
        one, text = complete_camera(begun, HOLES[0])
    return one, text, heard, len(heard)


@pytest.fixture(scope="module")
def twice(completed) -> Session:
    """Return the session with both holes completed."""
    return complete_camera(completed[0], HOLES[1])[0]


def test_undo_goes_back_and_the_same_camera_leads_to_the_same_scene(begun, completed, twice):
    (one, text, *_), two = completed, twice
    assert "Gaussians are added in a hole" in text
    assert one.latest.targets[-1].hole_fraction > 0.1
    assert len(begun.latest.added) < len(one.latest.added) < len(two.latest.added)
    assert undo_step(two) == one
    assert undo_step(undo_step(two)) == begun
    again, _ = complete_camera(undo_step(two), HOLES[1])
    for name in FIELDS:
        assert torch.equal(getattr(again.latest.scene, name), getattr(two.latest.scene, name)), name


def test_a_step_that_only_recolours_says_so(completed):
    result = completed[0].latest.targets[-1]
    recoloured = replace(result, added=result.added[:0], num_recolored=1234)
    assert describe_outcome(recoloured).startswith("1,234 Gaussians are recoloured in a hole of ")


def test_what_is_undone_is_done_again_until_something_else_is_done(twice):
    two = twice
    back = undo_step(undo_step(two))
    assert redo_step(redo_step(back)) == two
    assert redo_step(back).latest is two.completions[1]
    other, _ = complete_camera(back, HOLES[1])
    for session in (two, other):
        with pytest.raises(InputError, match="nothing to redo"):
            redo_step(session)


def test_there_is_nothing_to_undo_in_the_beginning(begun):
    with pytest.raises(InputError, match="nothing to undo"):
        undo_step(begun)


def test_a_camera_that_adds_nothing_is_no_step(begun):
    session, text = complete_camera(begun, begun.latest.views[0].camera)
    assert session is begun
    assert text.startswith("The scene is known at this camera already: nothing to complete. ")
    assert "“Find a hole” leads to one" in text


def test_stages_are_heard_as_they_begin(completed, twice):
    *_, heard, count = completed
    assert list(dict.fromkeys(heard)) == list(STAGES)
    assert len(heard) == count, "the second completion was heard, too"


def the_same_as_complete(monkeypatch, ready: PreparedSession, tmp_path: Path, *more) -> bool:
    """Compare the saved files with those of `complete` at the saved cameras."""
    out, other = ready.request.out, tmp_path / "by complete"
    context = json.loads((out / "summary.json").read_text())["settings"]["context"]
    arguments = ("--context", *context, "--target", out / "targets.json", "--out", other)
    size = ("--resolution", SIZE, SIZE, "--near", 0.5, "--far", 20, "--quiet")
    assert (
        run(monkeypatch, "complete", ready.scene.source.scene.folder, *arguments, *size, *more) == 0
    )
    names = ("completed.ply", "context.ply", "generated.ply", "images/target1_after.png")
    names_of_both = [{path.name for path in folder.iterdir()} for folder in (out, other)]
    assert names_of_both[0] - names_of_both[1] == {"strokes.json"}
    return all((out / name).read_bytes() == (other / name).read_bytes() for name in names)


@pytest.mark.slow
def test_what_is_saved_is_what_complete_writes(ready, begun, tmp_path, monkeypatch):
    with pytest.raises(InputError, match="nothing to save"):
        serving.save_session(ready, begun)
    session, _ = complete_camera(begun, HOLES[0])
    assert str(ready.request.out) in serving.save_session(ready, session)
    assert the_same_as_complete(monkeypatch, ready, tmp_path)
    session, _ = complete_camera(session, HOLES[1])
    serving.save_session(ready, session)  # replaces its own files
    assert len(json.loads((ready.request.out / "summary.json").read_text())["targets"]) == 2
    assert the_same_as_complete(monkeypatch, ready, tmp_path, "--overwrite")


def test_what_others_wrote_is_not_replaced(room, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="not empty"):
        prepare(options_for(room, tmp_path / "out"))


@pytest.mark.slow
def test_what_is_saved_of_a_splat_in_a_frame_of_its_own_is_too(tmp_path, monkeypatch):
    """Cameras are written in the frame of the photographs without loss."""
    room = photographed(tmp_path / "room", CAMERAS)
    told = {"transform": (np.diag([1 / 0.3] * 3 + [1]) @ ELSEWHERE)[:3].tolist(), "scale": 0.3}
    (room / "dataparser_transforms.json").write_text(json.dumps(told))
    scene = merge([gaussians_of(view_of(Room(), camera)) for camera in CAMERAS[:2]])
    save_ply(
        tmp_path / "splat.ply", transform_gaussians(scene, torch.from_numpy(ELSEWHERE).float())
    )
    options = options_for(room, tmp_path / "out", scene=tmp_path / "splat.ply")
    ready = prepare(options)
    assert ready.scene.task.method == "dataparser"
    session = serving.begin_session(ready)
    target = transform_camera(HOLES[0], ready.scene.task.frame)
    session, _ = complete_camera(session, target)
    assert len(session.latest.added) > 0
    assert torch.allclose(session.cameras[0].c2w.float(), HOLES[0].c2w, atol=1e-6)
    serving.save_session(ready, session)
    assert the_same_as_complete(monkeypatch, ready, tmp_path, "--scene", options.scene)


@pytest.mark.slow
def test_an_antialiased_splat_is_saved_as_one(room, tmp_path):
    scene = merge([gaussians_of(view_of(Room(), camera)) for camera in CAMERAS[:2]])
    save_ply(tmp_path / "splat.ply", replace(scene, is_antialiased=True))
    options = options_for(room, tmp_path / "out", scene=tmp_path / "splat.ply")
    ready = prepare(options)
    session, _ = complete_camera(serving.begin_session(ready), HOLES[0])
    serving.save_session(ready, session)
    for name in ("context.ply", "completed.ply", "generated.ply"):
        assert load_ply(tmp_path / "out" / name).is_antialiased, name


def prepare_alone(folder: Path, monkeypatch) -> PreparedSession:
    """Prepare a session with a splat of one photograph, in the folder of the splat."""
    save_ply(folder / "splat.ply", gaussians_of(view_of(Room(), camera_at(size=SIZE))))
    monkeypatch.chdir(folder)
    words = ["live", "splat.ply", "--out", "out", "--resolution", "64", "64", "--no-open"]
    return prepare(parse_command(words))


def test_a_splat_alone_begins_at_the_camera_of_its_pixels(tmp_path, monkeypatch):
    ready = prepare_alone(tmp_path, monkeypatch)
    assert ready.scene.opened.renders_from == "pixels"
    assert ready.scene.completer.config.trust == "full"


# `test_splat_alone.py` completes and saves such a splat.
@pytest.mark.slow
def test_a_splat_alone_is_completed_and_saved(tmp_path, monkeypatch):
    ready = prepare_alone(tmp_path, monkeypatch)
    session, _ = complete_camera(serving.begin_session(ready), HOLES[0])
    assert len(session.latest.added) > 0
    serving.save_session(ready, session)
    assert (tmp_path / "out" / "renders.json").is_file()
    kept = load_ply(tmp_path / "out" / "completed.ply")
    assert torch.equal(kept[kept.generated == 0].means, load_ply(tmp_path / "splat.ply").means)


# `tests/virtual_capture/test_standpoints.py` finds such cameras.
@pytest.mark.slow
def test_a_trained_splat_alone_begins_where_it_looks_well(tmp_path, monkeypatch):
    monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_RANDOM", 80)
    monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_IMPROVED", 8)
    cameras = [camera_at(yaw=angle, size=SIZE, focal=0.45) for angle in (0, 90, 180, 270)]
    room = merge([gaussians_of(view_of(Room(), camera)) for camera in cameras])
    # As large as those of a trainer, whatever the distance.
    save_ply(tmp_path / "room.ply", replace(room, scales=torch.full_like(room.scales, 0.1)))
    options = LiveOptions(scene=tmp_path / "room.ply", out=tmp_path / "out", resolution=(48, 48))
    ready = prepare(options)
    assert ready.scene.opened.renders_from == "standpoints"
    session = serving.begin_session(ready)
    assert len(session.latest.views) >= 2
    for view in session.latest.views:
        assert view.valid_mask.float().mean() > 0.5


def test_the_frames_that_were_chosen_are_named(room, tmp_path):
    ready = prepare(options_for(room, tmp_path / "out", context=None))
    assert ready.scene.source.context == tuple(view.frame for view in ready.scene.task.views)
    assert len(ready.scene.source.context) >= 2


def test_a_hole_is_found_where_something_is_missing(ready, begun):
    camera = serving.find_next_target(ready.scene, begun)
    assert camera is not None
    session, _ = complete_camera(begun, camera)
    assert session.latest.targets[-1].hole_fraction > 0.05


CRATE = (-0.6, 0.2, 2.1, 0.4, 1.47, 3.1)
"""A box around the one in the middle of the room."""


@pytest.fixture(scope="module")
def splat(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("splat") / "splat.ply"
    save_ply(path, merge([gaussians_of(view_of(Room(), camera)) for camera in CAMERAS]))
    return path


@pytest.fixture(scope="module")
def splat_ready(room, splat, tmp_path_factory) -> PreparedSession:
    out = tmp_path_factory.mktemp("outs") / "out"
    options = options_for(room, out, scene=splat)
    return prepare(options)


@pytest.fixture(scope="module")
def splat_begun(splat_ready) -> Session:
    return serving.begin_session(splat_ready)


def remove_box(session: Session, box: tuple[float, ...]) -> tuple[Session, str]:
    step = SessionStep("remove", save_camera(session, CAMERAS[0]), box=box)
    return apply_step(session, step)


@pytest.fixture(scope="module")
def without_crate(splat_begun) -> tuple[Session, str]:
    """Return the session of the splat without the crate, and what is said."""
    return remove_box(splat_begun, CRATE)


def test_a_box_is_removed_and_undone(splat_begun, without_crate):
    begun, (removed, text) = splat_begun, without_crate
    count = int(removed.latest.source.gone_mask.sum())
    assert count > 100
    assert f"{count:,} Gaussians are removed" in text
    assert "--box -0.6 0.2 2.1 0.4 1.47 3.1 --box-rotation 1 0 0 0" in text
    rest = removed.latest.added  # of what reached out of the box
    assert len(removed.latest.scene) == len(begun.latest.scene) - count + len(rest)
    assert undo_step(removed) == begun
    # A replay goes on where nothing is left to remove.
    unchanged, text = remove_box(removed, (50.0, 50.0, 50.0, 51.0, 51.0, 51.0))
    assert unchanged is removed
    assert "contains nothing" in text


def test_after_a_removal_other_holes_are_found_too(splat_ready, without_crate, monkeypatch):
    removed, _ = without_crate
    tried = []

    def plan(planner, state, cameras, count):
        tried.append(state.config)
        return [] if state is removed.latest else [SimpleNamespace(camera=cameras[1])]

    monkeypatch.setattr(type(splat_ready.scene.explorer), "plan", plan)
    camera = serving.find_next_target(splat_ready.scene, removed)
    assert camera is list(splat_ready.scene.cameras.values())[1]
    assert tried == [removed.latest.config, removed.first_config]
    assert tried[0] != tried[1]


# `test_live_opening.py` saves and undoes several steps, and `test_remove.py` strips a removal.
@pytest.mark.slow
def test_a_box_is_removed_completed_undone_and_saved(
    splat_ready, without_crate, splat, tmp_path, monkeypatch
):
    removed, _ = without_crate
    rest = removed.latest.added
    filled, _ = complete_camera(removed, CAMERAS[2])
    assert len(filled.latest.added) > len(rest)
    emptied, _ = remove_box(filled, (-2.0, -1.0, 2.0, 2.0, 2.0, 6.0))
    assert len(emptied.latest.scene) < len(filled.latest.scene)
    assert undo_step(emptied) == filled
    assert undo_step(filled) == removed
    serving.save_session(splat_ready, filled)
    out, restored = splat_ready.request.out, tmp_path / "restored.ply"
    assert json.loads((out / "summary.json").read_text())["gaussians"]["removed"] > 100
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", restored, "--quiet") == 0
    assert restored.read_bytes() == splat.read_bytes()
    serving.save_session(splat_ready, removed)
    assert json.loads((out / "summary.json").read_text())["gaussians"]["added"] == len(rest)


def test_after_a_removal_another_hole_is_completed_as_before(without_crate):
    removed, _ = without_crate
    elsewhere, _ = complete_camera(removed, HOLES[1])
    assert len(elsewhere.latest.added) > len(removed.latest.added)
    assert elsewhere.latest.config == removed.latest.config


def marked(session: Session, action: str, mask: bytes | None = SPOT) -> SessionStep:
    return SessionStep(action, save_camera(session, CAMERAS[1]), mask)


@pytest.fixture(scope="module")
def without_spot(splat_begun) -> Session:
    """Return the session of the splat without what is marked."""
    return apply_step(splat_begun, marked(splat_begun, "remove"))[0]


@pytest.fixture(scope="module")
def repaired_spot(splat_begun) -> tuple[Session, str]:
    """Return the session of the splat with what is marked repaired, and what is said."""
    return apply_step(splat_begun, marked(splat_begun, "repair"))


def test_what_is_marked_is_removed_filled_and_repaired(without_spot, repaired_spot):
    removed = without_spot
    gone = removed.latest.source.gone_mask
    assert 50 < int(gone.sum()) < 0.2 * len(gone)
    filled, _ = apply_step(removed, marked(removed, "fill"))
    assert len(filled.latest.added) > 50
    repaired, text = repaired_spot
    assert torch.equal(repaired.latest.source.gone_mask, gone)
    assert "are removed" in text
    # To touch the hole is enough.
    dab, _ = apply_step(removed, marked(removed, "fill", mark(slice(22, 24), slice(24, 26))))
    assert torch.equal(dab.latest.scene.means, filled.latest.scene.means)
    assert repaired.cameras == (repaired.steps[0].camera,)
    assert removed.cameras == ()


def test_only_holes_that_are_marked_are_filled(without_spot):
    other = mark(slice(18, 28), slice(2, 12))
    removed, _ = apply_step(without_spot, marked(without_spot, "remove", other))
    filled, _ = apply_step(removed, marked(removed, "fill"))
    camera = filled.latest.targets[-1].target
    added = filled.latest.targets[-1].added
    columns = project(added.means, camera)[0][:, 0]
    assert len(added) > 50
    assert columns.min() > 14
    both, _ = complete_camera(removed, CAMERAS[1])
    assert len(both.latest.added) > 1.2 * len(filled.latest.added)


def test_what_was_added_is_removed_by_marks_too(repaired_spot):
    repaired, _ = repaired_spot
    again, _ = apply_step(repaired, marked(repaired, "remove"))
    assert len(again.latest.added) < 0.2 * len(repaired.latest.added)


def test_marks_that_nothing_can_be_done_with_are_refused(splat_begun):
    for action in ("fill", "remove", "repair"):
        with pytest.raises(InputError, match="Nothing is marked"):
            apply_step(splat_begun, marked(splat_begun, action, None))
        with pytest.raises(InputError, match="marks nothing"):
            nothing = mark(slice(0), slice(0))
            apply_step(splat_begun, marked(splat_begun, action, nothing))


def test_nothing_that_is_given_is_ignored(splat_begun):
    camera = save_camera(splat_begun, CAMERAS[1])
    for step in (
        SessionStep("fill", camera, SPOT, box=CRATE),
        SessionStep("remove", camera, SPOT, box=CRATE),
        SessionStep("complete", camera, SPOT),
        SessionStep("complete", camera, box_rotation=(float("nan"), 0.0, 0.0, 0.0)),
        SessionStep("remove", camera, SPOT, box_rotation=(0.0, 1.0, 0.0, 0.0)),
    ):
        with pytest.raises(InputError, match=r"leave it out|takes no mask"):
            apply_step(splat_begun, step)


def test_more_is_removed_from_a_completed_splat(splat_begun):
    first = splat_begun.latest
    labels = first.context.generated.clone()
    labels[:9] = 1
    context = replace(first.context, generated=labels)
    completed = replace(first, source=ContextScene.whole(context), rendered_context=context)
    session = replace(splat_begun, completions=(completed,))
    changed, _ = apply_step(session, marked(session, "remove"))
    assert changed.latest.source.gone_mask.any()


# ------------------------------------------------------------------------- what a page is sent


def shown_in(scene: PageScene, completion, given: Gaussians) -> int:
    """Count the Gaussians that a page shows."""
    counts = {"observed": len(given)}
    total = 0
    for chunk in scene.describe(completion)["chunks"]:
        if chunk["hidden"] is None:
            continue
        packed = scene.get_chunk(chunk["name"])
        if packed is not None:
            counts[chunk["name"]] = read_count(packed)
        hidden = np.frombuffer(base64.b64decode(chunk["hidden"]), "<u4")
        assert len(np.unique(hidden)) == len(hidden)
        total += counts[chunk["name"]] - len(hidden)
    return total


def read_count(packed: bytes) -> int:
    return int.from_bytes(gzip.decompress(packed)[8:12], "little")


def test_only_what_changed_is_sent(splat_begun, repaired_spot, tmp_path):
    given = splat_begun.latest.context
    scene = PageScene(given)
    assert shown_in(scene, splat_begun.latest, given) == len(splat_begun.latest.scene)
    begun = set(scene._chunks)
    repaired, _ = repaired_spot
    assert shown_in(scene, repaired.latest, given) == len(repaired.latest.scene)
    (name,) = set(scene._chunks) - begun
    path = tmp_path / "chunk.spz"
    path.write_bytes(scene.get_chunk(name))
    sent = load_splat(path)
    new = len(repaired.latest.added) - len(splat_begun.latest.added)
    assert len(sent) == new < 0.1 * len(given)
    # What was removed of the additions is hidden, and nothing is sent again.
    again, _ = apply_step(repaired, marked(repaired, "remove"))
    for session in (again, repaired, splat_begun, repaired):
        assert shown_in(scene, session.latest, given) == len(session.latest.scene)
    assert set(scene._chunks) == begun | {name}
    assert scene.get_chunk("added-99") is None
    expected = scene.frame.normalize(repaired.latest.added[-new:]).means
    assert (sent.means - expected).abs().max() < 1e-3


def test_equal_gaussians_are_all_shown(splat_begun, repaired_spot):
    """Two Gaussians of opacity 0.5 in one place cover more than one does."""
    given = splat_begun.latest.context
    repaired, _ = repaired_spot
    parts = repaired.latest.added_parts
    twice = replace(repaired.latest, added_parts=(*parts, parts[-1]))
    scene = PageScene(given)
    for completion in (repaired.latest, twice, repaired.latest, twice):
        assert shown_in(scene, completion, given) == len(completion.scene)
    # The second ones are sent, and the first are not sent again.
    assert len(scene._chunks) == 2


# ------------------------------------------------------------------------------ the connection


@pytest.fixture
def journal(splat_ready, tmp_path) -> Journal:
    return Journal(tmp_path / "kept", splat_ready.start)


@pytest.fixture
def page(splat_ready, splat_begun, journal, monkeypatch) -> LivePage:
    built = serving.build_page(splat_ready, splat_begun, Libraries({}, {}), QUIET, journal)
    monkeypatch.setattr(built, "_save", lambda _: "Saved.")
    return built


def test_a_page_is_named_by_the_splat_or_the_folder(splat_ready, splat, room, monkeypatch):
    ready = splat_ready.scene
    assert serving.name_session(ready) == splat.name
    monkeypatch.chdir(room)
    folder = decide_live(
        options_for(Path("."), Path("../out"))
    ).session.completion.source.scene.folder
    source = replace(ready.source, scene=replace(ready.source.scene, folder=folder))
    work = replace(ready.work, splat=None)
    assert serving.name_session(replace(ready, source=source, work=work)) == room.name


@pytest.fixture(autouse=True)
def quick_end(monkeypatch) -> None:
    """Let a server notice at once that it is shut down; Python looks twice a second."""
    serve = partialmethod(BaseServer.serve_forever, poll_interval=0.01)
    monkeypatch.setattr(LiveServer, "serve_forever", serve)


@pytest.fixture
def server(page) -> Iterator[LiveServer]:
    with_page = LiveServer(resolve_host("127.0.0.1"), "127.0.0.1", 0, page)
    yield with_page
    with_page.close()


JSON = {"Content-Type": "application/json"}


def ask(server: LiveServer, method: str, path: str, body: bytes | None = None, **headers: str):
    """Send a request, and return the status and the bytes of the answer."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, f"{path}?token={server.token}", body, {**JSON, **named})
    response = connection.getresponse()
    content = response.read()
    connection.close()
    return response.status, content


def request_for(action: str, camera: Camera | dict = CAMERAS[1], **more: object) -> bytes:
    told = camera
    if isinstance(camera, Camera):
        told = {"camera_model": "PINHOLE", "frames": [describe_camera(camera)]}
    return json.dumps({"action": action, "client": "me", "camera": told, **more}).encode()


def do(page: LivePage, body: bytes) -> dict:
    """Run a request as the process does, and return the last message."""
    page.submit(body)
    page.handle(page._requests.get())
    return page.channel.latest


def test_the_page_is_that_of_the_viewer_with_a_connection(server, page):
    status, content = ask(server, "GET", "/")
    assert status == 200
    assert b"connect-src 'self' data: blob:" in content
    assert b'"live": true' in content
    assert b'"layers": {"before": "observed", "observed": "observed"}' in content
    assert ask(server, "GET", "/elsewhere")[0] == 404
    assert ask(server, "GET", "/chunks/added-9")[0] == 404


def test_a_step_is_asked_for_shown_undone_and_done_again(server, page):
    mask = base64.b64encode(SPOT).decode()
    said = do(page, request_for("repair", mask=mask))
    assert "are removed" in said["text"]
    assert (said["busy"], said["revision"], said["steps"]) == (False, 2, 1)
    assert said["saved"] is False
    told = json.loads(ask(server, "GET", "/difference")[1])
    assert told["revision"] == 2
    name = told["chunks"][-1]["name"]
    status, chunk = ask(server, "GET", f"/chunks/{name}")
    assert (status, read_count(chunk)) == (200, len(page.session.latest.added))
    said = do(page, request_for("undo"))
    assert (said["steps"], said["undone"], said["revision"]) == (0, 1, 3)
    assert json.loads(page.difference)["chunks"][-1]["hidden"] is None
    said = do(page, request_for("redo"))
    assert (said["steps"], said["undone"]) == (1, 0)
    said = do(page, request_for("save"))
    assert (said["text"], said["saved"]) == ("Saved.", True)
    # The page's box is where the page has it.
    said = do(page, request_for("remove", box=CRATE, box_rotation=(1.0, 0.0, 0.0, 0.0)))
    assert "--box -0.6 0.2 2.1 0.4 1.47 3.1" in said["text"]


def test_what_a_session_begins_with_is_shown_at_once(room, tmp_path):
    """Before any step photographs add to a splat, which the page holds as it was given."""
    save_ply(tmp_path / "splat.ply", gaussians_of(view_of(Room(), CAMERAS[0])))
    ready = prepare(options_for(room, tmp_path / "out", scene=tmp_path / "splat.ply"))
    begun = serving.begin_session(ready)
    assert len(begun.latest.added) > 50
    journal = Journal(tmp_path / "out", ready.start)
    page = serving.build_page(ready, begun, Libraries({}, {}), QUIET, journal)
    told = json.loads(page.difference)
    assert "added-1" in [chunk["name"] for chunk in told["chunks"]]
    held = re.search(r"let shownRevision = (\d+);", read_asset("connection.js"))
    assert page.channel.latest["revision"] == told["revision"] > int(held[1])


def test_messages_arrive_as_they_are_sent(server, page):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    connection.request("GET", f"/events?token={server.token}")
    response = connection.getresponse()
    assert response.getheader("X-Frame-Options") == "DENY"
    assert response.getheader("Content-Type") == "text/event-stream"

    def hear() -> dict:
        line = response.readline()
        assert response.readline() == b"\n"
        return json.loads(line.removeprefix(b"data: "))

    assert "Complete here" in hear()["text"]
    page.tell("<b>Fish</b> & chips")
    assert hear()["text"] == "<b>Fish</b> & chips"
    connection.close()


def test_a_hole_is_told_to_the_page_that_asks(page):
    page._find_hole = lambda _: HOLES[0]
    said = do(page, request_for("find"))
    assert said["client"] == "me"
    assert np.allclose(said["camera"]["transform_matrix"][0][3], HOLES[0].c2w[0, 3])
    page._find_hole = lambda _: None
    said = do(page, request_for("find"))
    assert said["camera"] is None
    assert "No large hole" in said["text"]


def test_a_step_that_is_not_kept_is_done_and_says_so(page, monkeypatch):
    def fail(_: Session) -> None:
        raise InputError("The disk is full.")

    monkeypatch.setattr(page._journal, "write", fail)
    said = do(page, request_for("remove", box=CRATE))
    assert said["steps"] == 1
    assert "are removed" in said["text"]
    assert said["text"].endswith("This step is not kept on the disk: The disk is full.")


def test_the_last_line_tells_steps_that_could_not_be_written(page):
    folder = page._journal.folder
    folder.touch()  # a file in the place of the folder
    said = do(page, request_for("remove", box=CRATE))
    assert "This step is not kept on the disk" in said["text"]
    lost = f"Not saved: {folder} has neither the steps nor a result."
    assert serving.describe_end(page.session, page._journal) == [lost]

    folder.unlink()
    do(page, request_for("undo"))
    state, command = serving.describe_end(page.session, page._journal)
    assert state == f"Not saved: {folder} has the steps, and no result."

    folder.rename(folder.with_name("aside"))
    folder.touch()
    do(page, request_for("redo"))
    lacking = f"Not saved: {folder} lacks what was done last, and has "
    assert serving.describe_end(page.session, page._journal) == [f"{lacking}no result.", command]
    do(page, request_for("save"))
    assert serving.describe_end(page.session, page._journal) == [f"Saved in {folder}.", command]
    do(page, request_for("undo"))
    state, _ = serving.describe_end(page.session, page._journal)
    assert state == f"{lacking}the result of an earlier Save."


def test_photographs_are_shown_as_taken_also_where_a_removal_goes_on(
    splat_ready, splat_begun, without_crate, journal, monkeypatch
):
    """A removal paints them over, for the session itself."""
    removed, _ = without_crate
    shown = []
    monkeypatch.setattr(
        serving, "make_page", lambda content, *_, **__: (shown.append(content) or b"", ())
    )
    for session in (splat_begun, removed):
        serving.build_page(splat_ready, session, Libraries({}, {}), QUIET, journal)
    first, later = shown
    pairs = zip(splat_begun.latest.views, removed.latest.views, strict=True)
    assert any(not torch.equal(one.image, other.image) for one, other in pairs)
    assert [shot.thumbnail for shot in later.cameras] == [shot.thumbnail for shot in first.cameras]
    assert later.before is first.before


@pytest.mark.parametrize(("message", "state"), [("OUT is complete", "Saved"), ("", "Not saved")])
def test_what_was_saved_before_an_interrupt_counts_as_saved(page, monkeypatch, message, state):
    """Ctrl-C waits while results are renamed, and then says that they are complete."""

    def stop(_: Session) -> str:
        raise KeyboardInterrupt(*filter(None, [message]))

    do(page, request_for("remove", box=CRATE))
    monkeypatch.setattr(page, "_save", stop)
    with pytest.raises(KeyboardInterrupt):
        do(page, request_for("save"))
    assert serving.describe_end(page.session, page._journal)[0].startswith(state)


def test_where_all_steps_are_undone_nothing_is_said_to_be_saved(page):
    do(page, request_for("remove", box=CRATE))
    assert do(page, request_for("undo"))["saved"] is True  # nothing is left that could be
    state, command = serving.describe_end(page.session, page._journal)
    assert state == f"Not saved: {page._journal.folder} has the steps, and no result."
    assert command.startswith("To go on: ")


def test_ctrl_c_ends_the_page_also_while_the_browser_is_opened(page, room, monkeypatch, capsys):
    addresses = []

    def stop(address: str) -> None:
        addresses.append(urlsplit(address))
        raise KeyboardInterrupt

    monkeypatch.setattr("webbrowser.open", stop)
    serving.serve(decide_live(options_for(room, Path("out"))), page)
    (address,) = addresses
    assert f"{address.netloc}/?token=" in capsys.readouterr().out
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((address.hostname, address.port))


def test_an_error_is_a_sentence_and_ends_nothing(page, monkeypatch, capsys):
    before = page.session
    said = do(page, request_for("undo"))
    assert said["text"].startswith("There is nothing to undo")
    monkeypatch.setitem(page._actions, "save", lambda _: 1 / 0)
    assert "the scene is unchanged" in do(page, request_for("save"))["text"]
    assert "ZeroDivisionError" in capsys.readouterr().err
    assert page.session is before
    assert do(page, request_for("find"))["busy"] is False


def test_one_thing_is_done_at_a_time(server, page):
    assert ask(server, "POST", "/do", request_for("undo"))[0] == 202
    status, content = ask(server, "POST", "/do", request_for("undo"))
    assert (status, json.loads(content)["text"]) == (409, BUSY)
    page.handle(page._requests.get())
    assert ask(server, "POST", "/do", request_for("undo"))[0] == 202


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (b"\xff", "no JSON"),
        (b"[" * 100_000, "no JSON"),
        (b"[]", "is damaged"),
        (b"{}", "action"),
        (b'{"action": "format"}', "no action 'format'"),
        (b'{"action": "remove", "box": [1, 2]}', "box"),
    ],
)
def test_a_request_that_is_none_is_refused(server, body, said):
    status, content = ask(server, "POST", "/do", body)
    assert status == 400
    assert said in json.loads(content)["text"]


def test_what_a_request_lacks_is_said(page):
    assert "no camera" in do(page, b'{"action": "complete"}')["text"]
    for mask in ("*", "a", "é"):
        assert "no base64" in do(page, request_for("fill", mask=mask))["text"]
    empty = parse_request(b'{"action": "complete", "camera": {"frames": []}}', ("complete",))
    with pytest.raises(InputError, match="0 cameras"):
        empty.read_camera()
    box = {"box": CRATE, "box_rotation": [float("nan"), 0, 0, 1]}
    assert "not all zero" in do(page, request_for("remove", **box))["text"]
    assert "six numbers" in do(page, request_for("remove", box=[-1e999, 0, 0, 1, 1, 1]))["text"]


def test_a_request_asks_for_no_file_and_is_told_of_none(page, tmp_path, monkeypatch, capsys):
    """Neither existence nor sizes of files, nor where the program keeps its own."""
    picture = tmp_path / "picture.png"
    picture.write_bytes(SPOT)
    described = describe_camera(CAMERAS[1])
    sized = {key: value for key, value in described.items() if key not in ("w", "h")}
    said = set()
    for path in (picture, tmp_path / "missing.png", "/proc/self/environ"):
        told = {"frames": [{**sized, "file_path": str(path)}]}
        said.add(do(page, request_for("complete", told))["text"])
    assert said == {"The `file_path` of the camera is unknown; leave it out."}
    told = {"frames": [sized]}
    requests = [request_for("complete", told)]
    wide = Image.new("L", (4 * SIZE, SIZE), 255)
    file = io.BytesIO()
    wide.save(file, format="PNG")
    for mask in (b"no image", SPOT[:60], file.getvalue(), mark(slice(0), slice(0))):
        requests.append(request_for("repair", mask=base64.b64encode(mask).decode()))
    monkeypatch.setattr(page, "_find_hole", lambda _: picture.read_text())
    for request in (*requests, request_for("find")):
        text = do(page, request)["text"]
        assert not re.search(r"/\w|\.png|\.json", text), text
    assert "UnicodeDecodeError" in capsys.readouterr().err


def test_a_request_has_a_size_and_a_kind(server):
    body = request_for("undo")
    assert ask(server, "POST", "/do", body, Content_Type="text/plain")[0] == 415
    assert ask(server, "POST", "/do", body, Content_Length="9" * 12)[0] == 413
    assert ask(server, "POST", "/do", body, Content_Length="9" * 5000)[0] == 413
    assert ask(server, "POST", "/elsewhere", body)[0] == 404


PATHS = ("/", "/events", "/difference", "/chunks/added-1", "/elsewhere")


@pytest.mark.parametrize("query", ["", "?token=", "?token=no", "?token=%C3%A9%FF", "?open=no"])
def test_nobody_gets_anything_without_the_token(server, page, query):
    """Whatever name of a host leads here, and on this machine, too, which may have other users."""
    before = page.difference
    for method, path in [*(("GET", path) for path in PATHS), ("POST", "/do")]:
        connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
        connection.request(method, path + query, request_for("undo"), JSON)
        response = connection.getresponse()
        assert response.status == 403
        text = response.read().decode()
        assert text.startswith("Open the whole address that the program printed")
        assert "Traceback" not in text
        headers = dict(response.getheaders())
        assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"
        assert headers["X-Frame-Options"] == "DENY"
        connection.close()
    assert page._requests.empty()
    assert page.difference == before


def test_a_website_whose_name_leads_here_knows_no_token(page):
    """Of an address that others reach, any name may be asked for, as after DNS rebinding."""
    server = LiveServer(resolve_host("0.0.0.0"), "0.0.0.0", 0, page)
    try:
        name = f"evil.example:{server.server_port}"
        assert server.url.endswith(f"?token={server.token}")
        assert len(server.token) >= 20
        assert answer_of(server, name, f"http://{name}") == 202
        page.handle(page._requests.get())
        assert answer_of(server, name, f"http://{name}", token="guessed") == 403
    finally:
        server.close()


def test_what_opens_the_browser_opens_the_page_once(server):
    """Command lines are read by all users of a machine."""
    assert server.token not in server.opening_url
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    path = server.opening_url.partition(str(server.server_port))[2]
    for status, location in ((303, f"/?token={server.token}"), (403, None)):
        connection.request("GET", path)
        response = connection.getresponse()
        response.read()
        assert (response.status, response.getheader("Location")) == (status, location)
        connection.close()


@pytest.mark.parametrize("length", ["²", "٣", "-1", "1e3", "+5", "1_0", ""])
def test_a_length_that_is_no_number_is_refused(server, capfd, length):
    head = (
        f"POST /do?token={server.token} HTTP/1.1\r\nHost: localhost\r\n"
        f"Content-Type: application/json\r\nContent-Length: {length}\r\n\r\n"
    )
    for encoding in ("latin-1", "utf-8"):
        with socket.create_connection(("127.0.0.1", server.server_port), timeout=10) as browser:
            browser.sendall(head.encode(encoding, errors="replace"))
            assert browser.recv(100).startswith(b"HTTP/1.0 411" if not length else b"HTTP/1.0 400")
    assert capfd.readouterr().err == ""


def test_half_of_a_request_is_dropped_in_time(server, monkeypatch, capfd):
    """Slowly sent bytes do not make it whole."""
    monkeypatch.setattr(served, "REQUEST_SECONDS", 0.3)
    head = f"POST /do?token={server.token} HTTP/1.1\r\nHost: localhost\r\n"
    whole = head + "Content-Type: application/json\r\nContent-Length: 100\r\n\r\n"
    for sent in ("", "GET / HT", head, whole, whole + "{"):
        with socket.create_connection(("127.0.0.1", server.server_port), timeout=10) as browser:
            browser.sendall(sent.encode())
            assert not browser.recv(100).startswith(b"HTTP/1.0 2")
    while server.awaited:  # their threads end
        time.sleep(0.01)
    # What waits for messages is a whole request.
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    connection.request("GET", f"/events?token={server.token}")
    response = connection.getresponse()
    response.readline()
    response.readline()
    time.sleep(1.0)
    server.page.tell("still there")
    assert b"still there" in response.readline()
    connection.close()
    assert capfd.readouterr().err == ""


def test_only_so_many_are_served_at_once(page, monkeypatch):
    monkeypatch.setattr(served, "MAX_CLIENTS", 3)
    server = LiveServer(resolve_host("127.0.0.1"), "127.0.0.1", 0, page)
    place = ("127.0.0.1", server.server_port)
    try:
        held = [socket.create_connection(place, timeout=10) for _ in range(3)]
        while len(server.awaited) < 3:
            time.sleep(0.01)
        with socket.create_connection(place, timeout=10) as further, suppress(ConnectionError):
            assert further.recv(1) == b""
        for browser in held:
            browser.close()
        while server.awaited:
            time.sleep(0.01)
        assert ask(server, "GET", "/")[0] == 200
    finally:
        server.close()


def has_ipv6() -> bool:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return True


@pytest.mark.parametrize(
    ("host", "is_local"),
    [("127.0.0.1", True), ("::1", True), ("::ffff:127.0.0.1", True), ("0.0.0.0", False)],
)
def test_only_an_address_of_this_machine_alone_is_local(host, is_local):
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    address = Address(family, host)
    assert address.is_local == is_local
    assert address.make_url(80) == (f"http://[{host}]:80/" if ":" in host else f"http://{host}:80/")
    own = address.make_url(80).removeprefix("http://").removesuffix("/")
    assert address.knows_host(own)
    assert address.knows_host("evil.example:80") != is_local
    assert address.knows_host("[evil]:80") != is_local


def test_an_address_is_known_as_browsers_spell_it():
    address = Address(socket.AF_INET6, "::ffff:127.0.0.1")
    for host in ("[::ffff:7f00:1]:80", "[::FFFF:7F00:1]", "[::ffff:127.0.0.1]:80"):
        assert address.knows_host(host)
    for host in ("[::ffff:7f00:2]:80", "[::ffff:7f00:1]:80]", "::ffff:7f00:1", "[]:80"):
        assert not address.knows_host(host)


def test_a_port_that_is_taken_is_refused(server, page):
    with pytest.raises(InputError, match=f"port {server.server_port}"):
        LiveServer(resolve_host("127.0.0.1"), "127.0.0.1", server.server_port, page)


def test_a_malformed_request_leaves_no_traceback(server, capfd):
    for sent in (b"GET / HTTP/1.1\r\nUpgrade: websocket\r\n\r\n", b"\x00\xff" * 50, b"\r\n"):
        with socket.create_connection(("127.0.0.1", server.server_port)) as browser:
            browser.sendall(sent)
            browser.settimeout(0.3)
            with suppress(TimeoutError, ConnectionError):
                browser.recv(100)
    assert "Traceback" not in capfd.readouterr().err


def test_the_options_of_complete_are_those_of_live(room, tmp_path):
    words = ["live", str(room), "--out", str(tmp_path / "out"), "--config", "paper"]
    options = parse_command([*words, "--config.paper-registration.iterations", "7", "--seed", "3"])
    asked = decide_live(options).session.completion
    paper = CompleterConfig.paper()
    registration = replace(paper.paper_registration, iterations=7)
    assert asked.work.config == replace(paper, paper_registration=registration)
    assert (asked.work.models.seed, asked.targets.named) == (3, ())
    assert asked.source.scene.resolution == (256, 256)


@pytest.mark.linux
@pytest.mark.parametrize(
    "host", ["127.0.0.1", "localhost", "127.1", "127.0.0.2", "LOCALHOST", "0x7f.1", "::1"]
)
def test_pages_from_elsewhere_are_refused(page, host):
    """The address that is bound decides, whatever its spelling."""
    if host == "::1" and not has_ipv6():
        pytest.skip("this machine has no IPv6")
    server = LiveServer(resolve_host(host), host, 0, page)
    try:
        for name in ("localhost", "127.0.0.1", "LOCALHOST", "127.0.0.2", "[::1]"):
            own = f"{name}:{server.server_port}"
            assert answer_of(server, own, None) == 202
            page.handle(page._requests.get())
            assert answer_of(server, own, f"http://{own}") == 202
            page.handle(page._requests.get())
            others = ("http://elsewhere.example", f"http://{own}.elsewhere.example")
            for origin in (*others, "null", "http://["):
                assert answer_of(server, own, origin) == 403
        # A site whose name points here is its own origin.
        assert answer_of(server, "elsewhere.example", "http://elsewhere.example") == 421
    finally:
        server.close()


def answer_of(server: LiveServer, name: str, origin: str | None, token: str | None = None) -> int:
    """Ask as a page of `origin` does that calls the server by a name, and return the status.

    The page knows the token unless another one is given.
    """
    connection = http.client.HTTPConnection(server.address.host, server.server_port, timeout=10)
    headers = {**JSON, "Host": name, **({} if origin is None else {"Origin": origin})}
    path = f"/do?token={token or server.token}"
    connection.request("POST", path, request_for("undo"), headers)
    status = connection.getresponse().status
    connection.close()
    return status


# ----------------------------------------------------------------------------- saved and replayed


def test_a_stroke_is_replayed_to_the_same_bytes(
    splat_ready, without_spot, splat, room, tmp_path, monkeypatch
):
    serving.save_session(splat_ready, without_spot)
    saved, other = splat_ready.request.out, tmp_path / "other"
    strokes = json.loads((saved / "strokes.json").read_text())
    assert [frame["action"] for frame in strokes["frames"]] == ["remove"]
    words = ("repair", room, "--scene", splat, "--strokes", saved, "--out", other, "--quiet")
    assert run(monkeypatch, *words) == 0
    for name in ("completed.ply", "removed.ply", "images/stroke1.png"):
        assert (saved / name).read_bytes() == (other / name).read_bytes(), name


# `test_live_steps.py` does such a step.
@pytest.mark.slow
def test_a_step_with_two_targets_is_saved_and_replayed(
    splat_ready, without_crate, splat, room, tmp_path, monkeypatch
):
    removed, _ = without_crate
    session, _ = complete_camera(removed, HOLES[1])
    serving.save_session(splat_ready, session)
    saved, other = splat_ready.request.out, tmp_path / "other"
    frames = json.loads((saved / "targets.json").read_text())["frames"]
    assert len(frames) == len(json.loads((saved / "summary.json").read_text())["targets"]) == 2
    words = ("repair", room, "--scene", splat, "--strokes", saved, "--out", other, "--quiet")
    assert run(monkeypatch, *words) == 0
    for name in ("completed.ply", "targets.json"):
        assert (saved / name).read_bytes() == (other / name).read_bytes(), name


# `test_a_stroke_is_replayed_to_the_same_bytes` does so with one step.
@pytest.mark.slow
def test_a_saved_session_is_replayed_to_the_same_bytes(
    splat_ready, repaired_spot, splat, room, tmp_path, monkeypatch
):
    session, _ = repaired_spot
    session, _ = complete_camera(session, HOLES[1])
    removed = mark(slice(30, 40), slice(8, 20))
    session, _ = apply_step(session, marked(session, "remove", removed))
    session, _ = apply_step(session, marked(session, "fill", removed))
    session, _ = remove_box(session, CRATE)
    session = redo_step(undo_step(session))
    serving.save_session(splat_ready, session)
    saved, other = splat_ready.request.out, tmp_path / "other"
    strokes = json.loads((saved / "strokes.json").read_text())
    assert strokes["resolution"] == [SIZE, SIZE]
    assert strokes["context"] == [0, 1]
    assert (strokes["program"], strokes["format"]) == ("gscompleter", 1)
    actions = ["repair", "complete", "remove", "fill", "remove"]
    assert [frame["action"] for frame in strokes["frames"]] == actions
    assert strokes["frames"][4]["box"] == list(CRATE)
    assert load_cameras(saved / "strokes.json")[1].width == SIZE

    words = ("repair", room, "--scene", splat, "--strokes", saved, "--out", other, "--quiet")
    assert run(monkeypatch, *words) == 0
    # What a session began with is not the same: `repair` has settings of its own.
    again = json.loads((other / "strokes.json").read_text())
    for name in strokes.keys() - {"session"}:
        assert again[name] == strokes[name], name
    names = ("completed.ply", "removed.ply", "generated.ply", "targets.json")
    for name in (*names, "images/stroke1.png", "images/stroke4.png"):
        assert (saved / name).read_bytes() == (other / name).read_bytes(), name
    restored = tmp_path / "restored.ply"
    assert run(monkeypatch, "strip", other / "completed.ply", "--out", restored, "--quiet") == 0
    assert restored.read_bytes() == splat.read_bytes()


# A splat with photographs, above, and photographs alone, below, are replayed in seconds.
@pytest.mark.slow
def test_a_session_of_a_splat_alone_is_replayed_to_the_same_bytes(tmp_path, monkeypatch):
    splat = tmp_path / "splat.ply"
    save_ply(splat, gaussians_of(view_of(Room(), camera_at(size=SIZE))))
    words = ["live", str(splat), "--out", str(tmp_path / "out"), "--resolution", "64", "64"]
    ready = prepare(parse_command(words))
    begun = serving.begin_session(ready)
    camera = replace(camera_at(0.05, size=64), near=None, far=None)
    marked = make_mark(64, slice(24, 36), slice(28, 40))
    step = SessionStep("repair", save_camera(begun, camera), marked)
    session, _ = apply_step(begun, step)
    serving.save_session(ready, session)
    other = tmp_path / "other"
    strokes = ("--strokes", tmp_path / "out" / "strokes.json")
    assert run(monkeypatch, "repair", splat, *strokes, "--out", other, "--quiet") == 0
    for name in ("completed.ply", "removed.ply"):
        assert (tmp_path / "out" / name).read_bytes() == (other / name).read_bytes(), name


FRAME = describe_camera(CAMERAS[0])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "strokes.json"),
        ({"version": "0", "frames": []}, "no steps"),
        ({"version": "0", "frames": [{**FRAME, "action": "paint"}]}, "action"),
        ({"version": "0", "frames": [{**FRAME, "action": "fill", "w": 0}]}, "no such camera"),
        (
            {"version": "0", "frames": [{**FRAME, "action": "fill", "mask_path": "../a.png"}]},
            "beside it",
        ),
        ({"version": "0", "frames": [{**FRAME, "action": "fill", "mask_path": "a.png"}]}, "a.png"),
        ({"version": "0", "frames": [{**FRAME, "action": "remove", "box": [0] * 6}]}, "six"),
    ],
)
def test_strokes_that_are_none_are_refused(splat, tmp_path, monkeypatch, capsys, content, said):
    path = tmp_path / "strokes.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    out = tmp_path / "out"
    assert run(monkeypatch, "repair", splat, "--strokes", path, "--out", out, "--quiet") == 2
    assert said in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "Nothing is named that is wrong"),
        (("--target", "c.json"), "A camera alone"),
        (("--mask", "m.png"), "painted at a camera"),
        (("--strokes", "s.json", "--mask", "m.png"), "of their own"),
    ],
)
def test_what_is_wrong_is_named_once(splat, tmp_path, monkeypatch, capsys, words, said):
    assert run(monkeypatch, "repair", splat, *words, "--out", tmp_path / "out") == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_a_scene_of_photographs_is_repaired_and_replayed_too(
    ready, begun, room, tmp_path, monkeypatch
):
    session, _ = apply_step(begun, marked(begun, "repair"))
    out, other = tmp_path / "out", tmp_path / "other"
    completion = ready.request.completion
    completion = replace(completion, results=replace(completion.results, out=out))
    elsewhere = replace(ready, request=replace(ready.request, completion=completion))
    serving.save_session(elsewhere, session)
    words = ("repair", room, "--strokes", out / "strokes.json", "--out", other, "--quiet")
    assert run(monkeypatch, *words) == 0
    for name in ("completed.ply", "context.ply"):
        assert (out / name).read_bytes() == (other / name).read_bytes(), name
    # There is no file of a splat to give back: the context is the scene as it was.
    assert len(load_ply(out / "context.ply")) == len(begun.latest.context)
    kept = load_ply(out / "completed.ply")
    assert int((kept.generated == 0).sum()) < len(begun.latest.context)
