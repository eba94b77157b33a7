"""`gscompleter live` in a real browser: fly, complete, undo, find a hole and save."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from browsing import PATIENCE, SWITCHES, launched
from command import run
from scenes import camera_at, photographed

pytest.importorskip("viser", reason="needs gscompleter[live]")

pytestmark = pytest.mark.browser

SIZE = 48
PLACES = ((-0.3, 0), (0.1, 0), (0.4, 4))
SMALL = ("--resolution", SIZE, SIZE, "--near", 0.5, "--far", 20, "--quiet")


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    cameras = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in PLACES]
    return photographed(tmp_path_factory.mktemp("live") / "room", cameras)


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("saved") / "out"


@pytest.fixture(scope="module")
def served(room, out) -> Iterator[str]:
    """Address of the page; the process ends silently on SIGTERM."""
    words = ["live", room, "--context", 0, 1, "--out", out, "--no-open", *SMALL]
    program = "from gscompleter.cli import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", program, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    yield process.stdout.readline().split()[0]
    process.send_signal(signal.SIGTERM)
    rest, errors = process.communicate(timeout=30)
    assert (process.returncode, rest, errors) == (0, "", "")


@pytest.fixture(scope="module")
def page(served) -> Iterator[Any]:
    with launched(SWITCHES) as browser:
        page = browser.new_page(viewport={"width": 640, "height": 360})
        page.set_default_timeout(PATIENCE)
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.goto(served)
        wait_for(page, "Fly to a hole in the scene")
        yield page
        assert [url for url in asked if not url.startswith((served, "data:", "blob:"))] == []


def press(page: Any, name: str) -> None:
    page.get_by_role("button", name=name).click()


def wait_for(page: Any, said: str) -> str:
    """Wait for a status text and return it."""
    status = page.get_by_role("status").filter(has_text=said)
    status.wait_for()
    return status.text_content()


def test_a_hole_that_is_flown_to_closes_opens_again_and_is_saved(
    page, room, out, tmp_path, monkeypatch
):
    page.mouse.move(100, 250)
    page.mouse.down()
    page.mouse.move(160, 250, steps=4)
    page.mouse.up()
    press(page, "Complete what I see")
    assert "Gaussians are added" in wait_for(page, "Completed in")
    press(page, "Undo")
    wait_for(page, "Undone. Completions left: 0.")
    press(page, "Find a hole")
    wait_for(page, "The scene has a hole here")
    press(page, "Complete what I see")
    wait_for(page, "Completed in")
    press(page, "Save")
    wait_for(page, "Saved in")

    other, cameras = tmp_path / "out", out / "targets.json"
    assert len(json.loads(cameras.read_text())["frames"]) == 1
    words = ("complete", room, "--context", 0, 1, "--target", cameras, "--out", other, *SMALL)
    assert run(monkeypatch, *words) == 0
    for name in ("completed.ply", "context.ply", "generated.ply", "images/target1_after.png"):
        assert (out / name).read_bytes() == (other / name).read_bytes(), name
