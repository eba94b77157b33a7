"""A session of `live` that ended, or was killed, is opened again and goes on."""

from __future__ import annotations

import http.client
import io
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console

from gscompleter import save_ply
from gscompleter.apps.commands.live import LiveOptions
from gscompleter.apps.live import saving, serving
from gscompleter.apps.live.journal import Journal
from gscompleter.apps.live.opening import Opening, find_opening
from gscompleter.apps.live.page import LivePage
from gscompleter.apps.live.session import Session, Step, apply_step
from gscompleter.apps.viewer.packages import Libraries
from gscompleter.cli import parse_command
from gscompleter.data.scene import describe_camera
from gscompleter.system.files.output_folder import read_listing, reserve_output
from gscompleter.types import Camera, Gaussians, merge
from scenes import Room, camera_at, gaussians_of, photographed, view_of

SIZE = 48
CAMERAS = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in ((-0.3, 0), (0.1, 0), (0.4, 4))]
QUIET = Console(quiet=True)
CRATE = (-0.6, 0.2, 2.1, 0.4, 1.47, 3.1)
LEFT = (-2.0, -1.0, 2.0, -1.2, 2.0, 6.0)
SMALL = ("--resolution", SIZE, SIZE, "--near", 0.5, "--far", 20, "--context", 0, 1)


def mark(rows: slice, columns: slice) -> bytes:
    """Make the PNG of a mask that is white there."""
    pixels = np.zeros((SIZE, SIZE), dtype=np.uint8)
    pixels[rows, columns] = 255
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    return file.getvalue()


SPOT = mark(slice(18, 30), slice(20, 32))
OTHER = mark(slice(2, 9), slice(34, 44))
STEPS = (
    Step("remove", CAMERAS[0], box=CRATE),
    Step("remove", CAMERAS[1], SPOT),
    Step("remove", CAMERAS[1], OTHER),
)
"""Three steps that only remove, which takes no time."""


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    return photographed(tmp_path_factory.mktemp("opening") / "room", CAMERAS)


@pytest.fixture(scope="module")
def splat(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("splat") / "splat.ply"
    save_ply(path, merge([gaussians_of(view_of(Room(), camera)) for camera in CAMERAS]))
    return path


def parse_live(*words: object) -> LiveOptions:
    return parse_command(["live", *map(str, words), "--no-open", "--quiet"])


class Program:
    """A session without its server, as `serve_live` runs it."""

    def __init__(self, *words: object) -> None:
        self.opening: Opening = find_opening(parse_live(*words))
        options = self.opening.options
        with reserve_output(options.out, options.overwrite, "complete", saving.LIVE_RESULTS):
            self.ready = saving.prepare(options, QUIET)
            begun = serving.open_session(self.ready, self.opening, QUIET)
            self.journal: Journal = serving.open_journal(self.ready, self.opening, begun)
        libraries = Libraries({}, {})
        self.page: LivePage = serving.build_page(self.ready, begun, libraries, QUIET, self.journal)

    @property
    def session(self) -> Session:
        return self.page.session

    def do(self, step: Step) -> None:
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


def test_each_step_is_kept_at_once_and_a_session_goes_on(room, splat, tmp_path):
    out = tmp_path / "out"
    begun = Program(room, "--scene", splat, "--out", out, *SMALL)
    assert not out.exists()
    for count, step in enumerate(STEPS, start=1):
        begun.do(step)
        assert len(actions_in(out)) == count
    assert begun.page.channel.latest["saved"] is True  # the last message came before the steps

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
    assert third.ask("redo")["steps"] == 2
    third.ask("redo")
    assert is_same(third.scene, begun.scene)


@contextmanager
def served(*words: object) -> Iterator[tuple[subprocess.Popen, Callable[[str, bytes], dict]]]:
    """Serve a page in a process, and ask it as the page does, until the block kills it."""
    # The page itself is not looked at, so that it needs no libraries.
    program = (
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
