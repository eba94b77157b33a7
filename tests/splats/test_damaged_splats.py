"""Damaged splats, most of all downloads that were cut: what is missing is said in plain words."""

import gzip
import json
import os
import random
import struct
from pathlib import Path

import pytest

from command import run
from damage import require_plain
from fuzz import damage, replaced
from gscompleter import InputError, load_splat, save_splat
from splat_files import (
    SPLAT_FILES,
    glb_table,
    made,
    plausible,
    sog_files,
    write_glb,
    write_sog,
)

COUNT = 60


def refuse(path: Path) -> str:
    """Return the sentence by which a file is refused."""
    with pytest.raises(InputError) as caught:
        load_splat(path)
    return require_plain(str(caught.value))


def cut(path: Path, count: int) -> Path:
    """Leave `count` bytes out at the end of a file."""
    path.write_bytes(path.read_bytes()[:-count])
    return path


@pytest.mark.parametrize(
    ("was", "becomes", "clause"),
    [
        ("float min_x", "float low_x", "it lacks the property 'min_x'"),
        # A file has all bounds of colours, or is an early one without any.
        ("float max_b", "float high_b", "it lacks the property 'max_b'"),
        ("uint packed_scale", "uint packed", "it lacks the property 'packed_scale'"),
        ("uint packed_scale", "float packed_scale", "its property 'packed_scale' is no integer"),
        ("uchar f_rest_23", "uchar rest_23", "it lacks the property 'f_rest_23'"),
        ("property uchar f_rest_23\n", "", "it has 23 properties of spherical harmonics"),
    ],
)
def test_a_compressed_ply_names_the_property_that_is_wrong(tmp_path, was, becomes, clause):
    path = made(tmp_path, "scene.compressed.ply", plausible(COUNT, 2))
    data = path.read_bytes()
    assert data.count(was.encode()) == 1
    path.write_bytes(data.replace(was.encode(), becomes.encode()))
    assert f"cannot be read: {clause}" in refuse(path)


@pytest.mark.parametrize(
    ("name", "count", "sentence"),
    [
        ("scene.ply", 5, "ends after 59 of 60 Gaussians"),
        ("scene.splat", 5, "ends after 59 Gaussians, within the next one"),
        ("scene.ksplat", 5, "ends after 59 of 60 Gaussians"),
        ("scene.glb", 5, "ends after [0-9,]+ of [0-9,]+ bytes"),
        ("scene.compressed.ply", 5, "ends after 59 of 60 rows of 'sh'"),
        ("plain.spz", 400, "ends after 43 of 60 harmonics"),
        ("plain.spz", 60 * 24 + 9, "ends after 57 of 60 rotations"),
        ("four.spz", 5, "ends after [0-9]+ of 60 harmonics"),
        ("scene.sog", 30, "was cut before the list of its files"),
        ("written.sog", 300, "was cut before the list of its files"),
    ],
)
def test_a_download_that_was_cut_says_how_far_it_goes(tmp_path, name, count, sentence):
    path = cut(made(tmp_path, name, plausible(COUNT, 2)), count)
    with pytest.raises(InputError, match=sentence):
        load_splat(path)


@pytest.mark.parametrize("name", ["scene.spz", "scene.sog", "scene.glb"])
def test_a_conversion_of_a_download_that_was_cut_ends_in_a_sentence(
    tmp_path, name, monkeypatch, capsys
):
    """Its properties are listed before it is decoded."""
    path = made(tmp_path, name, plausible(COUNT, 0))
    path.write_bytes(path.read_bytes()[:40])
    assert run(monkeypatch, "convert", path, tmp_path / "out.ply") == 2
    assert f"{name} cannot be read: " in require_plain(capsys.readouterr().err.strip())


