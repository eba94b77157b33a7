"""Each row of the table of formats keeps its promise, and has a line in the reference page."""

import json
import random
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

from damage import require_plain
from fuzz import damage, replaced
from gscompleter import Gaussians, InputError, load_splat, save_splat
from gscompleter.splats import table
from gscompleter.splats.formats import describe_losses, read_provenance
from gscompleter.splats.glb import write_glb
from gscompleter.splats.labels_file import get_labels_path
from gscompleter.splats.packing import ZIP_MAGIC, build_gaussians
from gscompleter.splats.provenance import NOTHING_KNOWN, Provenance, RunRecord
from gscompleter.splats.splat_format import HEAD_BYTES, SplatFormat
from gscompleter.splats.table import SPLAT_FORMATS, get_written_format, match_ending
from gscompleter.system.damage import DamagedError
from paths import ROOT
from splat_files import BY_HAND, made, plausible, read_parts, write_parts


class Promise(NamedTuple):
    """A file of a format, and the largest errors of what is read from it."""

    file: str
    position: float
    """Relative to the largest coordinate."""
    size: float
    """Of the logarithm."""
    opacity: float


PROMISES = {
    "ply": Promise("scene.ply", 0, 0, 1e-6),
    "compressed-ply": Promise("scene.compressed.ply", 1e-3, 2e-3, 2e-3),
    "spz": Promise("scene.spz", 1e-5, 0.032, 2e-3),
    "usd": Promise("scene.usdc", 0, 0, 0),
    "usdz": Promise("scene.usdz", 0, 0, 0),
    "sog": Promise("written.sog", 1e-4, 0.01, 2e-3),
    "sog-folder": Promise("folder", 1e-4, 0.04, 2e-3),
    "glb": Promise("written.glb", 0, 0, 0),
    "splat": Promise("scene.splat", 0, 0, 2e-3),
    "ksplat": Promise("scene.ksplat", 1e-3, 1e-3, 2e-3),
}
"""What each format keeps, by the name of its row."""


def get_promise(name: str) -> Promise:
    assert name in PROMISES, f"add to PROMISES a file and the largest errors of {name}"
    if SPLAT_FORMATS[name].extra:
        pytest.importorskip("pxr", reason="needs usd-core (the extra usd)")
    return PROMISES[name]


def test_every_format_has_a_promise():
    missing = sorted(set(SPLAT_FORMATS) - set(PROMISES))
    assert not missing, f"add to PROMISES a file and the largest errors of {missing}"
    assert set(PROMISES) == set(SPLAT_FORMATS)


@pytest.mark.parametrize("name", SPLAT_FORMATS)
def test_a_format_rounds_no_more_than_it_promises(tmp_path, name):
    promise = get_promise(name)
    gaussians = plausible(120, 1 if SPLAT_FORMATS[name].holds_harmonics else 0)
    loaded = load_splat(made(tmp_path, promise.file, gaussians))
    # Some formats have an order of their own.
    given = gaussians[torch.cdist(loaded.means, gaussians.means).argmin(1)]
    largest = gaussians.means.abs().max()
    assert (loaded.means - given.means).abs().max() <= promise.position * largest
    assert (loaded.scales.log() - given.scales.log()).abs().max() <= promise.size
    assert (loaded.opacities - given.opacities).abs().max() <= promise.opacity
    assert len(loaded.means.unique(dim=0)) == 120


@pytest.mark.parametrize("name", SPLAT_FORMATS)
def test_a_format_is_recognised_by_itself_alone(tmp_path, name):
    """So the order of the rows decides nothing, and a renamed file is read as what it is."""
    path = made(tmp_path, get_promise(name).file, plausible(20, 1))
    file = path / "meta.json" if path.is_dir() else path
    head = file.read_bytes()[:HEAD_BYTES]
    recognised = [row.name for row in SPLAT_FORMATS.values() if row.begins(file, head)]
    assert recognised == ([name] if SPLAT_FORMATS[name].starts else [])
    renamed = file.rename(tmp_path / "renamed.dat")
    assert [row.name for row in SPLAT_FORMATS.values() if row.begins(renamed, head)] == recognised


def damage_part(name: str, data: bytes, chance: random.Random, folder: Path) -> bytes:
    """Damage a file of a .zip: a value of JSON, or bytes of it."""
    if name.endswith(".json") and chance.random() < 0.7:
        return json.dumps(replaced(json.loads(data), chance)).encode()
    part = folder / "part"
    part.write_bytes(data)
    damage(part, chance)
    return part.read_bytes()


