"""A browser for tests of pages: Debian's chromium, without requests of its own."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float
from PIL import Image

CHROMIUM = os.environ.get("BROWSER_FOR_TESTS") or shutil.which("chromium")
SWITCHES = [
    *("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
]
"""Software WebGL 2, and no background requests of the browser."""
NO_SCREEN = ["--disable-gpu-vsync", "--disable-frame-rate-limit"]
"""Do not wait for a screen; a page that always renders would block others."""

PATIENCE = 60_000
"""Timeout of any action, in milliseconds."""

Picture = Float[np.ndarray, "h w 3"]


def needed(reason: str) -> None:
    """Skip for want of something; on CI, fail."""
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)


@contextmanager
def launched(switches: Sequence[str] = (*SWITCHES, *NO_SCREEN)) -> Iterator[Any]:
    """Run a browser."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    if CHROMIUM is None:
        needed("needs chromium")
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=CHROMIUM, args=list(switches))
        yield browser
        browser.close()


class Tab:
    """A page opened from its file, with the network off."""

    def __init__(self, browser: Any, path: Path, width: int, height: int, link: str = "") -> None:
        self.context = browser.new_context(viewport={"width": width, "height": height})
        self.context.set_offline(True)
        self.page = self.context.new_page()
        self.page.set_default_timeout(PATIENCE)
        self.requests: list[str] = []
        self.errors: list[str] = []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on(
            "console",
            lambda said: self.errors.append(said.text) if said.type == "error" else None,
        )
        self.page.goto(path.as_uri() + link)

    def picture(self) -> Picture:
        """Take a screenshot."""
        return pixels_of(self.page.screenshot())


def pixels_of(screenshot: bytes) -> Picture:
    """Decode the colours of a screenshot in [0, 1]."""
    image = Image.open(io.BytesIO(screenshot)).convert("RGB")
    return np.asarray(image, dtype=np.float64) / 255