def test_a_packed_spz_that_was_cut_says_how_far_it_goes(tmp_path):
    path = made(tmp_path, "scene.spz", plausible(COUNT, 2))
    whole = path.read_bytes()
    content = gzip.decompress(whole)
    path.write_bytes(gzip.compress(content[:-400]))
    assert "ends after 43 of 60 harmonics" in refuse(path)
    path.write_bytes(whole[: len(whole) // 2])
    assert " of 60 " in refuse(path)
    path.write_bytes(whole[:-3])
    assert "ends after its Gaussians, before their checksum" in refuse(path)
    path.write_bytes(whole[:-6] + bytes(6))
    assert "content is damaged" in refuse(path)


def test_attributes_of_a_glb_that_are_too_short_say_how_far_they_go(tmp_path):
    table, binary = glb_table(plausible(COUNT, 0))
    path = write_glb(tmp_path / "scene.glb", table, binary[:-5])
    assert "ends after 59 of 60 Gaussians" in refuse(path)


def test_a_file_that_a_sog_lacks_is_named(tmp_path):
    files = sog_files(plausible(COUNT, 1))
    del files["quats.webp"]
    assert "lacks its file quats.webp" in refuse(write_sog(tmp_path / "a.sog", files))
    files = sog_files(plausible(COUNT, 1))
    files["means_l.webp"] = files["means_l.webp"][:-20]
    assert "its means_l.webp is damaged, or ends too early" in refuse(
        write_sog(tmp_path / "folder", files)
    )
    meta = json.loads(files["meta.json"])
    del meta["scales"]
    text = json.dumps(meta)
    for content, sentence in ((text, "lacks the entry 'scales'"), (text[:99], "ends too early")):
        files["meta.json"] = content.encode()
        path = write_sog(tmp_path / f"{len(os.listdir(tmp_path))}.sog", files)
        assert sentence in refuse(path)


def test_a_ply_without_gaussians_says_so(tmp_path):
    path = made(tmp_path, "scene.ply", plausible(COUNT, 0))
    path.write_bytes(path.read_bytes().replace(b"vertex 60\n", b"vertex 0\n"))
    assert "holds no Gaussians" in refuse(path)


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        (b"property float nx", b"property quad nx"),
        (b"property float nx", b"property float x"),
        (b"format binary_little_endian 1.0", b"format binary 1.0"),
        (b"element vertex 60", b"property float early"),
        (b"element vertex 60", b"element vertex " + b"9" * 4900),
    ],
)
def test_a_broken_header_of_a_ply_is_quoted_and_not_explained_by_python(tmp_path, line, wrong):
    path = made(tmp_path, "scene.ply", plausible(COUNT, 0))
    path.write_bytes(path.read_bytes().replace(line, wrong))
    assert "broken header" in refuse(path) or b"vertex 9" in wrong


KINDS = sorted({*SPLAT_FILES} - {"folder"})


@pytest.mark.parametrize("name", KINDS)
def test_no_damage_is_told_in_words_of_a_library(tmp_path, name):
    path = made(tmp_path, name, plausible(COUNT, 1))
    whole = path.read_bytes()
    chance = random.Random(0)
    refused = 0
    for number in range(60):
        path.write_bytes(whole)
        if number < 20:
            path.write_bytes(whole[: chance.randrange(1, len(whole))])
        else:
            damage(path, chance)
        try:
            load_splat(path)
        except InputError as error:
            require_plain(str(error))
            refused += 1
    assert refused > 10


@pytest.mark.parametrize("name", ["a.glb", "a.sog"])
def test_no_odd_value_of_json_is_told_in_words_of_a_library(tmp_path, name):
    chance = random.Random(1)
    table, binary = glb_table(plausible(COUNT, 1))
    files = sog_files(plausible(COUNT, 1))
    text = json.dumps(table)
    odd = (None, -1, 0.5, "x", [], {}, 10**12, float("nan"), [[1], [1, 2]])
    refused = 0
    for number in range(60):
        path = tmp_path / f"{number}-{name}"
        if name == "a.glb":
            write_glb(path, replaced(json.loads(text), chance, odd), binary)
        else:
            meta = json.dumps(replaced(json.loads(files["meta.json"]), chance, odd))
            write_sog(path, {**files, "meta.json": meta.encode()})
        try:
            load_splat(path)
        except InputError as error:
            require_plain(str(error))
            refused += 1
    assert refused > 10


def test_what_a_version_4_lacks_is_said(tmp_path):
    path = made(tmp_path, "four.spz", plausible(COUNT, 0))
    whole = path.read_bytes()
    for size, sentence in ((10, "within its header"), (60, "entries of its table of contents")):
        path.write_bytes(whole[:size])
        assert sentence in refuse(path)
    path.write_bytes(whole[:112] + bytes(len(whole) - 112))
    assert "content is damaged" in refuse(path)


def test_versions_of_others_still_say_what_is_read(tmp_path):
    header = struct.pack("<4sIIBBBB", b"NGSP", 9, 1, 0, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(header)
    assert "version 9" in refuse(tmp_path / "a.spz")
    save_splat(tmp_path / "b.splat", plausible(1, 0))
    cut(tmp_path / "b.splat", 31)
    assert "ends after 0 Gaussians" in refuse(tmp_path / "b.splat")