def list_damaged_parts(row: SplatFormat, parts: dict[str, bytes], folder: Path) -> Iterator[dict]:
    """List the files of a .zip with one of them missing, empty or damaged."""
    chance = random.Random(0)
    for name in parts:
        yield {other: data for other, data in parts.items() if other != name}
        yield {**parts, name: b""}
    # What an extra decodes in C++ may crash within it, as OpenUSD does once in thousands.
    for _ in range(0 if row.extra else 150):
        name = chance.choice(sorted(parts))
        yield {**parts, name: damage_part(name, parts[name], chance, folder)}


@pytest.mark.parametrize("name", [n for n, row in SPLAT_FORMATS.items() if ZIP_MAGIC in row.starts])
def test_a_damaged_part_of_a_zip_is_told_in_a_sentence(tmp_path, name):
    """Checksums are those of the damaged parts: else they alone would find all that is random."""
    promise = get_promise(name)
    path = made(tmp_path, promise.file, plausible(60, 1))
    parts = read_parts(path)
    assert len(load_splat(write_parts(path, parts))) == 60
    refused = 0
    for damaged in list_damaged_parts(SPLAT_FORMATS[name], parts, tmp_path):
        write_parts(path, damaged)
        for read in (load_splat, read_provenance):
            try:
                read(path)
            except InputError as error:
                require_plain(str(error))
                refused += 1
    assert refused > 0


WRITTEN = [name for name, row in SPLAT_FORMATS.items() if row.write is not None]


@pytest.mark.parametrize("name", WRITTEN)
def test_a_row_says_what_its_files_hold(tmp_path, name):
    row = SPLAT_FORMATS[name]
    path = tmp_path / get_promise(name).file
    labels = (torch.arange(30) % 3).to(torch.uint8)
    gaussians = replace(
        plausible(30, 1 if row.holds_harmonics else 0),
        generated=labels,
        is_antialiased=True,
        origin=(500_000.0, 4_000_000.0, 0.0) if row.holds_origin else None,
    )
    record = Provenance((RunRecord("a tool", "1", (1, 2), seed=3),))
    save_splat(path, gaussians, record)
    beside = get_labels_path(path)
    # What a file has no place for, labels or the record, lies beside it.
    holds_both = row.holds_labels and row.read_record is not None
    assert beside.exists() != holds_both, describe_row(row, "holds_labels", "read_record")
    # Without what lies beside it, a file has what its row says.
    beside.unlink(missing_ok=True)
    loaded = load_splat(path)
    assert loaded.generated.any() == row.holds_labels, describe_row(row, "holds_labels")
    assert loaded.is_antialiased == row.marks_antialiased, describe_row(row, "marks_antialiased")
    assert (loaded.origin is not None) == row.holds_origin, describe_row(row, "holds_origin")
    has_record = read_provenance(path) == record
    assert has_record == (row.read_record is not None), describe_row(row, "read_record")


def describe_row(row: SplatFormat, *fields: str) -> str:
    """Describe what a row says of its files, which its files do not hold."""
    said = " and ".join(f"{field} = {getattr(row, field)!r}" for field in fields)
    return f"a file of {row.name} does not hold what its row says: {said}"


def test_labels_and_the_record_may_be_in_different_places(tmp_path, monkeypatch):
    """As in a .compressed.ply, and the other way round."""
    row = replace(SPLAT_FORMATS["glb"], read_record=None, write=write_without_record)
    monkeypatch.setitem(SPLAT_FORMATS, "glb", row)
    monkeypatch.setattr(table, "_ROWS", list(SPLAT_FORMATS.values()))
    test_a_row_says_what_its_files_hold(tmp_path, "glb")


def write_without_record(path: Path, gaussians: Gaussians) -> None:
    write_glb(path, gaussians, NOTHING_KNOWN)


@pytest.mark.parametrize("row", SPLAT_FORMATS.values(), ids=list(SPLAT_FORMATS))
def test_texts_of_a_row_say_what_its_fields_say(row):
    assert ("y up" in row.texts.axes) == row.is_y_up
    assert row.texts.precision or row.write is None
    # The properties of a .ply are those that its reader of rows finds.
    claimed = set(row.texts.places) - ({"list_names"} if row.name == "ply" else set())
    assert [field for field in claimed if not getattr(row, field)] == []


