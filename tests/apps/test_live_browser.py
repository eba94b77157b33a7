"""`gscompleter live` in a real browser: the room is completed, and the fox is repaired."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from browsing import PATIENCE, SWITCHES, launched, pixels_of
from command import run
from gscompleter import save_ply
from gscompleter.types import merge
from scenes import Room, camera_at, gaussians_of, photographed, view_of

pytestmark = pytest.mark.browser

SIZE = 48
PLACES = ((-0.3, 0), (0.1, 0), (0.4, 4))
SMALL = ("--resolution", SIZE, SIZE, "--near", 0.5, "--far", 20, "--quiet")


@contextmanager
def served(*words: object, end: signal.Signals = signal.SIGTERM) -> Iterator[str]:
    """Serve the page in a process, which ends silently on SIGTERM, and return its address."""
    program = "from gscompleter.cli import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", program, "live", *map(str, words), "--no-open", "--quiet"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    try:
        yield process.stdout.readline().split()[0]
    finally:
        process.send_signal(end)
        rest, errors = process.communicate(timeout=30)
    code = 0 if end == signal.SIGTERM else -end
    assert (process.returncode, rest, errors) == (code, "", "")


class LiveTab:
    """The page in a browser."""

    def __init__(self, browser: Any, address: str, **context: Any) -> None:
        view = {"width": 640, "height": 560}
        self.page = browser.new_context(viewport=view, **context).new_page()
        self.page.set_default_timeout(PATIENCE)
        self.address = address
        self.asked: list[str] = []
        self.errors: list[str] = []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(address)
        self.page.evaluate("gsc.ready")
        self.page.evaluate("gsc.setMode('after')")

    def ask(self, action: str) -> str:
        """Ask for an action and wait until what came of it is shown; return what is said."""
        said = self.page.evaluate(f"gsc.ask('{action}')")
        self.page.evaluate("gsc.settled()")
        assert said["text"] == self.page.evaluate("document.getElementById('message').textContent")
        return said["text"]

    def drag(self, *places: tuple[int, int]) -> None:
        """Drag through places relative to the middle of the scene."""
        box = self.page.locator("#stage").bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        for number, (right, down) in enumerate(places):
            self.page.mouse.move(x + right, y + down, steps=3)
            if number == 0:
                self.page.mouse.down()
        self.page.mouse.up()
        self.page.evaluate("gsc.settled()")

    def key(self, key: str) -> None:
        self.page.keyboard.press(key)
        self.page.evaluate("gsc.settled()")

    def stats(self) -> dict[str, Any]:
        return self.page.evaluate("gsc.stats()")

    def picture(self) -> np.ndarray:
        """Take a screenshot of the middle of the picture, without message and frame."""
        picture = pixels_of(self.page.locator("#stage").screenshot())
        row, column = picture.shape[0] // 2, picture.shape[1] // 2
        return picture[row - 70 : row + 70, column - 70 : column + 70]

    def check_quiet(self) -> None:
        """Check that nothing went wrong, and that nobody else was asked."""
        assert self.errors == []
        allowed = (self.address.partition("?")[0], "data:", "blob:")
        assert [url for url in self.asked if not url.startswith(allowed)] == []


def check_places(tab: LiveTab) -> None:
    """Check that no tool moves anything, and that on a phone what it needs can be reached."""

    def places() -> list[Any]:
        parts = ("#stage", "#drags", "#live", "#save-camera", "#shots")
        return [tab.page.locator(part).bounding_box() for part in parts]

    for width in (1280, 640):
        tab.page.set_viewport_size({"width": width, "height": 560})
        before = places()
        for key in "mlxf":
            tab.key(key)
            # On a narrow page the buttons are those of the tool, in the same place.
            assert [place["y"] for place in places()] == [place["y"] for place in before], key
            assert width < 720 or places() == before, key
    tab.page.set_viewport_size({"width": 390, "height": 700})
    for key, actions in (("m", ("repair", "remove", "fill")), ("x", ("remove",)), ("f", ("find",))):
        tab.key(key)
        for action in (*actions, "undo", "redo", "save"):
            place = tab.page.locator(f"[data-ask={action}]").bounding_box()
            assert place["x"] >= 0
            assert place["x"] + place["width"] <= 390, (key, action)
    tab.key("m")
    tab.page.set_viewport_size({"width": 1280, "height": 560})
    tab.key("f")
    tab.page.set_viewport_size({"width": 640, "height": 560})


@pytest.fixture
def fox_splat(shared) -> Path:
    path = shared / "splats" / "fox" / "splat.ply"
    if not path.is_file():
        pytest.skip("needs the splat of the fox in the shared data")
    return path


@pytest.mark.slow
def test_a_hole_that_is_flown_to_closes_opens_again_and_is_saved(tmp_path, monkeypatch):
    cameras = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in PLACES]
    room, out = photographed(tmp_path / "room", cameras), tmp_path / "out"
    with (
        served(room, "--context", 0, 1, "--out", out, *SMALL[:-1]) as address,
        launched(SWITCHES) as browser,
    ):
        tab = LiveTab(browser, address)
        assert "Fly to a hole" in tab.page.inner_text("#message")
        assert tab.ask("undo").startswith("There is nothing to undo")
        tab.drag((-60, 40), (0, 40))
        assert not tab.page.is_visible("#unsaved")
        given = tab.stats()["counts"]
        assert given["observed"] > 0 == given["generated"]
        assert "Gaussians are added" in tab.ask("complete")
        # The page counts what it shows.
        shown = tab.stats()["counts"]
        assert shown["observed"] == given["observed"]
        assert shown["generated"] > 50
        assert tab.page.is_visible("#unsaved")
        check_places(tab)
        assert tab.ask("undo") == "Undone. Steps left: 0."
        assert tab.stats()["counts"] == given
        assert "The scene has a hole here" in tab.ask("find")
        assert "Gaussians are added" in tab.ask("complete")
        assert "Saved in" in tab.ask("save")
        assert not tab.page.is_visible("#unsaved")
        # A page that is opened again shows the scene as it is.
        again = LiveTab(browser, address)
        again.page.evaluate("gsc.settled()")
        assert again.stats()["live"]["steps"] == 1
        for page in (tab, again):
            page.check_quiet()

    saved, other = out / "targets.json", tmp_path / "other"
    assert len(json.loads(saved.read_text())["frames"]) == 1
    words = ("complete", room, "--context", 0, 1, "--target", saved, "--out", other, *SMALL)
    assert run(monkeypatch, *words) == 0
    for name in ("completed.ply", "context.ply", "generated.ply", "images/target1_after.png"):
        assert (out / name).read_bytes() == (other / name).read_bytes(), name


@pytest.mark.slow
def test_what_photographs_add_to_a_splat_is_shown_before_any_step(tmp_path):
    cameras = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in PLACES]
    room, splat = photographed(tmp_path / "room", cameras), tmp_path / "s.ply"
    save_ply(splat, gaussians_of(view_of(Room(), cameras[0])))
    words = (room, "--scene", splat, "--context", 0, 1, "--out", tmp_path / "out", *SMALL[:-1])
    with served(*words) as address, launched(SWITCHES) as browser:
        tab = LiveTab(browser, address)
        stats = tab.stats()
        assert stats["live"]["steps"] == 0
        assert sum(stats["counts"].values()) - stats["counts"]["before"] > SIZE**2 + 50
        assert "Fly to a hole" in tab.page.inner_text("#message")
        tab.check_quiet()


@pytest.mark.slow
def test_a_killed_program_shows_its_steps_again(tmp_path):
    """SIGKILL after each of three steps; then undo three times gives the input."""
    cameras = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in PLACES]
    room, out, splat = (
        photographed(tmp_path / "room", cameras),
        tmp_path / "out",
        tmp_path / "s.ply",
    )
    save_ply(splat, merge([gaussians_of(view_of(Room(), camera)) for camera in cameras]))
    words: tuple[object, ...] = (room, "--scene", splat, "--context", 0, 1, "--out", out)
    words = (*words, *SMALL[:-1])
    corners = ([-0.6, 0.2, 2.1, 0.4, 1.47, 3.1], [-2, -1, 2, -1.2, 2, 6], [1.2, -1, 2, 2, 2, 6])
    shown = []
    with launched(SWITCHES) as browser:
        for count, box in enumerate(corners, start=1):
            with served(*words, end=signal.SIGKILL) as address:
                tab = LiveTab(browser, address)
                if count == 1:
                    shown.append(tab.picture())
                tab.key("x")
                tab.page.evaluate(f"gsc.placeBox({box})")
                assert "are removed" in tab.ask("remove")
                tab.key("f")
                assert tab.stats()["live"]["steps"] == count
                assert tab.page.is_visible("#unsaved")
                shown.append(tab.picture())
            words = (out,)
        with served(out) as address:
            tab = LiveTab(browser, address)
            tab.page.evaluate("gsc.settled()")
            assert "3 steps of the session are done again" in tab.page.inner_text("#message")
            for count in (3, 2, 1, 0):
                assert tab.stats()["live"]["steps"] == count
                assert np.abs(tab.picture() - shown[count]).max() < 0.02
                if count:
                    tab.ask("undo")
            assert not tab.page.is_visible("#unsaved")
            tab.check_quiet()


@pytest.mark.slow
def test_the_fox_is_painted_repaired_undone_saved_and_stripped(fox_splat, tmp_path, monkeypatch):
    out = tmp_path / "out"
    with (
        served(fox_splat, "--out", out, "--resolution", 128, 128) as address,
        launched(SWITCHES) as browser,
    ):
        tab = LiveTab(browser, address)
        given = tab.picture()

        # Strokes of the brush and the lasso are taken back and painted again.
        tab.key("m")
        tab.drag((-40, -10), (40, 30))
        tab.key("l")
        tab.drag((-30, 10), (0, 50), (30, 10))
        tab.key("z")
        assert tab.stats()["strokes"] == 1
        tab.key("y")
        assert tab.stats()["strokes"] == 2
        painted = tab.picture()
        assert (np.abs(painted - given).max(axis=-1) > 0.1).mean() > 0.01

        said = tab.ask("repair")
        assert "are removed" in said
        assert tab.stats()["strokes"] == 0
        counts = tab.stats()["counts"]
        assert counts["observed"] < counts["before"]
        assert counts["generated"] > 100
        repaired = tab.picture()
        is_changed = np.abs(repaired - given).max(axis=-1) > 0.02
        assert 0.005 < is_changed.mean() < 0.3
        # Nothing black is left of what was removed.
        assert repaired[is_changed].mean() > 0.7 * given[is_changed].mean()
        tab.ask("undo")
        assert np.abs(tab.picture() - given).max() < 0.02
        sent = len(tab.asked)
        tab.ask("redo")
        assert np.abs(tab.picture() - repaired).max() < 0.02
        # What was sent before is not sent again.
        assert [url for url in tab.asked[sent:] if "chunks" in url] == []

        # A box where the fox is, which takes more away.
        tab.key("x")
        assert tab.page.is_visible("#box")
        boxed = tab.picture()
        assert (np.abs(boxed - repaired).max(axis=-1) > 0.1).mean() > 0.005
        assert "--box" in tab.ask("remove")
        tab.ask("undo")
        assert "Saved in" in tab.ask("save")
        tab.check_quiet()

    summary = json.loads((out / "summary.json").read_text())
    assert summary["gaussians"]["removed"] > 50
    assert summary["targets"][0]["added"] > 100
    restored, other = tmp_path / "restored.ply", tmp_path / "other"
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", restored, "--quiet") == 0
    assert restored.read_bytes() == fox_splat.read_bytes()
    words = ("repair", fox_splat, "--strokes", out / "strokes.json", "--out", other, "--quiet")
    assert run(monkeypatch, *words) == 0
    assert (out / "completed.ply").read_bytes() == (other / "completed.ply").read_bytes()
