"""The viewer page in a real browser: without any request, and compared with our renderer."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from browsing import CHROMIUM, SWITCHES, Picture, Tab, launched, needed
from command import run
from gscompleter import load_cameras, save_ply
from gscompleter.apps.viewer import page as pages
from gscompleter.apps.viewer.exhibit import ViewerContent
from gscompleter.apps.viewer.packages import Libraries, load_libraries
from gscompleter.apps.viewer.page import make_page
from gscompleter.render.loading import load_renderer
from gscompleter.system.errors import InputError
from gscompleter.system.files.image import read_image
from gscompleter.types import Camera, Gaussians
from parity import assert_close
from viewer_pages import LEFT, SIDE, TARGET, room_exhibit

pytestmark = pytest.mark.browser

BARE = """
header, aside, figcaption, #divider { display: none !important; }
#stage { position: fixed !important; inset: 0; }
[data-shown="side"] #before { right: 50% !important; }
[data-shown="side"] #after { left: 50% !important; }
"""
"""Style that lets the pictures fill the window, to the pixel."""

PLAYED = """(async () => {
  const [button, stage] = ["play", "stage"].map((id) => document.getElementById(id));
  const log = [];
  const tell = () => log.push({ ...gsc.stats(), button: button.textContent });
  const press = () => window.dispatchEvent(new KeyboardEvent("keydown", { key: "p" }));
  const click = () => button.click();
  const zoom = () => stage.dispatchEvent(new WheelEvent("wheel", { deltaY: 1 }));
  for (const [start, stop] of [[() => {}, press], [press, click], [click, zoom]]) {
    start();
    const end = gsc.stats().seconds + 0.1;
    while (gsc.stats().playing && gsc.stats().seconds < end) {
      await new Promise(requestAnimationFrame);
    }
    tell();
    stop();
    tell();
  }
  return log;
})()"""
"""Script that plays the path three times and pauses it in three ways, within one call: a page that
always renders lets few calls through."""


@pytest.fixture(scope="module")
def libraries() -> Libraries:
    try:
        return load_libraries()
    except InputError as error:
        needed(str(error))
        raise


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with launched() as browser:
        yield browser


@pytest.fixture(scope="module")
def played_browser(browser) -> Iterator[Any]:
    """Run a browser that waits for a screen before it renders the next frame."""
    other = browser.browser_type.launch(executable_path=CHROMIUM, args=SWITCHES)
    yield other
    other.close()


class Window(Tab):
    """A page of the viewer."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.page.evaluate("gsc.ready")

    def do(self, call: str) -> Any:
        """Call the page's interface, and return its result once everything is rendered."""
        value = self.page.evaluate(call)
        self.page.evaluate("gsc.settled()")
        return value

    def key(self, key: str, held: bool = False) -> None:
        (self.page.keyboard.down if held else self.page.keyboard.press)(key)
        self.page.evaluate("gsc.settled()")


@pytest.fixture(scope="module")
def exhibit() -> ViewerContent:
    return room_exhibit()


@pytest.fixture(scope="module")
def saved(exhibit, libraries, tmp_path_factory) -> Path:
    """Return the page as a file, in a folder whose name needs to be escaped."""
    path = tmp_path_factory.mktemp("a folder #1") / "page.html"
    path.write_bytes(make_page(exhibit, libraries)[0])
    return path


@pytest.fixture(scope="module")
def bare(browser, saved) -> Window:
    """Open a window with only two pictures of a camera's size, or one of twice its width."""
    tab = Window(browser, saved, 2 * SIDE, SIDE)
    tab.page.add_style_tag(content=BARE)
    tab.page.evaluate("gsc.settled()")
    return tab


def rendered(gaussians: Gaussians, camera: Camera) -> Picture:
    with torch.no_grad():
        return load_renderer("cpu").render(gaussians, camera).image.clamp(0, 1).double().numpy()


def psnr(one: Picture, other: Picture) -> float:
    return -10 * np.log10(np.mean((one - other) ** 2))


def distance(one: list[float], other: list[float]) -> float:
    return float(np.linalg.norm(np.subtract(one, other)))


def observed_of(exhibit: ViewerContent) -> Gaussians:
    return exhibit.after[exhibit.after.generated == 0]


@pytest.mark.parametrize(
    ("name", "camera"),
    [("target-1", TARGET), pytest.param("camera-1", LEFT, marks=pytest.mark.slow)],
)
def test_both_pictures_are_those_of_our_renderer(bare, exhibit, name, camera):
    bare.do("gsc.setMode('side')")
    assert bare.do(f"gsc.goTo('{name}')")
    shown = bare.picture()
    assert psnr(shown[:, :SIDE], rendered(exhibit.before, camera)) > 25
    assert psnr(shown[:, SIDE:], rendered(exhibit.after, camera)) > 25


