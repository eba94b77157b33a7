"""`complete --scene`: what photographs show and a splat lacks comes from them."""

import json
from pathlib import Path
from statistics import fmean

import numpy as np
import plyfile
import pytest

from command import run
from gscompleter import load_ply, save_ply
from gscompleter.evaluation.verdict.outcome import round_count
from gscompleter.parts import NOT_INVENTED
from scenes import camera_at, photographed, room_without_a_box

SIZE = 96
PLACES = (-0.6, -0.3, 0.0, 0.3, 0.6)
CAMERAS = [camera_at(x, size=SIZE) for x in PLACES]
TARGET = 2
SMALL = ("--far", 20, "--resolution", 64)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    return photographed(tmp_path_factory.mktemp("room"), CAMERAS)


@pytest.fixture(scope="module")
def cut(tmp_path_factory) -> Path:
    """Return a splat of the room without what stands near its middle: a hole at each photograph."""
    path = tmp_path_factory.mktemp("splat") / "cut.ply"
    save_ply(path, room_without_a_box([CAMERAS[index] for index in (0, 2, 4)]))
    return path


def read_summary(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


# `test_update.py` fills from photographs, and `tests/stages/test_add_observed.py` holes beside a
# target.
@pytest.mark.slow
def test_the_generator_invents_only_what_no_photograph_shows(
    room, cut, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    words = ("complete", room, "--scene", cut, "--target", TARGET, *SMALL, "--out", out)
    assert run(monkeypatch, *words) == 0
    summary = read_summary(out)
    counts = summary["gaussians"]
    assert 100 < counts["from_photographs"] <= counts["added"]
    # Every photograph gains: it sees what it showed.
    for row in summary["context"]:
        assert row["psnr_after"] > row["psnr_before"] + 3
    (target,) = summary["targets"]
    assert target["psnr_after"] > target["psnr_before"] + 3
    said = capsys.readouterr().out
    before, after = (
        fmean(row[key] for row in summary["context"]) for key in ("psnr_before", "psnr_after")
    )
    gained = f"4 photographs gain {after - before:.1f} dB, to {after:.1f} dB "
    assert gained in said.splitlines()[0]
    assert f"{round_count(counts['from_photographs'])} Gaussians from photographs, " in said
    assert "none is new to it" not in said
    told = f"{counts['from_photographs']:,} of the added Gaussians come from photographs"
    assert (out / "report.html").read_text().count(told) == 1
    generated = load_ply(out / "completed.ply").generated
    assert int((generated == NOT_INVENTED).sum()) >= counts["from_photographs"]

    back = tmp_path / "back.ply"
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", back, "--quiet") == 0
    assert back.read_bytes() == cut.read_bytes()


@pytest.mark.slow
def test_without_the_generator_there_are_no_targets(room, cut, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    assert run(monkeypatch, "update", room, "--scene", cut, *SMALL, "--out", out) == 0
    summary = read_summary(out)
    assert summary["targets"] == []
    assert summary["gaussians"]["from_photographs"] == summary["gaussians"]["added"] > 100
    assert summary["outcome"]["status"] == "completed"
    printed = capsys.readouterr()
    assert printed.out.startswith("What photographs show and the splat lacked is added")
    assert "show and the splat lacks by plane-sweep on cpu" in printed.err
    rows = plyfile.PlyData.read(str(out / "completed.ply"))["vertex"].data
    assert set(np.unique(rows["generated"])) == {0, NOT_INVENTED}
