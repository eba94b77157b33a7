"""Splats in map coordinates: positions beyond float32 are kept, written again, and told."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import gscompleter as gsc
from command import run
from gscompleter import InputError, load_ply, load_splat, merge, save_ply, save_splat
from gscompleter.apps.inspection import describe_interval
from gscompleter.splats import ply
from gscompleter.splats.conversion import convert_splat
from gscompleter.splats.formats import describe_oddities
from gscompleter.splats.layout import is_same_scene, save_like, save_removed, strip
from gscompleter.splats.origin import format_corners
from gscompleter.splats.transform import HALF_TURN_X, rotate_half_turn, transform_gaussians
from gscompleter.system.files.result_names import REMOVED_FILE
from map_scene import PLACE, small_gaussians, write_map_ply
from scenes import random_gaussians

EXACT = 1e-6
"""Largest error of positions of a few metres in float32, in metres."""


def places_of(gaussians: gsc.Gaussians) -> np.ndarray:
    """Return positions in the coordinates of the file, in float64."""
    return gaussians.means.double().numpy() + np.array(gaussians.origin or (0, 0, 0))


def read_columns(path: Path) -> tuple[str, np.ndarray]:
    """Read the type and the values of the positions of a .ply as they are stored."""
    header, body = path.read_bytes().split(b"end_header\n")
    kinds = {"double": "<f8", "float": "<f4"}
    columns = [line.split()[1:] for line in header.decode().splitlines() if "property" in line]
    dtype = np.dtype([(name, kinds[kind]) for kind, name in columns])
    rows = np.frombuffer(body, dtype)
    kind = next(kind for kind, name in columns if name == "x")
    return kind, np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1)


def test_double_positions_are_read_relative_to_an_origin(tmp_path):
    means = write_map_ply(tmp_path / "map.ply", small_gaussians())
    for load in (load_ply, load_splat):
        loaded = load(tmp_path / "map.ply")
        assert loaded.origin is not None
        assert loaded.means.abs().max() < 10
        assert np.abs(places_of(loaded) - means).max() < EXACT
        assert len(np.unique(loaded.means[:, 1])) == 300
    assert "relative to (50" in str(loaded)


def test_files_near_zero_and_of_floats_stay_as_they_are(tmp_path):
    gaussians = small_gaussians()
    write_map_ply(tmp_path / "near.ply", gaussians, np.zeros(3))
    near = load_splat(tmp_path / "near.ply")
    assert near.origin is None
    assert torch.equal(near.means, gaussians.means)
    write_map_ply(tmp_path / "float.ply", gaussians, kind="float")
    assert load_splat(tmp_path / "float.ply").origin is None
    (line,) = describe_oddities(tmp_path / "float.ply")
    assert "floats in steps of 0.5" in line
    # Large Gaussians are not hurt.
    write_map_ply(tmp_path / "large.ply", replace(gaussians, scales=gaussians.scales * 1e4))
    assert load_splat(tmp_path / "large.ply").origin is None


def test_tiny_gaussians_near_zero_have_no_origin(tmp_path):
    """Their positions are rounded, and nothing that could be taken off helps."""
    gaussians = small_gaussians()
    tiny = replace(gaussians, means=0.05 * gaussians.means, scales=1e-6 * gaussians.scales)
    write_map_ply(tmp_path / "tiny.ply", tiny, np.zeros(3))
    assert load_splat(tmp_path / "tiny.ply").origin is None
    assert describe_oddities(tmp_path / "tiny.ply") == []
    assert convert_splat(tmp_path / "tiny.ply", tmp_path / "tiny.spz").notes == ()


def test_of_a_large_file_a_sample_tells(tmp_path, monkeypatch):
    means = write_map_ply(tmp_path / "map.ply", small_gaussians())
    whole = load_splat(tmp_path / "map.ply")
    monkeypatch.setattr(ply, "SAMPLE_BLOCKS", 10)
    monkeypatch.setattr(ply, "SAMPLE_ROWS", 5)
    assert len(ply.sample_rows(ply.read_scene(tmp_path / "map.ply").rows)) == 50
    loaded = load_splat(tmp_path / "map.ply")
    assert np.abs(np.array(loaded.origin) - np.array(whole.origin)).max() <= 1
    assert np.abs(places_of(loaded) - means).max() < EXACT


def test_texts_keep_their_digits(tmp_path):
    gaussians = small_gaussians(150)
    means = write_map_ply(tmp_path / "map.ply", gaussians)
    save_ply(tmp_path / "plain.ply", gaussians)
    names, body = (tmp_path / "plain.ply").read_bytes().split(b"end_header\n")
    table = np.frombuffer(body, "<f4").reshape(150, -1).astype(np.float64)
    table[:, :3] = means
    text = "\n".join(" ".join(map(repr, row)) for row in table.tolist())
    ascii_header = names.replace(b"binary_little_endian", b"ascii")
    (tmp_path / "ascii.ply").write_bytes(ascii_header + b"end_header\n" + text.encode() + b"\n")
    loaded = load_splat(tmp_path / "ascii.ply")
    assert np.abs(places_of(loaded) - means).max() < EXACT


def test_doubles_are_written_as_doubles(tmp_path):
    means = write_map_ply(tmp_path / "map.ply", small_gaussians())
    save_ply(tmp_path / "a.ply", load_splat(tmp_path / "map.ply"))
    save_splat(tmp_path / "b.ply", load_splat(tmp_path / "map.ply"))
    convert_splat(tmp_path / "map.ply", tmp_path / "c.ply")
    for name in "abc":
        kind, written = read_columns(tmp_path / f"{name}.ply")
        assert kind == "double"
        assert np.abs(written - means).max() < EXACT
    assert is_same_scene(tmp_path / "map.ply", tmp_path / "map.ply")
    save_ply(tmp_path / "near.ply", small_gaussians())
    assert read_columns(tmp_path / "near.ply")[0] == "float"


@pytest.mark.parametrize("name", ["a.glb", "a.usda", "a.usdz"])
def test_formats_of_nodes_keep_the_origin(tmp_path, name):
    if name != "a.glb":
        pytest.importorskip("pxr")
    means = write_map_ply(tmp_path / "map.ply", small_gaussians())
    assert convert_splat(tmp_path / "map.ply", tmp_path / name).notes == ()
    loaded = load_splat(tmp_path / name)
    assert np.abs(places_of(loaded) - means).max() < EXACT
    convert_splat(tmp_path / name, tmp_path / "back.ply")
    kind, written = read_columns(tmp_path / "back.ply")
    assert kind == "double"
    assert np.abs(written - means).max() < EXACT


@pytest.mark.parametrize("name", ["a.spz", "a.splat", "a.sog", "a.compressed.ply"])
def test_formats_that_round_say_by_how_much(tmp_path, name):
    means = write_map_ply(tmp_path / "map.ply", small_gaussians())
    (note,) = convert_splat(tmp_path / "map.ply", tmp_path / name).notes
    rounding = float(note.partition("largest rounding of a position is ")[2].partition(";")[0])
    loaded = places_of(load_splat(tmp_path / name))
    assert 0.1 < rounding < 10
    # No Gaussian of the file is farther from all places of the scene than the line says.
    nearest = np.linalg.norm(loaded[:, None] - means[None], axis=2).min(axis=1)
    assert nearest.max() <= 1.01 * rounding


def test_near_scenes_have_no_line_on_rounding(tmp_path):
    save_ply(tmp_path / "a.ply", random_gaussians(20))
    assert convert_splat(tmp_path / "a.ply", tmp_path / "a.spz").notes == ()


# Values with an origin.


def test_an_origin_stays_with_its_gaussians_and_is_moved_exactly():
    gaussians = replace(small_gaussians(), origin=(500000.0, 4649776.0, 300.0))
    places = places_of(gaussians)
    assert gaussians[:5].origin == gaussians.to("cpu").origin == gaussians.origin
    moved = gaussians.move_origin((500010.0, 4649770.0, 300.0))
    assert np.abs(places_of(moved) - places).max() < 1e-5
    assert gaussians.move_origin(gaussians.origin) is gaussians
    assert gaussians.move_origin(None).origin is None


def test_merged_gaussians_have_one_origin():
    first = replace(small_gaussians(), origin=(500000.0, 4649776.0, 300.0))
    other = first.move_origin((500010.0, 4649770.0, 290.0))
    added = small_gaussians(20, seed=1)
    merged = merge([first[:100], other[100:], added])
    assert merged.origin == first.origin
    assert np.abs(places_of(merged)[:300] - places_of(first)).max() < 1e-5
    # What was made for a scene is in its frame.
    assert torch.equal(merged.means[300:], added.means)
    assert merge([added, first]).origin == first.origin


def test_turns_of_the_file_turn_the_origin():
    gaussians = replace(small_gaussians(), origin=(500000.0, 4649776.0, 300.0))
    turned = rotate_half_turn(gaussians, HALF_TURN_X)
    assert turned.origin == (500000.0, -4649776.0, -300.0)
    similarity = torch.tensor([[0.0, -2, 0, 5], [2, 0, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]])
    moved = places_of(transform_gaussians(gaussians, similarity))
    expected = places_of(gaussians) @ similarity[:3, :3].double().numpy().T + np.array([5, 0, 0])
    assert np.abs(moved - expected).max() < 1e-4


def test_an_origin_that_is_none_is_refused():
    for wrong in ((1.0, 2.0), (1.0, 2.0, float("nan")), [1.0, 2.0, 3.0]):
        with pytest.raises((InputError, TypeError)):
            replace(small_gaussians(5), origin=wrong)


# Completed in its own file.


def test_a_map_is_completed_in_its_file_and_stripped_byte_for_byte(tmp_path):
    write_map_ply(tmp_path / "map.ply", small_gaussians())
    context = load_splat(tmp_path / "map.ply")
    added = replace(small_gaussians(40, seed=1), generated=torch.full((40,), 1, dtype=torch.uint8))
    folder = tmp_path / "OUT"
    folder.mkdir()
    changed = torch.zeros(300, dtype=torch.bool)
    changed[[3, 77]] = True
    rows = changed.nonzero()[:, 0]
    save_removed(folder / REMOVED_FILE, context[rows], rows, tmp_path / "map.ply")
    order = (~changed).nonzero()[:, 0]
    save_like(
        folder / "completed.ply", context, added, tmp_path / "map.ply", kept=~changed, order=order
    )
    kind, written = read_columns(folder / "completed.ply")
    assert kind == "double"
    expected = added.means.double().numpy() + np.array(context.origin)
    assert np.abs(written[298:] - expected).max() < EXACT
    strip(folder / "completed.ply", tmp_path / "back.ply")
    assert (tmp_path / "back.ply").read_bytes() == (tmp_path / "map.ply").read_bytes()


# Commands.


def test_inspect_prints_digits_that_tell_the_ends_apart(tmp_path, monkeypatch, capsys):
    means = write_map_ply(tmp_path / "map.ply", small_gaussians())
    assert run(monkeypatch, "inspect", str(tmp_path / "map.ply"), "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert np.abs(np.array(found["extent"])[:, 0] - means.min(0)).max() < EXACT
    assert np.abs(np.array(found["extent"])[:, 1] - means.max(0)).max() < EXACT
    assert any("is read relative to (50" in note for note in found["notes"])
    assert describe_interval(4649775.512, 4649777.489) == "4649775.512 to 4649777.489"
    assert describe_interval(-1.25, 2.5) == "-1.25 to 2.5"
    assert describe_interval(0.0, 0.0) == "0 to 0"


def test_corners_have_digits_that_tell_their_sides():
    corners = format_corners((499999.5, 4649775.5, 303.0), (500000.5, 4649776.5, 306.0))
    assert corners == ("499999.5 4649775.5 303", "500000.5 4649776.5 306")
    assert format_corners((-0.5, 0.0, 1.0), (0.5, 0.0, 1234.5)) == ("-0.5 0 1", "0.5 0 1234.5")


def test_convert_says_how_far_it_rounds(tmp_path, monkeypatch, capsys):
    write_map_ply(tmp_path / "map.ply", small_gaussians())
    assert run(monkeypatch, "convert", str(tmp_path / "map.ply"), str(tmp_path / "a.splat")) == 0
    said = capsys.readouterr().out
    assert "A .splat file cannot hold coordinates this large: the largest rounding" in said
    assert PLACE[1] > 4e6
