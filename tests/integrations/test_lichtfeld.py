"""The plug-in of LichtFeld Studio, in a stand-in of its interface; gscompleter itself is real."""

from __future__ import annotations

import importlib
import json
import shlex
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import gscompleter as gsc
import stand_in_lichtfeld
from command import run
from gscompleter.data.scene import load_cameras
from gscompleter.numerics.geometry import look_up
from gscompleter.splats.edits import read_edits
from paths import ROOT
from scenes import Room, camera_at, gaussians_of, photographed, view_of

PACKAGE = ROOT / "integrations" / "lichtfeld"
SIZE = 64
CAMERA = camera_at(0.02, size=SIZE)
SPOT = (slice(26, 38), slice(30, 44))
# The plug-in takes variables of Python out of the environment, so that the sources are named.
SOURCES = shlex.quote(f"PYTHONPATH={ROOT / 'src'}")
COMMAND = f"env {SOURCES} {shlex.quote(sys.executable)} -m gscompleter"
TURN = np.array([[0.0, -2.0, 0.0, 1.0], [2.0, 0.0, 0.0, -3.0], [0.0, 0.0, 2.0, 0.5], [0, 0, 0, 1]])
"""A rotation about z with a scale of 2, and a shift."""


@pytest.fixture
def lf(monkeypatch):
    """Return the module `lichtfeld` of a program without a scene."""
    module = stand_in_lichtfeld.make_module()
    monkeypatch.setitem(sys.modules, "lichtfeld", module)
    return module


@pytest.fixture
def plugin(lf, monkeypatch):
    """Import the plug-in as the program does: a package by the name of its folder."""
    monkeypatch.syspath_prepend(str(PACKAGE.parent))
    for name in [name for name in sys.modules if name.split(".")[0] == "lichtfeld_heal"]:
        monkeypatch.delitem(sys.modules, name)
    spec = importlib.util.spec_from_file_location(
        "lichtfeld_heal", PACKAGE / "__init__.py", submodule_search_locations=[str(PACKAGE)]
    )
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "lichtfeld_heal", module)
    spec.loader.exec_module(module)
    yield module
    for name in [name for name in sys.modules if name.startswith("lichtfeld_heal.")]:
        del sys.modules[name]


@pytest.fixture(scope="module")
def splat(tmp_path_factory) -> Path:
    """Return a splat of one photograph of a room."""
    path = tmp_path_factory.mktemp("lichtfeld") / "room.ply"
    gsc.save_ply(path, gaussians_of(view_of(Room(), camera_at(size=SIZE))))
    return path


def part(plugin, name):
    """Import a module of the plug-in."""
    return importlib.import_module(f"{plugin.__name__}.{name}")


def load(lf, plugin, path, transform=None):
    """Load a splat as the program does, and stand where `CAMERA` is."""
    rows = part(plugin, "rows").read_splat(path).rows
    part(plugin, "scene").add_splat(lf.shown_scene, "room", rows)
    lf.undo._steps.clear()
    (node,) = lf.shown_scene.tree
    lf.sources["room"] = str(path)
    if transform is not None:
        node.transform = transform
    stand_at(lf, CAMERA, node.transform)
    return node


def stand_at(lf, camera, transform):
    """Move the viewport to a camera of a file, which the transform of a node moved with it."""
    c2w = transform @ camera.c2w.double().numpy()
    rotation = c2w[:3, :3] / np.cbrt(np.linalg.det(c2w[:3, :3]))
    flip = stand_in_lichtfeld.FLIP
    # From axes of OpenCV in the world of the data to those of OpenGL in the visualizer's.
    turned = lf.Tensor((flip @ rotation @ flip).astype(np.float32), "cuda")
    moved = lf.Tensor((flip @ c2w[:3, 3]).astype(np.float32), "cuda")
    fov = 2 * np.degrees(np.arctan(camera.height / 2 / camera.K[1, 1].item()))
    lf.view = lf.ViewInfo(turned, moved, camera.width, camera.height, fov)


def select_spot(lf, path):
    """Select the Gaussians that a rectangle of the image shows; returns which."""
    given = gsc.load_ply(path)
    mark = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    mark[SPOT] = True
    chosen = look_up(mark, given, CAMERA).numpy()
    total = sum(node.data.num_points for node in lf.shown_scene.tree)
    mask = np.zeros(total, bool)
    mask[: len(chosen)] = chosen
    lf.shown_scene.set_selection_mask(lf.Tensor(mask))
    return chosen