def test_hiding_what_was_generated_brings_the_hole_back(bare, exhibit):
    bare.do("gsc.setMode('side')")
    bare.do("gsc.goTo('target-1')")
    bare.do("gsc.setGenerated('hide')")
    hidden = bare.picture()[:, SIDE:]
    bare.do("gsc.setGenerated('tint')")
    tinted = bare.picture()[:, SIDE:]
    bare.do("gsc.setGenerated('show')")
    expected = rendered(observed_of(exhibit), TARGET)
    assert psnr(hidden, expected) > 25
    assert psnr(bare.picture()[:, SIDE:], expected) < 15
    hole = expected.max(axis=-1) == 0
    assert hole.mean() > 0.2
    # The tint takes green away, and nothing of what was observed.
    after = rendered(exhibit.after, TARGET)
    assert tinted[hole][:, 1].mean() < 0.7 * after[hole][:, 1].mean()
    seen = expected.min(axis=-1) > 0.05
    assert seen.mean() > 0.1


def test_a_jump_moves_both_pictures_and_the_address(bare):
    bare.do("gsc.goTo('target-1')")
    before, there = bare.picture(), bare.do("gsc.stats()")
    bare.do("gsc.goTo('camera-1')")
    here = bare.do("gsc.stats()")
    assert distance(here["eye"], LEFT.center.tolist()) < 1e-5
    assert distance(there["eye"], TARGET.center.tolist()) < 1e-5
    change = np.abs(bare.picture() - before)
    assert min(change[:, :SIDE].mean(), change[:, SIDE:].mean()) > 0.02
    assert "camera=camera-1" in bare.page.url
    assert bare.do("gsc.goTo('nowhere')") is False
    assert bare.do("gsc.goTo('constructor')") is False


def test_the_slider_shows_before_on_its_left_and_after_on_its_right(bare):
    bare.do("gsc.goTo('target-1')")
    bare.do("gsc.setMode('before')")
    before = bare.picture()
    bare.do("gsc.setMode('after')")
    after = bare.picture()
    assert np.abs(after - before).mean() > 0.05
    bare.do("gsc.setMode('slider')")
    middle = bare.picture()
    assert np.abs(middle[:, : SIDE - 2] - before[:, : SIDE - 2]).max() < 0.02
    assert np.abs(middle[:, SIDE + 2 :] - after[:, SIDE + 2 :]).max() < 0.02
    assert np.abs(middle[:, SIDE + 2 :] - before[:, SIDE + 2 :]).mean() > 0.05


def test_a_held_key_shows_before_as_long_as_it_is_held(bare):
    bare.do("gsc.goTo('target-1')")
    bare.do("gsc.setMode('before')")
    before = bare.picture()
    bare.do("gsc.setMode('after')")
    after = bare.picture()
    bare.key("b", held=True)
    assert np.abs(bare.picture() - before).max() < 0.02
    bare.page.keyboard.up("b")
    bare.do("gsc.settled()")
    assert np.abs(bare.picture() - after).max() < 0.02


def check_frame(tab: Window, shown: Picture, around: np.ndarray) -> None:
    """Check that nothing is `shown` in `around`, the pixels beyond the frame, until one moves."""
    # One colour, which is not the black of holes.
    assert np.ptp(shown[around], axis=0).max() == 0
    assert shown[around].min() > 0.2

    tab.key("w")
    assert not tab.do("gsc.stats().framed")
    assert np.ptp(tab.picture()[around], axis=0).max() > 0.3
    tab.key("r")
    assert np.abs(tab.picture() - shown).max() < 0.02


