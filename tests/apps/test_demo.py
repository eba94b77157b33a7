"""The command `demo`, at a tenth of its resolution."""

import json

from command import run
from gscompleter.apps.completing import demo
from gscompleter.apps.completing.complete import write_completion
from gscompleter.system.files.image import read_image
from gscompleter.system.files.unfinished import UNFINISHED_PREFIX


def test_both_targets_are_completed_and_shown_before_and_after(tmp_path, monkeypatch, capsys):
    height, width = 32, 48
    monkeypatch.setattr(demo, "DEMO_SIZE", (height, width))
    out = tmp_path / "demo"
    assert run(monkeypatch, "demo", "--out", out) == 0
    printed = capsys.readouterr()
    assert f"written to {out / 'completion'}" in " ".join(printed.err.split())
    assert UNFINISHED_PREFIX not in printed.out + printed.err
    summary = json.loads((out / "completion" / "summary.json").read_text())
    assert len(summary["targets"]) == 2
    assert summary["gaussians"]["added"] > 0
    assert summary["settings"]["folder"] == str(out / "scene")
    images = read_image(out / "before_after.png")
    assert images.shape[0] == height
    assert images.shape[1] >= 4 * width
    texts = [path for path in out.rglob("*") if path.suffix in (".json", ".html", ".csv")]
    assert len(texts) > 3
    assert not [path for path in texts if UNFINISHED_PREFIX in path.read_text()]


def test_a_demo_that_fails_says_so(tmp_path, monkeypatch, capsys):
    def fail(folder, ready):
        summary = write_completion(folder, ready)
        summary["outcome"] |= {"status": "not-reconstructed", "headline": "There is no scene."}
        (folder / "summary.json").write_text(json.dumps(summary))
        return summary

    monkeypatch.setattr(demo, "DEMO_SIZE", (32, 48))
    monkeypatch.setattr(demo, "write_completion", fail)
    assert run(monkeypatch, "demo", "--out", tmp_path / "demo", "--quiet") == 1
    assert "There is no scene." in capsys.readouterr().err
