"""`gscompleter live` without a browser: steps, undo and saving."""

from __future__ import annotations

import json
import math
import socket
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from io import StringIO
from pathlib import Path
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
import torch
from rich.console import Console
from scipy.spatial.transform import Rotation

pytest.importorskip("viser", reason="needs gscompleter[live]")

import viser

from command import run
from gscompleter import load_ply, save_ply
from gscompleter.apps.commands.live import LiveOptions
from gscompleter.apps.live import serving
from gscompleter.apps.live.box import remove_in_box
from gscompleter.apps.live.page import (
    Address,
    Page,
    camera_from_page,
    camera_to_page,
    compute_page_unit,
    describe_outcome,
    make_page_splat,
    resolve_host,
    run_request,
    start_server,
)
from gscompleter.apps.live.session import Session, complete_camera, undo_step
from gscompleter.cli import parse_command
from gscompleter.config import CompleterConfig
from gscompleter.numerics.geometry import measure_rotation
from gscompleter.splats.alignment.similarity import make_similarity, transform_camera
from gscompleter.splats.transform import transform_gaussians
from gscompleter.system.errors import InputError
from gscompleter.system.progress import notify_of_stages
from gscompleter.system.timing import STAGES
from gscompleter.types import Camera, merge
from scenes import Room, camera_at, gaussians_of, photographed, random_gaussians, view_of

SIZE = 48
CAMERAS = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in ((-0.3, 0), (0.1, 0), (0.4, 4))]
HOLES = [camera_at(0.7, 0.1, 0.05, yaw=14, size=SIZE), camera_at(-0.7, yaw=-16, size=SIZE)]
"""Cameras at holes of the room, to the right and to the left of the photographs."""
ELSEWHERE = make_similarity(
    0.3, Rotation.from_rotvec([0.9, -1.7, 0.4]).as_matrix(), np.array([5.0, 3.0, -2.0])
)
QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    return photographed(tmp_path_factory.mktemp("live") / "room", CAMERAS)


def options_for(room: Path, out: Path, **others) -> LiveOptions:
    size = (SIZE, SIZE)
    given = {"context": (0, 1), "near": 0.5, "far": 20.0, "resolution": size, "quiet": True}
    return LiveOptions(folder=room, out=out, **{**given, **others})


@pytest.fixture(scope="module")
def ready(room, tmp_path_factory) -> serving.Prepared:
    return serving.prepare(options_for(room, tmp_path_factory.mktemp("outs") / "out"), QUIET)


@pytest.fixture(scope="module")
def begun(ready) -> Session:
    return serving.begin_session(ready)


def test_undo_goes_back_and_the_same_camera_leads_to_the_same_scene(begun):
    one, result = complete_camera(begun, HOLES[0])
    two, _ = complete_camera(one, HOLES[1])
    assert result.hole_fraction > 0.1
    assert len(begun.latest.added) < len(one.latest.added) < len(two.latest.added)
    assert undo_step(two) == one
    assert undo_step(undo_step(two)) == begun
    again, _ = complete_camera(undo_step(two), HOLES[1])
    for name in ("means", "scales", "quats", "opacities", "sh", "generated"):
        assert torch.equal(getattr(again.latest.scene, name), getattr(two.latest.scene, name)), name


def test_there_is_nothing_to_undo_in_the_beginning(begun):
    with pytest.raises(InputError, match="nothing to undo"):
        undo_step(begun)


def test_a_camera_that_adds_nothing_is_no_step(begun):
    session, result = complete_camera(begun, begun.latest.views[0].camera)
    assert session is begun
    assert describe_outcome(result, 1.0) == "The target is a context view: nothing to complete."


def test_stages_are_heard_as_they_begin(begun):
    heard: list[str] = []
    with notify_of_stages(heard.append):
        complete_camera(begun, HOLES[0])
    assert list(dict.fromkeys(heard)) == list(STAGES)
    complete_camera(begun, HOLES[0])
    assert list(dict.fromkeys(heard)) == list(STAGES)