def test_nothing_is_shown_beyond_the_frame_of_a_camera_until_it_is_moved(bare):
    bare.do("gsc.setMode('after')")
    bare.do("gsc.goTo('target-1')")
    around = np.ones((SIDE, 2 * SIDE), dtype=bool)
    around[:, SIDE // 2 : -SIDE // 2] = False
    shown = bare.picture()
    check_frame(bare, shown, around)


def test_keys_choose_what_is_shown(bare):
    bare.page.keyboard.press("3")
    assert bare.page.evaluate("gsc.stats()")["mode"] == "before"
    bare.page.evaluate("gsc.setMode('side')")


@pytest.mark.slow
def test_keys_and_drags_do_what_the_page_says(bare):
    bare.do("gsc.goTo('camera-1')")
    for key, mode in (("1", "side"), ("2", "slider"), ("3", "before"), ("4", "after")):
        bare.page.keyboard.press(key)
        assert bare.page.evaluate("gsc.stats()")["mode"] == mode
    bare.page.keyboard.press("g")
    assert bare.page.evaluate("gsc.stats()")["generated"] == "tint"
    bare.page.evaluate("gsc.setGenerated('show')")
    bare.page.keyboard.press("]")
    start = bare.page.evaluate("gsc.stats()")
    assert start["camera"] == "target-1"
    for drag, moves in (("orbit", True), ("fly", False)):
        bare.page.keyboard.press("r")
        bare.page.mouse.move(SIDE, SIDE / 2)
        bare.page.mouse.down()
        bare.page.mouse.move(SIDE + 20, SIDE / 2)
        bare.page.mouse.up()
        stats = bare.page.evaluate("gsc.stats()")
        assert stats["drag"] == drag
        assert (distance(stats["eye"], start["eye"]) > 0.1) == moves
        bare.page.keyboard.press("f")
    bare.page.keyboard.press("r")
    bare.key("w")
    step = np.array(bare.do("gsc.stats()")["eye"]) - start["eye"]
    assert step @ TARGET.forward.double().numpy() > 0.99 * np.linalg.norm(step) > 0


@pytest.mark.slow
def test_the_path_goes_smoothly_through_the_cameras(bare):
    bare.do("gsc.setMode('side')")
    end = bare.do("gsc.goTo('camera-1'), gsc.stats()")["seconds"]
    stop = bare.picture()
    bare.do(f"gsc.seek({end})")
    assert np.abs(bare.picture() - stop).mean() < 0.01
    assert bare.do("gsc.seek(0), gsc.stats()")["camera"] == "target-1"
    times = np.linspace(0, 2 * end, 81)
    eyes = np.array([bare.page.evaluate(f"gsc.seek({t}), gsc.stats().eye") for t in times])
    assert distance(eyes[0], TARGET.center.tolist()) < 1e-5
    assert distance(eyes[40], LEFT.center.tolist()) < 1e-5
    assert distance(eyes[-1], eyes[0]) < 1e-5  # there and back
    steps = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
    assert 0 < steps.max() < 2.2 * steps.mean()
    assert steps[:40:39].max() < 0.2 * steps.max()  # at rest at both ends
    assert np.linalg.norm(np.diff(eyes, n=2, axis=0), axis=1).max() < 0.2 * steps.max()


def test_nothing_was_asked_for_and_nothing_went_wrong(bare):
    """Last of those that share the window."""
    assert bare.errors == []
    assert {url.split(":", 1)[0] for url in bare.requests} <= {"file", "blob", "data"}
    assert [url for url in bare.requests if url.startswith("file:")] == [bare.requests[0]]


def test_a_link_opens_at_its_camera(browser, saved):
    tab = Window(browser, saved, 160, 120, "#camera=camera-1&mode=slider&generated=hide")
    stats = tab.do("gsc.stats()")
    assert (stats["camera"], stats["mode"], stats["generated"]) == ("camera-1", "slider", "hide")
    assert tab.page.get_by_role("button", name="Left").get_attribute("aria-current") == "true"
    divider = tab.page.get_by_role("slider")
    divider.press("ArrowRight")
    assert divider.get_attribute("aria-valuenow") == "52"
    tab.context.close()


# `test_nothing_is_shown_beyond_the_frame_of_a_camera_until_it_is_moved` is the short one.
@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(4 * SIDE, SIDE), (SIDE, 3 * SIDE)])
def test_nothing_is_shown_beyond_the_frame_after_the_window_is_resized(
    browser, saved, width, height
):
    tab = Window(browser, saved, SIDE, SIDE, "#camera=target-1&mode=after")
    tab.page.add_style_tag(content=BARE)
    tab.do("gsc.settled()")
    frame = tab.picture()

    tab.page.set_viewport_size({"width": width, "height": height})
    tab.do("gsc.settled()")
    top, left = (height - SIDE) // 2, (width - SIDE) // 2
    inside = (slice(top, top + SIDE), slice(left, left + SIDE))
    around = np.ones((height, width), dtype=bool)
    around[inside] = False
    shown = tab.picture()
    assert np.abs(shown[inside] - frame).mean() < 0.01
    check_frame(tab, shown, around)
    tab.context.close()