def collect_visible(plugin, lf):
    """Return the rows that are visible, of all nodes, in no order."""
    scene = part(plugin, "scene")
    data = [node.data for node in lf.shown_scene.tree]
    rows = [scene.collect_rows(part)[~scene.read_deleted(part)] for part in data]
    return sorted(row.tobytes() for row in np.concatenate(rows))


def test_the_program_loads_and_unloads_it(lf, plugin):
    plugin.on_load()
    (panel,) = lf.classes
    assert panel.space is lf.ui.PanelSpace.MAIN_PANEL_TAB
    plugin.on_unload()
    assert lf.classes == []


def test_its_manifest_has_what_the_program_requires():
    tomllib = pytest.importorskip("tomllib", reason="needs Python 3.11")
    manifest = tomllib.loads((PACKAGE / "pyproject.toml").read_text())
    assert {"name", "version", "description"} <= manifest["project"].keys()
    assert manifest["project"]["version"] == gsc.__version__
    keys = {"hot_reload", "plugin_api", "lichtfeld_version", "required_features"}
    assert manifest["tool"]["lichtfeld"].keys() == keys


@pytest.mark.parametrize("transform", [None, TURN], ids=["as loaded", "moved"])
def test_the_camera_and_the_selection_are_those_of_the_file(lf, plugin, splat, tmp_path, transform):
    load(lf, plugin, splat, transform)
    chosen = select_spot(lf, splat)
    session = part(plugin, "session")
    sent = session.Session(tmp_path / "work").send(session.Request("repair"))
    words = dict(zip(sent.words[1::2], sent.words[2::2], strict=True))
    # What is loaded is the file itself, with its own bytes.
    assert words["--scene"] == str(splat)
    selected = gsc.load_ply(words["--select"])
    assert torch.equal(selected.means, gsc.load_ply(splat).means[torch.from_numpy(chosen)])
    (camera,) = load_cameras(words["--target"])
    assert (camera.c2w - CAMERA.c2w).abs().max() < 1e-5
    assert (camera.K - CAMERA.K).abs().max() < 1e-3 * CAMERA.K.max()


def test_a_heal_is_a_layer_that_undo_takes_away(lf, plugin, splat, tmp_path, monkeypatch):
    node = load(lf, plugin, splat, TURN)
    before = collect_visible(plugin, lf)
    select_spot(lf, splat)
    session = part(plugin, "session")
    work = session.Session(tmp_path / "work")
    sent = work.send(session.Request("repair"))
    assert run(monkeypatch, *sent.words, "--quiet") == 0
    name = work.receive(sent)

    # What is visible is what the command wrote, bit for bit, and the rest is hidden, not gone.
    after = collect_visible(plugin, lf)
    written = part(plugin, "rows").read_splat(sent.out / "completed.ply")
    assert after == sorted(row.tobytes() for row in written.rows)
    layer = lf.shown_scene.get_node(name)
    assert layer.data.num_points == written.labels.astype(bool).sum()
    assert np.allclose(layer.transform, TURN)
    assert node.data.num_points == len(before)
    assert not lf.shown_scene.has_selection()

    assert lf.undo.undo_names() == ["gscompleter: repair"]
    lf.undo.undo()
    assert collect_visible(plugin, lf) == before
    assert lf.shown_scene.get_node(name) is None
    lf.undo.redo()
    assert collect_visible(plugin, lf) == after

    # The next one goes on with the file of the first, and so with its record.
    is_new = np.repeat([False, True], [node.data.num_points, layer.data.num_points])
    lf.shown_scene.set_selection_mask(lf.Tensor(is_new))
    again = work.send(session.Request("repair"))
    assert again.words[again.words.index("--scene") + 1] == str(sent.out / "completed.ply")

    # If the user changed something since, the record and the labels go with what is shown.
    mask = np.zeros(layer.data.num_points, bool)
    mask[0] = True
    layer.data.soft_delete(lf.Tensor(mask, "cuda"))
    changed = work.send(session.Request("repair"))
    file = Path(changed.words[changed.words.index("--scene") + 1])
    assert file.parent.parent == tmp_path / "work"
    edits = read_edits(file)
    assert [edit.command for edit in edits.edits] == ["repair"]
    assert not edits.is_unchanged
    kept = gsc.load_ply(file)
    assert (kept.generated > 0).sum() == len(mask) - 1
    assert b"gscompleter" in file.read_bytes().partition(b"end_header")[0]


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda lf: lf.shown_scene.clear_selection(), "Nothing is selected"),
        (lambda lf: lf.shown_scene.tree.clear(), "No splat is visible"),
        (lambda lf: setattr(lf, "shown_scene", None), "No scene is open"),
        (lambda lf: setattr(lf, "view", None), "no viewport"),
        (lambda lf: setattr(lf.view, "orthographic", True), "orthographic"),
        (
            lambda lf: setattr(lf.shown_scene.tree[0], "transform", np.diag([1.0, 2, 1, 1])),
            "stretched or mirrored",
        ),
        (
            lambda lf: lf.shown_scene.set_selection_mask(lf.Tensor(np.ones(7, bool))),
            "counts 7 Gaussians",
        ),
    ],
)
def test_what_is_missing_is_a_sentence(lf, plugin, splat, tmp_path, spoil, sentence):
    load(lf, plugin, splat)
    select_spot(lf, splat)
    spoil(lf)
    session = part(plugin, "session")
    with pytest.raises(part(plugin, "scene").HealError, match=sentence):
        session.Session(tmp_path).send(session.Request("repair"))


