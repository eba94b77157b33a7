"""Who made a splat is known after every conversion, and forgotten when a completion is undone."""

import json
from dataclasses import replace

import plyfile
import pytest
import torch
from gsply import plyread

from command import run
from gscompleter import InputError, load_ply, load_splat, save_ply, save_splat
from gscompleter.splats.formats import read_provenance
from gscompleter.splats.labels_file import get_labels_path
from gscompleter.splats.layout import save_like, strip
from gscompleter.splats.provenance import (
    MAX_NOTE_LENGTH,
    SCHEMA,
    ModelRecord,
    Provenance,
    RunRecord,
    shorten,
)
from scenes import random_gaussians
from splat_files import plausible

OURS = ModelRecord("plane-sweep", None, "Apache-2.0")
PHI = ModelRecord("flux2-klein", "black-forest-labs/FLUX.2-klein-4B@e7b7", "Apache-2.0")
FIRST = RunRecord("gscompleter", "0.1.0", (1, 2), OURS, None, PHI, None, 7, "ab" * 32)
SECOND = RunRecord("another tool", "3", (3, 3), painter="José ☃\ncomment x", seed=0)
RECORD = Provenance((FIRST, SECOND))
NAMES = ("a.ply", "a.compressed.ply", "a.spz", "a.splat", "a.sog", "a.glb", "a.usda", "a.usdz")
WITHIN = ("a.sog", "a.glb", "a.ply", "a.usda", "a.usdz")
"""Files that hold their labels."""


def labelled(count: int = 60, degree: int = 0):
    labels = (torch.arange(count) % 4).to(torch.uint8)
    return replace(plausible(count, degree), generated=labels)


@pytest.mark.parametrize("name", NAMES)
def test_who_made_a_splat_is_in_every_format(tmp_path, name):
    if ".usd" in name:
        pytest.importorskip("pxr", reason="needs usd-core (the extra usd)")
    save_splat(tmp_path / name, labelled(), RECORD)
    assert get_labels_path(tmp_path / name).exists() == (name not in WITHIN)
    assert read_provenance(tmp_path / name) == RECORD
    assert load_splat(tmp_path / name).generated.bincount().tolist() == [15] * 4
    # A splat of which nobody says anything has no record, and none of an earlier file.
    save_splat(tmp_path / name, plausible(9, 0))
    assert read_provenance(tmp_path / name).runs == ()
    assert not get_labels_path(tmp_path / name).exists()


def test_it_is_where_programs_of_others_look(tmp_path):
    for name in ("a.ply", "a.glb", "a.spz"):
        save_splat(tmp_path / name, labelled(), RECORD)
    comments = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"].comments
    assert [comment.split()[0] for comment in comments] == [SCHEMA, SCHEMA]
    assert json.loads(comments[0].split(maxsplit=1)[1])["generator"]["name"] == "flux2-klein"
    assert len(plyread(str(tmp_path / "a.ply")).means) == 60
    data = (tmp_path / "a.glb").read_bytes()
    size = int.from_bytes(data[12:16], "little")
    asset = json.loads(data[20 : 20 + size])["asset"]
    assert asset["extras"]["provenance"]["schema"] == SCHEMA
    beside = json.loads(get_labels_path(tmp_path / "a.spz").read_text())
    assert beside["provenance"]["runs"][1]["painter"] == SECOND.painter


def test_openusd_has_it_as_custom_layer_data(tmp_path):
    pxr = pytest.importorskip("pxr.Usd", reason="needs usd-core (the extra usd)")
    save_splat(tmp_path / "a.usdc", labelled(), RECORD)
    stage = pxr.Stage.Open(str(tmp_path / "a.usdc"))
    table = json.loads(stage.GetRootLayer().customLayerData["provenance"])
    assert table == json.loads(json.dumps(RECORD.to_json()))
    assert list(stage.GetDefaultPrim().GetAttribute("generated").Get())[:5] == [0, 1, 2, 3, 0]


def test_the_rest_of_a_file_is_the_same_with_a_record(tmp_path):
    save_ply(tmp_path / "a.ply", labelled())
    save_ply(tmp_path / "b.ply", labelled(), made_by=RECORD)
    plain = (tmp_path / "a.ply").read_bytes()
    lines = (tmp_path / "b.ply").read_bytes().split(b"\n", 40)
    ours = [line for line in lines[:-1] if SCHEMA.encode() in line]
    assert len(ours) == 2
    assert b"\n".join(line for line in lines if line not in ours) == plain


def test_convert_carries_the_record_and_plain_drops_it(tmp_path, monkeypatch):
    save_splat(tmp_path / "a.ply", labelled(), RECORD)
    path = tmp_path / "a.ply"
    for name in ("b.spz", "c.sog", "d.glb", "e.compressed.ply", "f.ply"):
        assert run(monkeypatch, "convert", path, tmp_path / name, "--quiet") == 0
        path = tmp_path / name
        assert read_provenance(path) == RECORD, name
    assert run(monkeypatch, "convert", path, tmp_path / "g.ply", "--plain", "--quiet") == 0
    assert b"comment" not in (tmp_path / "g.ply").read_bytes()[:2000]