# `test_viewer.py` has such a page, and
# `test_nothing_is_shown_beyond_the_frame_of_a_camera_until_it_is_moved` leaves a frame.
@pytest.mark.slow
def test_a_page_without_cameras_fills_the_window(browser, exhibit, libraries, tmp_path):
    (tmp_path / "page.html").write_bytes(make_page(replace(exhibit, cameras=()), libraries)[0])
    tab = Window(browser, tmp_path / "page.html", 320, 240)
    assert not tab.do("gsc.stats().framed")
    tab.context.close()


def test_a_link_plays_the_path_until_it_is_paused(saved, played_browser):
    tab = Window(played_browser, saved, 160, 120, "#camera=target-1&play=1")
    log = tab.page.evaluate(PLAYED)
    tab.context.close()
    assert [entry["playing"] for entry in log] == [True, False] * 3
    assert [entry["button"] for entry in log] == ["Pause", "Play"] * 3
    seconds = [entry["seconds"] for entry in log]
    assert seconds == sorted(seconds)
    eyes = [entry["eye"] for entry in log]
    assert distance(eyes[0], TARGET.center.tolist()) > 0.001
    assert distance(eyes[2], eyes[0]) > 0.001


@pytest.mark.slow
def test_the_parts_of_a_large_scene_are_put_together(
    browser, exhibit, libraries, tmp_path, monkeypatch
):
    monkeypatch.setattr(pages, "MAX_SCRIPT_BYTES", 100_000)
    (tmp_path / "page.html").write_bytes(make_page(exhibit, libraries)[0])
    tab = Window(browser, tmp_path / "page.html", 320, 240)
    assert tab.do("gsc.stats()")["frames"] > 0
    assert tab.errors == []
    tab.context.close()


@pytest.mark.slow
def test_antialiased_gaussians_are_those_of_our_renderer(browser, libraries, tmp_path):
    """Both pictures differ from those of the classic mode."""
    room = room_exhibit()
    small = [replace(g, scales=0.7 * g.scales) for g in (room.before, room.after)]
    before, after = (replace(gaussians, is_antialiased=True) for gaussians in small)
    exhibit = replace(room, before=before, after=after)
    (tmp_path / "page.html").write_bytes(make_page(exhibit, libraries)[0])
    tab = Window(browser, tmp_path / "page.html", 2 * SIDE, SIDE)
    tab.page.add_style_tag(content=BARE)
    tab.do("gsc.setMode('side')")
    tab.do("gsc.goTo('target-1')")
    shown = tab.picture()
    for half, marked, classic in zip(
        (slice(SIDE), slice(SIDE, None)), (before, after), small, strict=True
    ):
        found = psnr(shown[:, half], rendered(marked, TARGET))
        assert found > 25
        assert found > psnr(shown[:, half], rendered(classic, TARGET)) + 3
    tab.context.close()


def test_text_from_outside_stays_text(browser, libraries, tmp_path):
    evil = "</script><img src=x onerror=document.title='broken'>"
    (tmp_path / "page.html").write_bytes(make_page(room_exhibit(evil), libraries)[0])
    # Without waiting for pictures.
    tab = Tab(browser, tmp_path / "page.html", 64, 48)
    assert tab.page.title() == evil
    assert tab.page.locator("h1").text_content() == evil
    assert tab.page.locator("h1 *").count() == 0
    tab.context.close()