def the_same_as_complete(monkeypatch, ready: serving.Prepared, tmp_path: Path, *more) -> bool:
    """Compare the saved files with those of `complete` at the saved cameras."""
    out, other = ready.options.out, tmp_path / "by complete"
    context = json.loads((out / "summary.json").read_text())["settings"]["context"]
    arguments = ("--context", *context, "--target", out / "targets.json", "--out", other)
    size = ("--resolution", SIZE, SIZE, "--near", 0.5, "--far", 20, "--quiet")
    assert run(monkeypatch, "complete", ready.options.folder, *arguments, *size, *more) == 0
    names = ("completed.ply", "context.ply", "generated.ply", "images/target1_after.png")
    assert {path.name for path in out.iterdir()} == {path.name for path in other.iterdir()}
    return all((out / name).read_bytes() == (other / name).read_bytes() for name in names)


def test_what_is_saved_is_what_complete_writes(ready, begun, tmp_path, monkeypatch):
    with pytest.raises(InputError, match="nothing to save"):
        serving.save_session(ready, begun)
    session, _ = complete_camera(begun, HOLES[0])
    assert str(ready.options.out) in serving.save_session(ready, session)
    assert the_same_as_complete(monkeypatch, ready, tmp_path)
    session, _ = complete_camera(session, HOLES[1])
    serving.save_session(ready, session)  # replaces its own files
    assert len(json.loads((ready.options.out / "summary.json").read_text())["targets"]) == 2
    assert the_same_as_complete(monkeypatch, ready, tmp_path, "--overwrite")


def test_what_others_wrote_is_not_replaced(room, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="not empty"):
        serving.prepare(options_for(room, tmp_path / "out"), QUIET)


def test_what_is_saved_of_a_splat_in_a_frame_of_its_own_is_too(tmp_path, monkeypatch):
    """Cameras are written in the frame of the photographs without loss."""
    room = photographed(tmp_path / "room", CAMERAS)
    told = {"transform": (np.diag([1 / 0.3] * 3 + [1]) @ ELSEWHERE)[:3].tolist(), "scale": 0.3}
    (room / "dataparser_transforms.json").write_text(json.dumps(told))
    scene = merge([gaussians_of(view_of(Room(), camera)) for camera in CAMERAS[:2]])
    save_ply(
        tmp_path / "splat.ply", transform_gaussians(scene, torch.from_numpy(ELSEWHERE).float())
    )
    config = CompleterConfig.splat()
    options = options_for(room, tmp_path / "out", scene=tmp_path / "splat.ply", config=config)
    ready = serving.prepare(options, QUIET)
    assert ready.task.method == "dataparser"
    session = serving.begin_session(ready)
    target = transform_camera(HOLES[0], ready.task.frame)
    session, result = complete_camera(session, target)
    assert len(result.added) > 0
    assert torch.allclose(session.cameras[0].c2w.float(), HOLES[0].c2w, atol=1e-6)
    serving.save_session(ready, session)
    assert the_same_as_complete(monkeypatch, ready, tmp_path, "--scene", options.scene)


def test_an_antialiased_splat_is_named_so_and_saved_as_one(room, tmp_path):
    scene = merge([gaussians_of(view_of(Room(), camera)) for camera in CAMERAS[:2]])
    save_ply(tmp_path / "splat.ply", replace(scene, is_antialiased=True))
    options = options_for(room, tmp_path / "out", scene=tmp_path / "splat.ply")
    console = Console(file=StringIO())
    ready = serving.prepare(options, console)
    said = console.file.getvalue().replace("\n", " ")
    assert "antialiased Gaussians of SH degree 0" in said
    assert "The page renders antialiased Gaussians as classic ones" in said
    session, _ = complete_camera(serving.begin_session(ready), HOLES[0])
    serving.save_session(ready, session)
    for name in ("context.ply", "completed.ply", "generated.ply"):
        assert load_ply(tmp_path / "out" / name).is_antialiased, name


