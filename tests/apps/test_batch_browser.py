"""The page of a batch in a real browser: it shows the pictures beside it and loads nothing else."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from browsing import Tab, launched
from gscompleter.apps.report.page import write_overview
from gscompleter.system.files.image import write_image
from gscompleter.system.jobs.jobs import Job

pytestmark = pytest.mark.browser

SCORES = ("hole_fraction", "psnr_before", "psnr_after", "coverage_before", "coverage_after")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with launched() as browser:
        yield browser


@pytest.fixture(scope="module")
def batch(tmp_path_factory) -> Path:
    """Write the folder of a batch: a scene that is done, and three failures.

    Of two there is a page: that of its own failure, and that of an earlier run.
    """
    folder = tmp_path_factory.mktemp("batch")
    done = {"state": "done", "targets": 1, "added": 3, "seconds": 2.0, **dict.fromkeys(SCORES, 0.5)}
    failed = {"state": "failed", "reason": "There is no <photograph>."}
    shards = {"state": "failed", "reason": "The scene did not reconstruct."}
    (folder / "rows").mkdir()
    rows = {"room & hall": done, "cellar": failed, "attic": shards, "loft": failed}
    for name, row in rows.items():
        content = {"job": name, "options": {}, "attempts": 1, **row}
        (folder / "rows" / f"{name}.json").write_text(json.dumps(content))
    images = folder / "jobs" / "room & hall" / "images"
    images.mkdir(parents=True)
    for number, when in enumerate(("before", "after")):
        write_image(images / f"target1_{when}.png", torch.full((24, 32, 3), 0.5 + 0.2 * number))
    summary = {"outcome": {"headline": shards["reason"]}}
    for name in ("attic", "loft"):
        (folder / "jobs" / name).mkdir()
        (folder / "jobs" / name / "report.html").write_text("<title>A page</title>")
        (folder / "jobs" / name / "summary.json").write_text(json.dumps(summary))
    write_overview(folder, [Job(name) for name in rows])
    return folder


@pytest.fixture(scope="module")
def tab(browser, batch) -> Tab:
    return Tab(browser, batch / "index.html", 1000, 800)


def test_the_pictures_of_the_jobs_are_shown(tab, batch):
    tab.page.evaluate("Promise.all([...document.images].map((image) => image.decode()))")
    sizes = tab.page.evaluate("[...document.images].map((image) => image.naturalWidth)")
    assert sizes == [32, 32]
    assert tab.errors == []
    below = batch.as_uri()
    assert all(url.startswith(below) for url in tab.requests)
    assert tab.page.locator("#failures").inner_text().count("There is no <photograph>.") == 2


def test_a_failed_job_that_left_a_report_links_to_it(tab):
    (link,) = tab.page.locator("#failures a").all()
    assert link.inner_text() == "attic"
    link.click()
    assert tab.page.title() == "A page"


# `test_report.py` finds no address in a page.
@pytest.mark.slow
def test_no_other_request_is_allowed(browser, batch):
    tab = Tab(browser, batch / "index.html", 1000, 800)
    tab.context.set_offline(False)
    blocked = tab.page.evaluate(
        """() => new Promise((resolve) => {
          const image = Object.assign(new Image(), {src: "https://elsewhere.invalid/a.png"});
          document.addEventListener("securitypolicyviolation", (e) => resolve(e.blockedURI));
          document.body.append(image);
        })"""
    )
    assert blocked.startswith("https://elsewhere.invalid")
