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


def test_it_fits_a_phone(browser, completed_room):
    tab = Tab(browser, completed_room / "report.html", 360, 700)
    assert tab.page.evaluate("document.documentElement.scrollWidth") <= 360