def test_a_splat_alone_is_completed_and_saved(tmp_path, monkeypatch):
    splat = tmp_path / "splat.ply"
    save_ply(splat, gaussians_of(view_of(Room(), camera_at(size=SIZE))))
    monkeypatch.chdir(tmp_path)
    words = ["live", "splat.ply", "--out", "out", "--resolution", "64", "64", "--no-open"]
    ready = serving.prepare(parse_command(words), QUIET)
    assert ready.opened.renders_from == "pixels"
    assert ready.options.config.trust == "full"
    session, result = complete_camera(serving.begin_session(ready), HOLES[0])
    assert len(result.added) > 0
    serving.save_session(ready, session)
    assert (tmp_path / "out" / "renders.json").is_file()
    kept = load_ply(tmp_path / "out" / "completed.ply")
    assert torch.equal(kept[kept.generated == 0].means, load_ply(splat).means)


def test_a_trained_splat_alone_begins_where_it_looks_well(tmp_path, monkeypatch):
    monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_RANDOM", 80)
    monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_IMPROVED", 8)
    cameras = [camera_at(yaw=angle, size=SIZE, focal=0.45) for angle in (0, 90, 180, 270)]
    room = merge([gaussians_of(view_of(Room(), camera)) for camera in cameras])
    # As large as those of a trainer, whatever the distance.
    save_ply(tmp_path / "room.ply", replace(room, scales=torch.full_like(room.scales, 0.1)))
    options = LiveOptions(scene=tmp_path / "room.ply", out=tmp_path / "out", resolution=(48, 48))
    ready = serving.prepare(replace(options, config=CompleterConfig.bare()), QUIET)
    assert ready.opened.renders_from == "standpoints"
    session = serving.begin_session(ready)
    assert len(session.latest.views) >= 2
    for view in session.latest.views:
        assert view.valid_mask.float().mean() > 0.5


def test_the_frames_that_were_chosen_are_named(room, tmp_path):
    ready = serving.prepare(options_for(room, tmp_path / "out", context=None), QUIET)
    assert ready.options.context == tuple(view.frame for view in ready.task.views)
    assert len(ready.options.context) >= 2


def test_a_hole_is_found_where_something_is_missing(ready, begun):
    camera = serving.find_next_target(ready, begun.latest)
    assert camera is not None
    _, result = complete_camera(begun, camera)
    assert result.hole_fraction > 0.05


@pytest.mark.parametrize("unit", [1.0, 25.0])
def test_a_camera_of_the_page_is_the_one_it_was_made_of(unit):
    camera = replace(camera_at(0.3, -0.2, 0.5, yaw=200, size=SIZE), near=0.5, far=8.0)
    back = camera_from_page(camera_to_page(camera, unit), SIZE, SIZE, unit)
    assert measure_rotation(back, camera) < 1e-3
    assert torch.allclose(back.center, camera.center, atol=1e-6)
    assert torch.allclose(back.K, camera.K, rtol=1e-5)
    assert compute_page_unit(camera) == pytest.approx(1.5)
    assert camera_to_page(camera, unit).fov == pytest.approx(2 * math.atan(0.5 / 0.9))


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
def test_a_splat_of_any_unit_survives_the_pages_precision(unit):
    gaussians = random_gaussians(100)
    scaled = replace(gaussians, means=unit * gaussians.means, scales=unit * gaussians.scales)
    splat = make_page_splat(scaled, 1.0)
    axes = Rotation.from_quat(gaussians.quats.numpy(), scalar_first=True).as_matrix()
    true = axes @ (gaussians.scales.numpy()[:, :, None] ** 2 * axes.transpose(0, 2, 1))
    shown = (
        splat["covariances"].astype(np.float16).astype(np.float64) * (splat["scale"] / unit) ** 2
    )
    assert np.abs(shown - true).max() < 1e-3 * np.abs(true).max()
    assert np.allclose(splat["centers"] * splat["scale"], scaled.means, rtol=1e-5)