@pytest.mark.slow
def test_what_is_painted_is_saved_with_its_camera_and_repaired(
    browser, saved, exhibit, tmp_path, monkeypatch
):
    tab = Window(browser, saved, 900, 700)
    tab.do('gsc.goTo("target-1")')
    assert not tab.page.is_visible("#brush")
    tab.key("m")
    assert tab.do("gsc.stats()")["drag"] == "mark"
    assert tab.page.is_visible("#brush")
    eye = tab.do("gsc.stats().eye")

    # A stroke through the middle of the picture, which is where the photograph is.
    box = tab.page.locator("#stage").bounding_box()
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    tab.page.mouse.move(middle[0] - 40, middle[1])
    tab.page.mouse.down()
    tab.page.mouse.move(middle[0] + 40, middle[1], steps=5)
    tab.page.mouse.up()
    assert distance(tab.do("gsc.stats().eye"), eye) == 0.0
    with tab.page.expect_download() as download:
        tab.page.click("#save-mask")
    download.value.save_as(tmp_path / "mask.png")
    with tab.page.expect_download() as download:
        tab.key("c")
    download.value.save_as(tmp_path / "camera.json")
    assert download.value.suggested_filename == "camera.json"

    # The mask has the size of the photograph, and the stroke in its middle.
    mask = read_image(tmp_path / "mask.png").mean(dim=-1) > 0.5
    assert mask.shape == (TARGET.height, TARGET.width)
    rows, columns = torch.nonzero(mask).float().mean(dim=0).tolist()
    assert abs(rows - TARGET.height / 2) < 1.5
    assert abs(columns - TARGET.width / 2) < 1.5
    assert 0.005 < mask.float().mean() < 0.2
    (camera,) = load_cameras(tmp_path / "camera.json")
    assert_close(camera.c2w, TARGET.c2w, "c2w", 1e-5)
    assert_close(camera.K, TARGET.K, "K", 1e-6)

    # An erased stroke, one that is taken back, and a move leave nothing.
    tab.key("z")
    assert tab.do("gsc.maskPng()") is None
    tab.page.mouse.move(*middle)
    tab.page.mouse.down()
    tab.page.mouse.up()
    assert tab.do("gsc.maskPng().then((png) => png.size)") > 0
    tab.key("w")
    assert tab.do("gsc.maskPng()") is None
    assert "camera moved" in tab.page.inner_text("#message")

    after = exhibit.after
    save_ply(tmp_path / "splat.ply", replace(after, generated=torch.zeros_like(after.generated)))
    words = ("repair", tmp_path / "splat.ply", "--target", tmp_path / "camera.json", "--quiet")
    out = tmp_path / "out"
    assert run(monkeypatch, *words, "--mask", tmp_path / "mask.png", "--out", out) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["gaussians"]["removed"] > 0
    assert summary["targets"][0]["added"] > 0


@pytest.mark.slow
def test_fingers_paint_and_move(browser, saved):
    """One finger paints; with a second one both move the camera, and nothing is painted."""
    options = {"viewport": {"width": 420, "height": 700}, "has_touch": True, "is_mobile": True}
    context = browser.new_context(**options)
    page = context.new_page()
    page.goto(saved.as_uri() + "#camera=target-1")
    page.evaluate("gsc.ready")
    page.keyboard.press("m")
    # The picture has room on a phone, too.
    assert page.locator("#stage").bounding_box()["height"] > 300
    assert page.evaluate("[innerWidth, innerHeight]") == [420, 700]
    touch(page, 1)
    assert page.evaluate("gsc.stats()")["strokes"] == 1
    page.keyboard.press("z")
    eye = page.evaluate("gsc.stats()")["eye"]
    touch(page, 2)
    stats = page.evaluate("gsc.stats()")
    assert stats["strokes"] == 0
    assert distance(stats["eye"], eye) > 0.01
    context.close()


def touch(page: Any, count: int) -> None:
    """Drag with one finger, or two fingers apart, over the middle of the scene."""
    session = page.context.new_cdp_session(page)
    box = page.locator("#stage").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def send(kind: str, places: list[tuple[float, float]]) -> None:
        points = [{"x": px, "y": py, "id": number} for number, (px, py) in enumerate(places)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    def places(apart: float) -> list[tuple[float, float]]:
        return [(x - apart, y), (x + apart, y)][:count]

    # One finger is down first, as with a hand.
    send("touchStart", places(20)[:1])
    if count == 2:
        send("touchStart", places(20))
    for apart in (30, 40, 60):
        send("touchMove", places(apart))
    send("touchEnd", [])
    page.evaluate("gsc.settled()")


@pytest.mark.slow
def test_a_lasso_marks_its_inside_and_strokes_come_back(browser, saved, tmp_path):
    tab = Window(browser, saved, 420, 400)
    tab.do('gsc.goTo("target-1")')
    tab.key("l")
    box = tab.page.locator("#stage").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    tab.page.mouse.move(x - 60, y - 60)
    tab.page.mouse.down()
    for right, down in ((60, -60), (60, 60), (-60, 60)):
        tab.page.mouse.move(x + right, y + down)
    tab.page.mouse.up()

    def share() -> float:
        with tab.page.expect_download() as download:
            tab.key("n")
        download.value.save_as(tmp_path / "mask.png")
        return float((read_image(tmp_path / "mask.png").mean(dim=-1) > 0.5).float().mean())

    zoom = min(box["width"] / TARGET.width, box["height"] / TARGET.height)
    expected = (120 / zoom) ** 2 / (TARGET.width * TARGET.height)
    assert abs(share() - expected) < 0.15 * expected
    tab.key("z")
    assert tab.do("gsc.maskPng()") is None
    tab.key("y")
    assert abs(share() - expected) < 0.15 * expected
    assert not tab.page.is_visible("#live")
    tab.context.close()
