"""The command `demo`, at a tenth of its resolution."""

import json

from command import run
from gscompleter.apps.completing import demo
from gscompleter.system.files.image import read_image


def test_both_targets_are_completed_and_shown_before_and_after(tmp_path, monkeypatch):
    height, width = 32, 48
    monkeypatch.setattr(demo, "RESOLUTION", (height, width))
    out = tmp_path / "demo"
    assert run(monkeypatch, "demo", "--out", out, "--quiet") == 0
    summary = json.loads((out / "completion" / "summary.json").read_text())
    assert len(summary["targets"]) == 2
    assert summary["gaussians"]["added"] > 0
    assert summary["settings"]["folder"] == str(out / "scene")
    images = read_image(out / "before_after.png")
    assert images.shape[0] == height
    assert images.shape[1] >= 4 * width