def test_an_error_is_a_sentence_and_ends_nothing(capsys):
    def mended() -> str:
        raise InputError("Name another one.")

    def broken() -> str:
        raise ZeroDivisionError("division by zero")

    assert run_request(mended) == "Name another one."
    assert "the scene is unchanged" in run_request(broken)
    assert "ZeroDivisionError" in capsys.readouterr().err


@pytest.fixture
def page(begun) -> Iterator[Page]:
    server = start_server("127.0.0.1", 0)
    page = Page(begun, lambda _: None, lambda _: "Saved.", server)
    yield page
    page.close()


def browser_at(page: Page, camera: Camera) -> MagicMock:
    """Make a browser that shows the scene from a camera."""
    seen = camera_to_page(camera, page._unit)
    view = Mock(wxyz=seen.wxyz, position=seen.position, fov=seen.fov)
    return MagicMock(spec=viser.ClientHandle, camera=view)


def test_what_was_generated_is_shown_and_undone(page, begun):
    client = browser_at(page, HOLES[0])
    assert "Completed" in page.complete(client)
    assert len(page._generated.buffer) == len(page.session.latest.added)
    assert page.undo(client) == "Undone. Completions left: 0."
    assert page.session == begun
    assert page._generated is None


CRATE = (-0.6, 0.2, 2.1, 0.4, 1.47, 3.1)
"""A box around the one in the middle of the room."""
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def test_a_box_is_removed_completed_undone_and_saved(room, tmp_path, monkeypatch):
    scene = merge([gaussians_of(view_of(Room(), camera)) for camera in CAMERAS])
    save_ply(tmp_path / "splat.ply", scene)
    options = options_for(room, tmp_path / "out", scene=tmp_path / "splat.ply")
    ready = serving.prepare(replace(options, config=CompleterConfig.splat()), QUIET)
    begun = serving.begin_session(ready)
    removed, count = remove_in_box(begun, CRATE, UPRIGHT)
    assert count == removed.latest.source.gone_mask.sum() > 100
    rest = removed.latest.added  # of what reached out of the box
    assert len(removed.latest.scene) == len(begun.latest.scene) - count + len(rest)
    filled, result = complete_camera(removed, CAMERAS[2])
    assert len(result.added) > 0
    emptied, again = remove_in_box(filled, (-2.0, -1.0, 2.0, 2.0, 2.0, 6.0), UPRIGHT)
    assert again > len(emptied.latest.added) - len(filled.latest.added)
    assert undo_step(emptied) == filled
    assert undo_step(filled) == removed
    assert undo_step(removed) == begun
    with pytest.raises(InputError, match="contains nothing"):
        remove_in_box(removed, (50.0, 50.0, 50.0, 51.0, 51.0, 51.0), UPRIGHT)
    serving.save_session(ready, filled)
    out, restored = tmp_path / "out", tmp_path / "restored.ply"
    assert json.loads((out / "summary.json").read_text())["gaussians"]["removed"] > 100
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", restored, "--quiet") == 0
    assert restored.read_bytes() == (tmp_path / "splat.ply").read_bytes()
    serving.save_session(ready, removed)
    assert json.loads((out / "summary.json").read_text())["gaussians"]["added"] == len(rest)


def test_the_box_of_the_page_is_the_one_that_is_removed(page):
    client = browser_at(page, HOLES[0])
    with pytest.raises(InputError, match="Tick"):
        page.remove(client)
    low, high = np.array(CRATE[:3]) * page._unit, np.array(CRATE[3:]) * page._unit
    page._box.shown.value = True
    page._box.controls.position, page._box.size.value = (low + high) / 2, tuple(high - low)
    corners, rotation = page._box.read(page._unit)
    assert np.allclose(corners, CRATE)
    assert rotation == UPRIGHT
    assert "--box -0.6 0.2 2.1 0.4 1.47 3.1 --box-rotation 1 0 0 0" in page.remove(client)
    assert page.session.latest.source.gone_mask.any()
    page.undo(client)