def test_a_data_set_that_was_centred_is_not_where_its_files_say(lf, plugin, tmp_path):
    session = part(plugin, "session")
    lf.params.data_path = str(tmp_path)
    assert session.find_photographs() == str(tmp_path)
    lf.params.centralize_dataset = "by_cameras"
    assert session.find_photographs() == ""


def test_the_photographs_of_the_data_set_are_evidence(lf, plugin, splat, tmp_path):
    scene = photographed(tmp_path / "scene", [replace(CAMERA, near=None, far=None)])
    lf.params.data_path = str(scene)
    load(lf, plugin, splat)
    select_spot(lf, splat)
    session = part(plugin, "session")
    request = session.Request("remove", session.find_photographs(), sees_from_here=False)
    words = session.Session(tmp_path / "work").send(request).words
    assert words[:4] == ("remove", str(scene), "--scene", str(splat))
    assert "--target" not in words


def test_rows_are_compared_by_their_bytes_and_counted(plugin):
    rows = part(plugin, "rows")
    before = np.array([[0.0], [1.0], [1.0], [2.0]], np.float32)
    after = np.array([[1.0], [3.0], [0.0]], np.float32)
    went, came = rows.compare_rows(before, after)
    assert went.tolist() == [False, False, True, True]
    assert came.tolist() == [False, True, False]
    # Channel by channel: the second coefficient of each is new.
    narrow = np.arange(17, dtype=np.float32)[None]
    wide = rows.widen_harmonics(narrow, 6)[0].tolist()
    assert wide == [0, 1, 2, 3, 4, 5, 6, 0, 7, 0, 8, 0, *range(9, 17)]


def press(plugin, lf, *labels):
    """Draw the panel with buttons pressed; returns what it says."""
    ui = stand_in_lichtfeld.Ui(*labels)
    part(plugin, "panel").HealPanel().draw(ui)
    return ui.texts


def test_a_command_that_is_missing_is_told(lf, plugin, splat):
    load(lf, plugin, splat)
    select_spot(lf, splat)
    part(plugin, "panel").STATE.command = "no-such-program"
    press(plugin, lf, "Repair")
    assert any("gscompleter was not found" in text for text in press(plugin, lf))
    assert lf.log.lines[-1][0] == "error"


def wait(plugin):
    """Wait until the program that the panel started has ended, and take its result."""
    panel = part(plugin, "panel")
    lines = set()
    while panel.STATE.job is not None:
        lines.add(panel.STATE.job.line)
        panel.HealPanel().on_update(None)
        time.sleep(0.05)
    return lines


@pytest.mark.slow
def test_an_error_of_the_command_is_the_message(lf, plugin, splat, tmp_path):
    load(lf, plugin, splat)
    select_spot(lf, splat)
    state = part(plugin, "panel").STATE
    state.command = COMMAND
    state.photographs = str(tmp_path / "nowhere")
    press(plugin, lf, "Repair")
    wait(plugin)
    assert "nowhere" in state.message
    assert state.is_error
    assert [node.name for node in lf.shown_scene.tree] == ["room"]


@pytest.mark.slow
def test_the_panel_runs_the_program_and_shows_its_progress(lf, plugin, splat):
    load(lf, plugin, splat)
    select_spot(lf, splat)
    state = part(plugin, "panel").STATE
    state.command = COMMAND
    press(plugin, lf, "Repair")
    assert "Cancel" in press(plugin, lf)
    lines = wait(plugin)
    assert len(lines) > 2
    assert not state.is_error, state.message
    assert "room repair" in state.message
    assert [node.name for node in lf.shown_scene.tree] == ["room", "room repair"]
    summary = json.loads((state.session.folder / "001" / "result" / "summary.json").read_text())
    assert summary["targets"][0]["added"] > 0