@pytest.mark.parametrize("name", [name for name in SPLAT_FORMATS if name not in WRITTEN])
def test_a_format_that_is_only_read_is_written_by_the_tests(name):
    file = get_promise(name).file
    is_written = file in BY_HAND
    assert is_written, f"add a writer of {file} to BY_HAND (splat_files.py)"


def read_endings(page: str, title: str) -> set[str]:
    """Read the endings that a page names in the first table after a title."""
    text = (ROOT / "docs" / page).read_text("utf-8").split(f"## {title}\n")[1]
    table = re.findall(r"^\|.*\|$", text.split("\n## ")[0], re.M)
    return {word for line in table for word in re.findall(r"(?<![\w.])\.?\w+(?:\.\w+)*", line)}


@pytest.mark.parametrize("row", SPLAT_FORMATS.values(), ids=list(SPLAT_FORMATS))
def test_a_format_has_a_line_in_the_reference_page(row: SplatFormat):
    ending = row.endings[0]
    is_there = ending in read_endings("formats.md", "Splats")
    assert is_there, f"run `make pages`, which writes a line for {ending}"
    if row.write is not None and row.read_record is not None:
        assert row.endings[0] in read_endings("provenance.md", "Where it is")


def test_the_longest_ending_is_meant(tmp_path):
    assert match_ending(tmp_path / "A.COMPRESSED.PLY").name == "compressed-ply"
    assert match_ending(tmp_path / "a.ply").name == "ply"
    assert match_ending(tmp_path / "a.txt") is None


def test_sentences_name_the_formats_of_the_table(tmp_path):
    with pytest.raises(InputError, match=r"end it in \.ply, .*\.spz.* or \.usdz\.") as error:
        get_written_format(tmp_path / "a.ksplat")
    assert ".ksplat" not in str(error.value).partition("end it in ")[2]
    far = replace(plausible(30, 0), origin=(500_000.0, 4_000_000.0, 0.0))
    save_splat(tmp_path / "a.splat", far)
    (loss,) = describe_losses(tmp_path / "a.splat", far)
    listed = re.findall(r"\.\w+", loss.rpartition("; write ")[2].removesuffix("."))
    rows = [row for row in SPLAT_FORMATS.values() if row.holds_origin and row.write]
    holding = [ending for row in rows for ending in row.endings]
    assert set(listed) <= set(holding)
    assert {".ply", ".glb", ".usdz"} <= set(listed)
    assert ".splat" not in listed


ARRAYS = {
    "positions": np.zeros((5, 3)),
    "rotations": np.ones((5, 4)),
    "sizes": np.ones((5, 3)),
    "opacities": np.ones(5),
    "colours": np.zeros((5, 4, 3)),
}


def test_numbers_of_any_type_are_gaussians():
    arrays = {name: array.astype(np.int16) for name, array in ARRAYS.items()}
    assert build_gaussians(*arrays.values()).sh.shape == (5, 4, 3)


@pytest.mark.parametrize(
    ("name", "array", "sentence"),
    [
        ("positions", np.zeros((5, 2)), "its positions are no 5 × 3 numbers but 5 × 2"),
        ("positions", np.float32(1), "its positions are no 0 × 3 numbers but 1"),
        ("rotations", np.ones((5, 3)), "its rotations are no 5 × 4 numbers but 5 × 3"),
        ("sizes", np.ones((5, 1)), "its sizes are no 5 × 3 numbers but 5 × 1"),
        ("sizes", np.ones((4, 3)), "its sizes are no 5 × 3 numbers but 4 × 3"),
        ("opacities", np.ones((5, 1)), "its opacities are no 5 numbers but 5 × 1"),
        ("opacities", np.array(["a"] * 5), "its opacities are no 5 numbers"),
        ("colours", np.zeros((5, 4, 4)), "its colours are no 5 × 4 × 3 numbers but 5 × 4 × 4"),
        ("colours", np.zeros((5, 3)), "its colours are no 5 × 0 × 3 numbers but 5 × 3"),
        ("colours", np.zeros((5, 3, 3)), "its colours have 3 coefficients, which no degree has"),
    ],
)
def test_arrays_that_are_no_gaussians_are_damage(name, array, sentence):
    arrays = {**ARRAYS, name: np.asarray(array)}
    with pytest.raises(DamagedError) as error:
        build_gaussians(*arrays.values())
    assert str(error.value) == sentence
    require_plain(sentence)