def test_photographs_are_visited_one_after_the_other(page):
    client = browser_at(page, HOLES[0])
    for view in (*page.session.latest.views, page.session.latest.views[0]):
        page.visit_photograph(client)
        expected = camera_to_page(view.camera, page._unit)
        assert np.array_equal(client.camera.position, expected.position)
        assert client.camera.fov == expected.fov


def test_what_is_said_stays_text(page):
    page.show_message("<b>A</b> & B\nmore")
    assert "&lt;b&gt;A&lt;/b&gt; &amp; B<br>more" in page._status.content


def test_one_thing_is_done_at_a_time(page):
    client = browser_at(page, HOLES[0])
    event = Mock(spec=viser.GuiEvent, client=client)
    page._submit(page.undo, event)
    assert client.add_notification.call_count == 0
    page._submit(page.undo, event)
    assert client.add_notification.call_count == 1
    assert page._requests.qsize() == 1


def test_a_port_that_is_taken_is_refused():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"port {port}"):
            start_server("127.0.0.1", port)


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


def test_a_malformed_message_leaves_no_traceback(capfd):
    server = start_server("127.0.0.1", 0)
    try:
        for sent in (b"GET / HTTP/1.1\r\nUpgrade: websocket\r\n\r\n", b"\x00\xff" * 50, b"\r\n"):
            with socket.create_connection(("127.0.0.1", server.get_port())) as browser:
                browser.sendall(sent)
        for message in (b"\xc1no message of the page", b"", b"\x81\xa4type\xa4none", "text"):
            send_message(server.get_port(), message)
    finally:
        server.stop()
    assert "Traceback" not in capfd.readouterr().err


def send_message(port: int, message: bytes | str) -> None:
    """Connect as a page does, send a message, and wait until the server has read it."""
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    page = {"subprotocols": [f"viser-v{viser.__version__}"], "max_size": None}
    with connect(f"ws://127.0.0.1:{port}", **page) as browser:
        browser.send(message)
        with suppress(ConnectionClosed, TimeoutError):
            while True:
                browser.recv(timeout=0.5)


def test_without_viser_a_sentence_says_what_to_install(room, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(serving, "find_spec", lambda _: None)
    assert run(monkeypatch, "live", room, "--out", tmp_path / "out") == 2
    assert "pip install 'gscompleter[live]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_options_of_complete_are_those_of_live(room, tmp_path):
    words = ["live", str(room), "--out", str(tmp_path / "out"), "--config", "paper"]
    options = parse_command([*words, "--config.paper-registration.iterations", "7", "--seed", "3"])
    asked = serving.make_complete_options(options)
    paper = CompleterConfig.paper()
    registration = replace(paper.paper_registration, iterations=7)
    assert asked.config == replace(paper, paper_registration=registration)
    assert (asked.seed, asked.resolution, asked.target) == (3, (256, 256), ())


@pytest.mark.linux
@pytest.mark.parametrize(
    "host", ["127.0.0.1", "localhost", "127.1", "127.0.0.2", "LOCALHOST", "0x7f.1", "::1"]
)
def test_pages_from_elsewhere_are_refused(host):
    """The address that is bound decides, whatever its spelling."""
    if host == "::1" and not has_ipv6():
        pytest.skip("this machine has no IPv6")
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    server = start_server(host, 0)
    try:
        address = resolve_host(host).make_url(server.get_port()).replace("http:", "ws:")
        for origin in ("http://elsewhere.example", "http://127.0.0.1.elsewhere.example", "null"):
            with pytest.raises(InvalidStatus, match="403"):
                connect(address, origin=origin, subprotocols=["viser-v0"], max_size=None)
        for name in ("localhost", "127.0.0.1", "LOCALHOST", "127.0.0.2", "[::1]"):
            own = f"http://{name}:{server.get_port()}"
            connect(address, origin=own, subprotocols=["viser-v0"], max_size=None).close()
    finally:
        server.stop()
