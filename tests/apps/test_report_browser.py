"""The report in a real browser: no requests, and sliders that move."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from browsing import Tab, launched, pixels_of

pytestmark = pytest.mark.browser

PLACES = """(drawing) => {
  const whole = drawing.getBoundingClientRect();
  return [...drawing.querySelectorAll("circle, polyline")].map((part) => {
    const box = part.getBoundingClientRect();
    return [(box.left - whole.left) / whole.width, (box.top - whole.top) / whole.height];
  });
}"""
"""Script that returns the corner of each part of a drawing, as fractions of its size."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with launched() as browser:
        yield browser


@pytest.fixture(scope="module")
def tab(browser: Any, completed_room: Path) -> Tab:
    return Tab(browser, completed_room / "report.html", 1000, 800)


def test_the_report_opens_without_a_request_or_an_error(tab, completed_room):
    assert tab.requests[0] == (completed_room / "report.html").as_uri()
    assert {url.split(":", 1)[0] for url in tab.requests[1:]} <= {"data"}
    assert tab.errors == []
    assert tab.page.evaluate("[...document.images].every((image) => image.naturalWidth > 0)")


def test_the_slider_goes_from_after_to_before_by_the_keyboard(tab):
    frame, slider = tab.page.locator(".frame").first, tab.page.locator(".frame input").first
    slider.focus()
    tab.page.keyboard.press("Home")
    after = pixels_of(frame.screenshot())
    tab.page.keyboard.press("End")
    before = pixels_of(frame.screenshot())
    height, width, _ = after.shape
    middle = np.s_[height // 4 : -height // 4, width // 4 : -width // 4]
    assert np.abs(after - before)[middle].max() > 0.2  # the filled hole
    assert before[middle].mean() < after[middle].mean()  # which is black before


def test_the_cameras_turn(tab):
    """Compares positions: on a busy machine a screenshot may not follow a key press."""
    drawing = tab.page.locator(".turning svg").first
    first = drawing.evaluate(PLACES)
    tab.page.locator(".turning .yaw").first.focus()
    for _ in range(10):
        tab.page.keyboard.press("ArrowRight")
    moved = np.abs(np.subtract(drawing.evaluate(PLACES), first))
    assert 0.02 < moved.max() < 1


FLOWN = """async () => {
  const [button, ...names] = document.querySelectorAll(".turning .views button");
  const flying = document.querySelector(".turning .flying");
  const current = () => names.findIndex((name) => name.getAttribute("aria-current") === "true");
  const log = [];
  const tell = () => log.push([button.textContent, current(), flying.getAttribute("points")]);
  const wait = async (done) => { while (!done()) await new Promise(requestAnimationFrame); };
  tell();
  button.click();
  tell();
  await wait(() => current() === 1);
  button.click();
  tell();
  names.at(-1).click();
  tell();
  return [log, names.map((name) => name.textContent)];
}"""
"""Script that plays the path to its second camera, pauses it, and jumps to the last one."""


def test_the_camera_path_plays_and_named_views_are_jumped_to(tab):
    log, names = tab.page.evaluate(FLOWN)
    assert [name.split(" (")[0] for name in names[:2]] == ["Photograph 0", "Photograph 1"]
    assert names[2].startswith("Target 1")
    assert [button for button, _, _ in log] == ["Play", "Pause", "Play", "Play"]
    assert [current for _, current, _ in log] == [0, 0, 1, 2]
    places = [points for _, _, points in log]
    assert len({*places}) == 3
    points_of = (
        "(name) => document.querySelector(`.turning polyline.${name}`).getAttribute('points')"
    )
    assert places[3] == tab.page.evaluate(points_of, "target")
    assert places[0] in [tab.page.evaluate(points_of, kind) for kind in ("context", "anchor")]
    assert tab.errors == []


@pytest.mark.slow
def test_it_fits_a_phone(browser, completed_room):
    tab = Tab(browser, completed_room / "report.html", 360, 700)
    assert tab.page.evaluate("document.documentElement.scrollWidth") <= 360