@pytest.mark.parametrize("name", NAMES)
def test_who_made_a_splat_is_known_where_nothing_in_it_was_invented(tmp_path, name, monkeypatch):
    """Keep a record without labels: what was invented may be cut out, or only photographs added."""
    if ".usd" in name:
        pytest.importorskip("pxr", reason="needs usd-core (the extra usd)")
    save_splat(tmp_path / "given.ply", plausible(9, 0), RECORD)
    out = tmp_path / name.replace("a.", "b.")
    assert run(monkeypatch, "convert", tmp_path / "given.ply", out, "--quiet") == 0
    assert read_provenance(out) == RECORD
    assert not load_splat(out).generated.any()
    assert run(monkeypatch, "convert", out, tmp_path / "again.ply", "--quiet") == 0
    assert read_provenance(tmp_path / "again.ply") == RECORD
    save_splat(out, plausible(9, 0))
    assert not get_labels_path(out).exists()


def test_a_damaged_file_beside_a_splat_is_named_and_not_the_splat(tmp_path):
    path = tmp_path / "a.splat"
    save_splat(path, plausible(9, 0))
    get_labels_path(path).write_text("[1]")
    with pytest.raises(InputError, match=r"a\.splat\.generated\.json does not hold the labels"):
        read_provenance(path)


@pytest.mark.parametrize("ending", [b"\n", b"\r\n"])
def test_strip_forgets_who_completed_a_splat(tmp_path, ending):
    """Two runs, with a comment of their form that the user's file had before."""
    save_ply(tmp_path / "given.ply", random_gaussians(30), made_by=Provenance((SECOND,)))
    head, end, rows = (tmp_path / "given.ply").read_bytes().partition(b"end_header\n")
    given = head.replace(b"\n", ending) + end.replace(b"\n", ending) + rows
    (tmp_path / "given.ply").write_bytes(given)
    scene = load_ply(tmp_path / "given.ply")
    new = replace(random_gaussians(5), generated=torch.ones(5, dtype=torch.uint8))
    save_like(tmp_path / "once.ply", scene, new, tmp_path / "given.ply", run=FIRST)
    assert read_provenance(tmp_path / "once.ply").runs == (SECOND, FIRST)
    more = replace(new, generated=new.generated * 2)
    once = load_ply(tmp_path / "once.ply")
    save_like(tmp_path / "twice.ply", once, more, tmp_path / "once.ply", run=SECOND)
    assert read_provenance(tmp_path / "twice.ply").runs == (SECOND, FIRST, SECOND)
    strip(tmp_path / "twice.ply", tmp_path / "stripped.ply")
    assert (tmp_path / "stripped.ply").read_bytes() == given


def test_a_splat_in_another_format_keeps_its_record_when_it_is_completed(tmp_path):
    given = tmp_path / "given.spz"
    save_splat(given, labelled(), Provenance((FIRST,)))
    new = replace(random_gaussians(5), generated=torch.full((5,), 3, dtype=torch.uint8))
    save_like(tmp_path / "completed.ply", load_splat(given), new, given, run=SECOND)
    assert read_provenance(tmp_path / "completed.ply") == RECORD


@pytest.mark.parametrize(
    ("comment", "sentence"),
    [
        (f"{SCHEMA} {{", "is no JSON"),
        (f'{SCHEMA} {{"tool": "x"}}', "is damaged"),
        (
            "gscompleter-provenance/2 {}",
            r"later version of gscompleter \(gscompleter-provenance/2, and .* is read\); update",
        ),
    ],
)
def test_a_damaged_record_is_refused_and_the_splat_is_not(tmp_path, comment, sentence):
    save_ply(tmp_path / "a.ply", random_gaussians(5))
    data = (tmp_path / "a.ply").read_bytes()
    line = f"comment {comment}\nelement".encode()
    (tmp_path / "a.ply").write_bytes(data.replace(b"element", line, 1))
    with pytest.raises(InputError, match=sentence):
        read_provenance(tmp_path / "a.ply")
    assert len(load_splat(tmp_path / "a.ply")) == 5


@pytest.mark.parametrize("table", ["5", '{"provenance": 5}', '{"provenance": {"schema": 1}}'])
def test_a_damaged_record_beside_a_file_is_refused(tmp_path, table):
    save_splat(tmp_path / "a.spz", labelled(), RECORD)
    get_labels_path(tmp_path / "a.spz").write_text(table)
    with pytest.raises(InputError):
        read_provenance(tmp_path / "a.spz")


def test_names_that_users_choose_are_short_enough_for_a_line(tmp_path):
    """Readers of .ply bound the length of a line, ours at 4096 bytes."""
    assert shorten("x" * 500) == "x" * (MAX_NOTE_LENGTH - 1) + "…"
    assert shorten("x" * MAX_NOTE_LENGTH) == "x" * MAX_NOTE_LENGTH
    for character in ("☃", "🦊", "\0", "x"):
        long = shorten(500 * character)
        assert len(long) <= MAX_NOTE_LENGTH
        model = ModelRecord(long, long, long)
        run = RunRecord("gscompleter", "0.1.0", (1, 254), model, model, model, long, 1, "f" * 64)
        save_ply(tmp_path / "a.ply", random_gaussians(5), made_by=Provenance((run,)))
        assert len(load_splat(tmp_path / "a.ply")) == 5
        assert read_provenance(tmp_path / "a.ply").runs == (run,)


def test_names_of_others_that_are_too_long_for_a_line_are_refused(tmp_path):
    """A .ply that is made of the file would have a header that nobody reads."""
    record = replace(RECORD.runs[0], painter="x" * 5000)
    save_splat(tmp_path / "a.spz", labelled(), Provenance((record,)))
    with pytest.raises(InputError, match=r"names that are too long for a \.ply"):
        read_provenance(tmp_path / "a.spz")
