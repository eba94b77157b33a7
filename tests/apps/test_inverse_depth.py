"""Inverse depth beside a COLMAP model, as 3DGS is regularised by: how far it is believed."""

import json

import numpy as np
import pytest

from command import run
from exact_room import make_cameras, write_colmap
from gscompleter.apps.inputs.given_depth import MAX_DEPTH_DEVIATION, read_with_depth
from gscompleter.apps.report.schema import read_summary
from gscompleter.data.formats import open_photographs
from gscompleter.splats.formats import read_provenance
from gscompleter.splats.provenance import ModelRecord
from inverse_depth import write_inverse_depth

CAMERAS = make_cameras(4, width=96, height=72, focal=78.0)
TILT = 1 + 0.5 * np.linspace(-1, 1, 96)[None]
"""Factor that makes a map wrong by up to half, on both sides."""


@pytest.fixture
def scene(tmp_path):
    """Write a COLMAP model whose photograph 2 has a map that contradicts its points."""
    model = write_colmap(tmp_path / "room", CAMERAS, n_points=600)
    return write_inverse_depth(model, CAMERAS, {2: TILT})


def test_inverse_depth_that_agrees_with_points_is_measured_depth(scene):
    photographs = open_photographs(scene)
    read = read_with_depth(photographs, (0, 1))
    assert not read.predicted
    for view, camera in zip(read.views, CAMERAS, strict=False):
        known = view.given_depth.numpy() > 0
        assert known.mean() > 0.8
        off = np.abs(view.given_depth.numpy() / camera.depth - 1)[known]
        assert np.median(off) < MAX_DEPTH_DEVIATION / 3
    (note,) = read.notes
    assert note.startswith("The inverse depth of photo_000.png, photo_001.png agrees")


def test_inverse_depth_that_deviates_from_points_only_supports_stereo(scene):
    read = read_with_depth(open_photographs(scene), (1, 2))
    assert set(read.predicted) == {2}
    shares = [(view.given_depth > 0).float().mean().item() for view in read.views]
    assert shares[0] > 0.8
    assert shares[1] < 0.1  # the points alone
    assert "photo_002.png deviates by up to" in read.notes[1]
    assert "only where stereo measures nothing" in read.notes[1]


@pytest.mark.slow
def test_the_command_says_what_it_thinks_of_the_maps(scene, tmp_path, monkeypatch, capsys):
    words = ["complete", scene, "--context", 1, 2, "--target", 3, "--resolution", 36, 48]
    assert run(monkeypatch, *words, "--dry-run", "--out", tmp_path / "out") == 0
    said = capsys.readouterr()
    assert "4 of 4 photographs have inverse depth of 3DGS" in said.err
    assert "photo_001.png agrees with the points of the scene" in said.err


# The plan before says the same of the maps, and `test_given_depth.py` completes with depth.
@pytest.mark.slow
def test_the_command_uses_the_maps_or_says_why_not(scene, tmp_path, monkeypatch, capsys):
    words = ["complete", scene, "--context", 1, 2, "--target", 3, "--resolution", 72, 96]
    assert run(monkeypatch, *words, "--out", tmp_path / "out") == 0
    said = capsys.readouterr()
    assert "4 of 4 photographs have inverse depth of 3DGS" in said.err
    assert "photo_001.png agrees with the points of the scene" in said.err
    # Of photograph 2: used, or why not.
    notes = json.loads((tmp_path / "out" / "summary.json").read_text())["context_notes"]
    assert any("predicted depth is" in note for note in notes)
    rows = read_summary(tmp_path / "out").context
    assert rows[0].given_depth > 0.8
    # The record names maps that supported stereo, which no option does.
    (made,) = read_provenance(tmp_path / "out" / "completed.ply").runs
    assert made.depth == ModelRecord("StoredDepth")
    assert run(monkeypatch, *words, "--no-given-depth", "--out", tmp_path / "without") == 0
    assert [row.given_depth for row in read_summary(tmp_path / "without").context] == [0, 0]
