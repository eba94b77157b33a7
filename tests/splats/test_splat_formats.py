"""Splat formats: each reads as the same picture, and other files give a sentence."""

import gzip
import hashlib
import json
import os
import shutil
import struct
import subprocess
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from gsply import plyread

from command import run
from gscompleter import (
    Gaussians,
    InputError,
    load_splat,
    merge,
    save_ply,
    save_splat,
)
from gscompleter.splats.labels_file import get_labels_path
from gscompleter.splats.morton import sort_along_morton
from gscompleter.splats.table import match_ending
from gscompleter.splats.transform import (
    HALF_TURN_X,
    HALF_TURN_Z,
    rotate_half_turn,
    transform_gaussians,
)
from scenes import camera_at, random_gaussians, scaled
from splat_files import (
    CPU,
    FORMATS_BUT_PLY,
    WRITTEN,
    covariances,
    glb_table,
    made,
    plausible,
    psnr,
    sog_files,
    webp,
    write_glb,
    write_ksplat,
    write_sog,
    write_spz_2,
    write_spz_4,
)


def refused(path: Path, sentence: str) -> str:
    with pytest.raises(InputError, match=sentence) as caught:
        load_splat(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# ------------------------------------------------------------------------------- round trips


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_ply_comes_back_exactly(tmp_path, degree):
    save_ply(tmp_path / "a.ply", random_gaussians(300, sh_degree=degree))
    save_splat(tmp_path / "b.ply", load_splat(tmp_path / "a.ply"))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_compressed_ply_rounds_no_more_than_its_bits(tmp_path, degree):
    gaussians = sort_along_morton(plausible(600, degree))
    save_splat(tmp_path / "scene.compressed.ply", gaussians)
    loaded = load_splat(tmp_path / "scene.compressed.ply")
    extent = (gaussians.means.amax(0) - gaussians.means.amin(0)).max()
    assert (loaded.means - gaussians.means).abs().max() <= extent / 1023 / 2 * 1.01
    assert (loaded.scales.log() - gaussians.scales.log()).abs().max() <= 3 / 1023 / 2 * 1.01
    assert (loaded.opacities - gaussians.opacities).abs().max() <= 0.51 / 255
    assert (
        (loaded.sh[:, 1:] - gaussians.sh[:, 1:]).abs().amax() <= 8 / 256 / 2 * 1.01
        if degree
        else True
    )
    assert psnr(loaded, gaussians) > 40


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_an_spz_rounds_no_more_than_its_bits(tmp_path, degree):
    gaussians = plausible(300, degree)
    save_splat(tmp_path / "scene.spz", gaussians)
    loaded = load_splat(tmp_path / "scene.spz")
    assert (loaded.means - gaussians.means).abs().max() <= 2**-16
    assert (loaded.scales.log() - gaussians.scales.log()).abs().max() <= 1 / 32 * 1.01
    assert (loaded.opacities - gaussians.opacities).abs().max() <= 0.51 / 255
    assert (loaded.sh[:, :1] - gaussians.sh[:, :1]).abs().max() <= 0.51 / 255 / 0.15
    if degree:
        assert (loaded.sh[:, 1:] - gaussians.sh[:, 1:]).abs().max() <= 0.51 / 128
    assert psnr(loaded, gaussians) > 35


def test_a_splat_keeps_position_and_size_and_rounds_the_rest(tmp_path):
    gaussians = plausible(300, 0)
    save_splat(tmp_path / "scene.splat", gaussians)
    loaded = load_splat(tmp_path / "scene.splat")
    assert torch.equal(loaded.means, gaussians.means)
    assert torch.equal(loaded.scales, gaussians.scales)
    assert (loaded.opacities - gaussians.opacities).abs().max() <= 0.51 / 255
    assert psnr(loaded, gaussians) > 35


@pytest.mark.parametrize("name", FORMATS_BUT_PLY)
def test_every_format_shows_the_same_picture(tmp_path, name):
    """Axes, rotations and harmonics are right, or the picture would be another."""
    gaussians = plausible(400, 3 if match_ending(Path(name)).holds_harmonics else 0)
    loaded = load_splat(made(tmp_path, name, gaussians))
    assert psnr(loaded, gaussians) > 33
    assert len(loaded) == 400


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_ksplat_of_every_level(tmp_path, level, degree):
    gaussians = plausible(50, degree)
    loaded = load_splat(write_ksplat(tmp_path / "scene.ksplat", gaussians, level))
    assert torch.allclose(loaded.means, gaussians.means, atol=0 if level == 0 else 1e-3)
    assert torch.allclose(loaded.scales, gaussians.scales, rtol=1e-3)
    assert torch.allclose(loaded.sh[:, 1:], gaussians.sh[:, 1:], atol=(0, 1e-3, 0.02)[level])
    assert torch.allclose(covariances(loaded), covariances(gaussians), atol=2e-3)


def test_spz_of_versions_2_3_and_4_are_the_same(tmp_path):
    gaussians = plausible(100)
    third = load_splat(made(tmp_path, "scene.spz", gaussians))
    fourth = load_splat(write_spz_4(tmp_path / "4.spz", tmp_path / "scene.spz"))
    second = load_splat(write_spz_2(tmp_path / "2.spz", tmp_path / "scene.spz", gaussians))
    assert torch.equal(third.sh, fourth.sh)
    assert torch.equal(third.quats, fourth.quats)
    assert torch.equal(third.means, second.means)
    assert torch.allclose(covariances(third), covariances(second), atol=2e-2)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", ["folder", "bundle.sog"])
def test_sog_of_both_versions_as_folder_and_bundle(tmp_path, version, name):
    gaussians = plausible(90, 2)
    path = write_sog(tmp_path / name, sog_files(gaussians, version))
    loaded = load_splat(path)
    assert torch.allclose(loaded.means, gaussians.means, atol=1e-3)
    assert (loaded.scales.log() - gaussians.scales.log()).abs().max() < 0.05
    assert torch.allclose(loaded.opacities, gaussians.opacities, atol=0.02)
    assert torch.allclose(loaded.sh, gaussians.sh, atol=0.02)
    if path.is_dir():
        assert torch.equal(load_splat(path / "meta.json").means, loaded.means)


def test_nodes_of_a_glb_place_their_gaussians(tmp_path):
    gaussians = plausible(60, 3)
    table, binary = glb_table(gaussians)
    turn = [0.1, 0.2, 0.3, (1 - 0.14) ** 0.5]
    table["nodes"] = [
        {"children": [1], "translation": [1, 2, 3], "scale": [2, 2, 2]},
        {"mesh": 0, "rotation": turn},
    ]
    loaded = load_splat(write_glb(tmp_path / "scene.glb", table, binary))
    x, y, z, w = turn
    place = torch.eye(4)
    place[:3, :3] = 2 * torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    place[:3, 3] = torch.tensor([1.0, 2, 3])
    expected = rotate_half_turn(transform_gaussians(gaussians, place), HALF_TURN_Z)
    assert torch.allclose(loaded.means, expected.means, atol=1e-5)
    assert torch.allclose(covariances(loaded), covariances(expected), atol=1e-5)
    table["nodes"][1]["scale"] = [1, 2, 1]
    refused(write_glb(tmp_path / "uneven.glb", table, binary), "unevenly")


# ------------------------------------------------------------------------------------ frames


def test_a_moved_scene_looks_the_same_to_a_camera_that_moved_with_it():
    gaussians, camera = plausible(200, 3), camera_at(0.2, 0.1, yaw=10, size=64)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0))).Q
    turn = turn * torch.linalg.det(turn).sign()
    place = torch.eye(4)
    place[:3, :3], place[:3, 3] = turn * 1.7, torch.tensor([3.0, -1.0, 2.0])
    c2w = place @ camera.c2w
    c2w[:3, :3] /= 1.7
    there = CPU.render(transform_gaussians(gaussians, place), replace(camera, c2w=c2w))
    assert torch.allclose(there.image, CPU.render(gaussians, camera).image, atol=2e-3)


def test_the_identity_leaves_every_bit_of_the_harmonics():
    gaussians = plausible(500, 3)
    assert torch.equal(transform_gaussians(gaussians, torch.eye(4)).sh, gaussians.sh)


@pytest.mark.parametrize("signs", [HALF_TURN_X, HALF_TURN_Z])
def test_half_a_turn_is_exact_and_the_same_as_the_rotation(signs):
    gaussians = plausible(50, 3)
    turned = rotate_half_turn(gaussians, signs)
    rotated = transform_gaussians(gaussians, torch.diag(torch.tensor([*signs, 1.0])))
    assert torch.allclose(turned.means, rotated.means, atol=1e-6)
    assert torch.allclose(turned.sh, rotated.sh, atol=1e-5)
    assert torch.allclose(covariances(turned), covariances(rotated), atol=1e-6)
    assert torch.equal(rotate_half_turn(turned, signs).sh, gaussians.sh)
    assert torch.equal(rotate_half_turn(turned, signs).quats, gaussians.quats)


# ------------------------------------------------------------------------------------ labels


@pytest.mark.parametrize("name", WRITTEN)
def test_what_was_generated_is_known_after_every_conversion(tmp_path, name):
    gaussians = plausible(300, 0)
    labels = (torch.arange(300) % 7 // 3).to(torch.uint8)
    save_splat(tmp_path / name, replace(gaussians, generated=labels))
    loaded = load_splat(tmp_path / name)
    nearest = torch.cdist(loaded.means, gaussians.means).argmin(1)
    assert torch.equal(loaded.generated, labels[nearest])
    has_own = match_ending(tmp_path / name).holds_labels
    assert get_labels_path(tmp_path / name).exists() != has_own


@pytest.mark.parametrize("name", ["written.sog", "written.glb"])
def test_labels_beside_a_file_of_an_earlier_version_are_read(tmp_path, name):
    """They lay beside all files but .ply."""
    save_splat(tmp_path / name, plausible(12, 0))
    digest = hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()
    table = {"sha256": digest, "generated": [[0, 5], [2, 7]]}
    get_labels_path(tmp_path / name).write_text(json.dumps(table))
    assert load_splat(tmp_path / name).generated.tolist() == [0] * 5 + [2] * 7


@pytest.mark.parametrize("values", [[0.5] * 4, [300.0] * 4, [float("nan")] * 4])
def test_labels_in_a_glb_that_are_no_bytes_are_refused(tmp_path, values):
    table, binary = glb_table(plausible(4, 0))
    table["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": 16})
    accessor = {"bufferView": len(table["bufferViews"]) - 1, "componentType": 5126}
    table["accessors"].append({**accessor, "count": 4, "type": "SCALAR"})
    attributes = table["meshes"][0]["primitives"][0]["attributes"]
    attributes["_GENERATED"] = len(table["accessors"]) - 1
    binary += struct.pack("<4f", *values)
    table["buffers"][0]["byteLength"] = len(binary)
    refused(write_glb(tmp_path / "scene.glb", table, binary), "labels of generated Gaussians")


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_mode_of_gaussians_is_known_after_every_conversion(tmp_path, antialiased):
    given = replace(plausible(60), is_antialiased=antialiased)
    for name in ("a.ply", "b.spz", "c.compressed.ply", "d.sog", "e.ply"):
        save_splat(tmp_path / name, given)
        given = load_splat(tmp_path / name)
        assert given.is_antialiased == antialiased, name
    assert load_splat(write_spz_4(tmp_path / "4.spz", tmp_path / "b.spz")).is_antialiased == (
        antialiased
    )
    save_splat(tmp_path / "scene.splat", given)
    assert not load_splat(tmp_path / "scene.splat").is_antialiased


@pytest.mark.parametrize(
    ("entry", "antialiased"),
    [
        ({"model": "antialiased"}, True),
        ({"antialias": True}, True),
        ({"model": "default", "antialias": False}, False),
        ({"model": "2dgs"}, False),
    ],
)
def test_a_sog_marks_antialiased_gaussians(tmp_path, entry, antialiased):
    files = sog_files(plausible(30, 0))
    files["meta.json"] = json.dumps(json.loads(files["meta.json"]) | entry).encode()
    assert load_splat(write_sog(tmp_path / "scene.sog", files)).is_antialiased == antialiased


def test_convert_says_where_the_mode_is_lost(tmp_path, monkeypatch, capsys):
    save_splat(tmp_path / "a.ply", replace(plausible(30, 0), is_antialiased=True))
    assert run(monkeypatch, "convert", tmp_path / "a.ply", tmp_path / "b.spz") == 0
    assert "antialiased" not in capsys.readouterr().out
    assert run(monkeypatch, "convert", tmp_path / "b.spz", tmp_path / "c.splat") == 0
    assert "A .splat file cannot mark Gaussians as antialiased" in capsys.readouterr().out
    assert run(monkeypatch, "convert", tmp_path / "b.spz", tmp_path / "d.glb") == 0
    assert "A .glb file cannot mark Gaussians as antialiased" in capsys.readouterr().out


def test_labels_of_another_file_are_not_believed(tmp_path):
    path, other = tmp_path / "scene.spz", tmp_path / "other.spz"
    gaussians = plausible(20, 0)
    save_splat(path, replace(gaussians, generated=torch.ones(20, dtype=torch.uint8)))
    save_splat(other, gaussians[:10])
    labels = get_labels_path(path)
    shutil.copy(labels, get_labels_path(other))
    refused(other, "does not hold the labels")
    save_splat(other, gaussians[:10])
    assert not get_labels_path(other).exists()
    for text in (
        "{}",
        '{"sha256": 1, "generated": [[1]]}',
        '{"sha256": "", "generated": 4}',
        "[1]",
    ):
        labels.write_text(text)
        refused(path, "remove it to go on")


# ----------------------------------------------------------------------------------- refused


@pytest.mark.parametrize("name", [n for n in FORMATS_BUT_PLY if not n.endswith(".splat")])
def test_a_truncated_file_is_refused(tmp_path, name):
    path = made(tmp_path, name, plausible(60, 2))
    data = path.read_bytes()
    for share in (0.1, 0.5, 0.9, 0.999):
        path.write_bytes(data[: int(len(data) * share)])
        refused(path, "again|bundle|.")


def test_what_is_no_splat_is_refused(tmp_path):
    refused(tmp_path / "absent.spz", "No such file")
    refused(tmp_path, "folder without a splat")
    for name in ("a.ply", "a.splat", "a.spz"):
        (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\n")
        refused(tmp_path / name, "git lfs pull")
    for name, data, sentence in [
        ("empty.splat", b"", "is empty"),
        ("a.txt", b"hello", "format that is known"),
        ("b.spz", b"hello", "format that is known"),
        ("c.splat", b"hello", "ends after 0 Gaussians"),
        ("d.spz", gzip.compress(b"x" * 100), "no .spz"),
        ("e.spz", b"NGSP" + struct.pack("<IIBBBB", 9, 1, 0, 12, 0, 0), "version 9"),
        ("f.glb", b"glTF" + bytes(8), "cannot be read"),
        ("g.json", b'{"frames": []}', "JSON file without Gaussians"),
        ("meta.json", b'{"frames": []}', "describes no .sog"),
        ("h.ksplat", b"\x00\x07" + bytes(4094), "holds no Gaussians"),
        ("i.ksplat", b"\x09" + bytes(4095), "version 9"),
    ]:
        (tmp_path / name).write_bytes(data)
        refused(tmp_path / name, sentence)


MANY = 300_000
"""Gaussians of which a property that is the same for all shrinks to a thousandth and less."""


def equal_but_for(*names: str) -> Gaussians:
    """Make Gaussians that differ in these properties, and are equal in all others."""
    gaussians = random_gaussians(MANY, seed=5, sh_degree=1)
    sh = gaussians.sh.clamp(-0.9, 0.9)
    whole = replace(gaussians, sh=sh, opacities=torch.ones(MANY))
    fields = ("means", "quats", "scales", "sh")
    alike = {n: getattr(whole, n)[:1].expand_as(getattr(whole, n)).clone() for n in fields}
    return replace(whole, **{name: alike[name] for name in fields if name not in names})


@pytest.mark.parametrize(
    "differing",
    [
        pytest.param(("means",), id="one kind"),
        pytest.param((), id="one place", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize(
    "name",
    ["a.sog", "a.spz", "four.spz", "a.compressed.ply", "a.splat", "a.glb", "packed.glb", "a.ply"],
)
def test_what_is_the_same_for_all_gaussians_is_read_again(tmp_path, name, differing):
    """As programs write it that turn a mesh or a single photograph into Gaussians of one size."""
    gaussians = equal_but_for(*differing)
    path = tmp_path / name
    if name == "four.spz":
        write_spz_4(path, made(tmp_path, "scene.spz", gaussians))
    elif name == "packed.glb":
        save_splat(tmp_path / "a.spz", gaussians)
        pack_glb(path, MANY, (tmp_path / "a.spz").read_bytes())
    else:
        save_splat(path, gaussians)
    loaded = load_splat(path)
    assert len(loaded) == MANY
    for read, given in (
        (loaded.scales.log(), gaussians.scales.log()),
        (loaded.opacities, gaussians.opacities),
        (loaded.sh[:, 0], gaussians.sh[:, 0]),
        (covariances(loaded[:9]), covariances(gaussians[:9])),
    ):
        assert (read - given[:1]).abs().max() <= 0.02 * given.abs().max()
    for axis in range(3):
        read, given = loaded.means[:, axis].sort().values, gaussians.means[:, axis].sort().values
        assert (read - given).abs().max() <= 2e-3 * gaussians.means.abs().max()


# The test before reads such bundles, and others read folders.
@pytest.mark.slow
def test_a_sog_in_a_folder_and_packed_again_may_have_one_size_too(tmp_path):
    save_splat(tmp_path / "a.sog", equal_but_for("means"))
    with zipfile.ZipFile(tmp_path / "a.sog") as bundle:
        files = {name: bundle.read(name) for name in bundle.namelist()}
    assert len(files["scales.webp"]) < 100
    folder = write_sog(tmp_path / "folder", files)
    with zipfile.ZipFile(tmp_path / "b.sog", "w", zipfile.ZIP_DEFLATED) as bundle:
        for name, data in files.items():
            bundle.writestr(name, data)
    for path in (folder, folder / "meta.json", tmp_path / "b.sog"):
        assert torch.equal(load_splat(path).scales, load_splat(tmp_path / "a.sog").scales)


def test_bombs_of_equal_gaussians_are_refused_before_anything_is_unpacked(tmp_path):
    """Of a few bytes that keep all promises: what they unpack to would fill the memory."""
    count = 81_000_000
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, count, 3, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(header + bytes(10**6)))
    refused(tmp_path / "a.spz", "bytes claim to hold 81,000,000 Gaussians")
    pack_glb(tmp_path / "a.glb", count, (tmp_path / "a.spz").read_bytes())
    refused(tmp_path / "a.glb", "claim to hold 81,000,000 Gaussians")
    whole = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, 0, 12, 0, 5, 32)
    (tmp_path / "b.spz").write_bytes(whole + bytes(80))
    refused(tmp_path / "b.spz", "claim to hold 81,000,000 Gaussians")
    # Images of one colour, as many pixels as the count asks for, or far more than it does.
    huge = webp(np.full((9_000, 9_000, 4), 255, np.uint8))
    files = sog_files(plausible(20, 0))
    images = {name: huge for name in files if name.endswith(".webp")}
    meta = json.loads(files["meta.json"])
    for given, sentence in ((count, "claim to hold 81,000,000 Gaussians"), (20, "are 20 Gauss")):
        table = json.dumps(meta | {"count": given}).encode()
        write_sog(tmp_path / "a.sog", {"meta.json": table, **images})
        refused(tmp_path / "a.sog", sentence)
    with zipfile.ZipFile(tmp_path / "b.sog", "w", zipfile.ZIP_DEFLATED) as bundle:
        for name, data in files.items():
            bundle.writestr(name, data + bytes(10**8 if name == "quats.webp" else 0))
    refused(tmp_path / "b.sog", "its quats.webp is too large: .* bytes claim to hold 100,000,")


def pack_glb(path: Path, count: int, spz: bytes) -> None:
    """Write a .glb with a .spz inside."""
    extension = {"KHR_gaussian_splatting_compression_spz": {"bufferView": 0}}
    table, _ = glb_table(plausible(1, 0))
    primitive = table["meshes"][0]["primitives"][0]
    primitive["attributes"] = {"POSITION": 0}
    primitive["extensions"]["KHR_gaussian_splatting"]["extensions"] = extension
    table["accessors"] = [{"componentType": 5126, "count": count, "type": "VEC3"}]
    table["bufferViews"] = [{"buffer": 0, "byteLength": len(spz)}]
    write_glb(path, table, spz)


def test_absurd_counts_are_refused_before_anything_is_unpacked(tmp_path):
    huge = struct.pack("<4sIIBBBB", b"NGSP", 3, 4_000_000_000, 3, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(huge))
    refused(tmp_path / "a.spz", "claim to hold")
    (tmp_path / "bomb.spz").write_bytes(gzip.compress(bytes(50_000_000)))
    refused(tmp_path / "bomb.spz", "no .spz")
    files = sog_files(plausible(20, 0))
    meta = json.loads(files["meta.json"]) | {"count": 10**12}
    write_sog(tmp_path / "a.sog", files | {"meta.json": json.dumps(meta).encode()})
    refused(tmp_path / "a.sog", "fewer pixels")
    image = bytearray(files["quats.webp"])
    struct.pack_into("<I", image, 21, 0x0FFFFFFF)
    write_sog(tmp_path / "b.sog", files | {"quats.webp": bytes(image)})
    refused(tmp_path / "b.sog", "exceeds limit")
    with zipfile.ZipFile(tmp_path / "c.sog", "w", zipfile.ZIP_DEFLATED) as bundle:
        bundle.writestr("meta.json", bytes(100_000_000))
    refused(tmp_path / "c.sog", "claim to hold")
    table, binary = glb_table(plausible(20, 0))
    table["accessors"][3]["count"] = 19
    refused(write_glb(tmp_path / "b.glb", table, binary), "cannot be read")
    table["scenes"][0]["nodes"] = [0] * 100_000
    refused(write_glb(tmp_path / "a.glb", table, binary), "contain each other|more Gaussians")


def test_a_sog_opens_no_files_but_its_own(tmp_path):
    files = sog_files(plausible(20, 0))
    for name in ("../secret.webp", "/etc/passwd", "", None):
        meta = json.loads(files["meta.json"])
        meta["quats"]["files"] = [name]
        folder = tmp_path / f"scene{len(os.listdir(tmp_path))}"
        write_sog(folder, files | {"meta.json": json.dumps(meta).encode()})
        refused(folder, "not beside it")


@pytest.mark.parametrize("name", ["scene.splat", "scene.glb"])
def test_numbers_that_are_none_are_counted_or_left_out(tmp_path, name):
    gaussians = plausible(20, 0)
    gaussians.means[3, 1] = float("nan")
    path = made(tmp_path, "scene.glb", gaussians)
    if name == "scene.splat":
        path = tmp_path / name
        save_splat(path, plausible(20, 0))
        data = bytearray(path.read_bytes())
        data[96:100] = struct.pack("<f", float("inf"))
        path.write_bytes(data)
    refused(path, "1 of 20 Gaussians with NaN")
    assert len(load_splat(path, drop_nonfinite=True)) == 19


def of_three(sizes: float, opacity: float) -> Gaussians:
    """Make three Gaussians; the second has other sizes and another opacity."""
    gaussians = plausible(3, 0)
    scales, opacities = gaussians.scales.clone(), gaussians.opacities.clone()
    scales[1] *= sizes
    opacities[1] = opacity
    return replace(gaussians, scales=scales, opacities=opacities)


@pytest.mark.parametrize("name", ["scene.ksplat", "scene.splat", "scene.glb"])
def test_negative_scales_are_refused(tmp_path, name):
    path = made(tmp_path, name, of_three(1 if name == "scene.splat" else -1, 0.5))
    if name == "scene.splat":  # which we write, and so only with scales that can be read
        data = bytearray(path.read_bytes())
        struct.pack_into("<f", data, 32 + 12, -0.5)
        path.write_bytes(data)
    refused(path, "has 1 of 3 Gaussians with a negative scale or an opacity outside of")


@pytest.mark.parametrize("opacity", [2.0, -0.5, 1e30])
def test_opacities_that_are_no_fractions_are_refused(tmp_path, opacity):
    path = made(tmp_path, "scene.glb", of_three(1, opacity))
    refused(path, "has 1 of 3 Gaussians with a negative scale or an opacity outside of")


def test_opacities_that_are_off_by_rounding_are_clamped(tmp_path):
    for opacity, clamped in ((1.0001, 1.0), (-0.0001, 0.0)):
        loaded = load_splat(made(tmp_path, "scene.glb", of_three(1, opacity)))
        assert loaded.opacities[1] == clamped


def test_names_and_versions_of_others_are_quoted_in_part(tmp_path):
    long = "a\n" * 5000
    path = made(tmp_path, "folder", plausible(20, 1))
    table = json.loads((path / "meta.json").read_text())
    for changed in (
        {**table, "version": long},
        {**table, "count": long},
        {**table, "count": [long]},
        {**table, "means": {**table["means"], "files": [long, long]}},
        {**table, "means": {**table["means"], "mins": [long] * 3}},
        {**table, "means": {long: 1}},
    ):
        (path / "meta.json").write_text(json.dumps(changed))
        assert len(refused(path, "cannot be read|describes no")) <= 287
    gaussians, binary = glb_table(plausible(20, 0))
    primitive = gaussians["meshes"][0]["primitives"][0]
    primitive["extensions"]["KHR_gaussian_splatting"] = {"kernel": long, "colorSpace": long}
    primitive["extensions"][long] = {}
    assert len(refused(write_glb(tmp_path / "long.glb", gaussians, binary), "unknown way")) <= 287


def test_what_cannot_be_written_is_refused(tmp_path):
    gaussians = plausible(10, 0)
    for name in ("scene.ksplat", "meta.json", "scene.txt"):
        with pytest.raises(InputError, match="cannot be written"):
            save_splat(tmp_path / name, gaussians)
    with pytest.raises(InputError, match="cannot hold Gaussians"):
        save_splat(tmp_path / "far.spz", scaled(gaussians, 1e8))
    with pytest.raises(InputError, match="no Gaussian"):
        save_splat(tmp_path / "scene.splat", gaussians[:0])
    assert os.listdir(tmp_path) == []


# ---------------------------------------------------------------------------------- commands


def test_convert_writes_once_and_says_what_it_wrote(tmp_path, monkeypatch, capsys):
    source, out = tmp_path / "a.ply", tmp_path / "b.spz"
    save_splat(source, replace(plausible(30, 1), generated=torch.ones(30, dtype=torch.uint8)))
    assert run(monkeypatch, "convert", source, out) == 0
    assert "30 Gaussians, 30 of them generated" in capsys.readouterr().out.replace("\n", " ")
    assert run(monkeypatch, "convert", source, out) == 2
    assert "exists; name another file" in capsys.readouterr().err
    assert run(monkeypatch, "convert", source, out, "--overwrite", "--quiet") == 0
    assert run(monkeypatch, "convert", source, tmp_path / "b.ksplat") == 2
    assert run(monkeypatch, "convert", out, tmp_path / "c.ply") == 0
    assert load_splat(tmp_path / "c.ply").generated.tolist() == [1] * 30


def test_convert_writes_the_plain_layout_of_all_gaussians(tmp_path, monkeypatch):
    """For readers that misread the label; other formats get no labels file."""
    given = replace(plausible(30, 1), generated=(torch.arange(30) % 3).to(torch.uint8))
    save_splat(tmp_path / "completed.ply", given)
    for name in ("x.ply", "x.spz", "x.compressed.ply"):
        out = tmp_path / name
        assert run(monkeypatch, "convert", tmp_path / "completed.ply", out) == 0
        assert load_splat(out).generated.any()
        more = ("--plain", "--overwrite")
        assert run(monkeypatch, "convert", tmp_path / "completed.ply", out, *more) == 0
        assert len(load_splat(out)) == 30
        assert not load_splat(out).generated.any()
        assert not get_labels_path(out).exists()
    save_ply(tmp_path / "expected.ply", given, provenance=False)
    assert (tmp_path / "x.ply").read_bytes() == (tmp_path / "expected.ply").read_bytes()
    names = plyfile.PlyData.read(str(tmp_path / "x.ply"))["vertex"].data.dtype.names
    assert names[:6] == ("x", "y", "z", "nx", "ny", "nz")
    assert "generated" not in names
    assert torch.allclose(torch.tensor(plyread(str(tmp_path / "x.ply")).means), given.means)


# ------------------------------------------------------------------------------- third party


def test_files_of_others_are_read_as_a_third_party_reads_them(shared):
    folder = shared / "formats" / "gaussians"
    for ours, theirs in [
        ("guitar.compressed.ply", "guitar.from-compressed.ply"),
        ("playbot_sog", "playbot_lod4.from-sog.ply"),
    ]:
        loaded, expected = load_splat(folder / ours), load_splat(folder / theirs)
        for field in ("means", "scales", "opacities", "sh"):
            a, b = getattr(loaded, field), getattr(expected, field)
            assert torch.allclose(a, b, atol=2e-5, rtol=1e-5), (ours, field)
        assert torch.allclose(covariances(loaded), covariances(expected), atol=1e-6)


def test_opaque_gaussians_that_a_third_party_decoded_are_kept(shared, tmp_path, monkeypatch):
    """Their logits are infinite in its .ply, and finite once saved again."""
    folder, out = shared / "formats" / "gaussians", tmp_path / "out.ply"
    assert run(monkeypatch, "convert", folder / "guitar.from-compressed.ply", out) == 0
    camera = camera_at(0.29, -1.13, -1.5, size=96)
    truth, ours = (
        CPU.render(load_splat(path), camera).image
        for path in (folder / "guitar.compressed.ply", out)
    )
    assert truth.std() > 0.05
    assert -10 * (truth - ours).square().mean().log10() > 60
    assert plyfile.PlyData.read(str(out))["vertex"]["opacity"].max() < 17


def test_a_scene_in_two_formats_of_others_is_one_scene(shared):
    """SPZ has other axes than a compressed .ply; wrong axes would change the picture."""
    folder = shared / "formats" / "gaussians"
    spz, ply = (load_splat(folder / name) for name in ("biker.spz", "biker.compressed.ply"))
    camera = camera_at(-0.1, -1.6, -3.0, size=96)
    a, b = (CPU.render(scene, camera).image for scene in (spz, ply))
    assert a.std() > 0.1
    assert -10 * (a - b).square().mean().log10() > 32


def test_the_smallest_files_are_read(shared):
    folder = shared / "formats" / "gaussians" / "minimal"
    for path in sorted(folder.iterdir()):
        loaded = load_splat(path)
        assert len(loaded) == 4
        assert loaded.means[:, 2].abs().tolist() == [1, 1, 0, 0], path.name
        assert torch.allclose(loaded.scales, torch.tensor(0.1), rtol=0.04)
    assert len(load_splat(folder.parent / "arkit_scene.splat")) == 116_906


@pytest.fixture(scope="module")
def splat_transform():
    """Make a third-party converter, as a function of two paths."""
    named = os.environ.get("SPLAT_TRANSFORM")
    command = ["node", named] if named else ["splat-transform"]
    if shutil.which(command[0]) is None or (named and not Path(named).is_file()):
        pytest.skip("needs splat-transform on the PATH, or SPLAT_TRANSFORM with its cli.mjs")
    return lambda a, b: subprocess.run([*command, "-w", "-q", a, b], check=True)


@pytest.mark.third_party
@pytest.mark.parametrize(
    "name",
    ["scene.ply", "four.spz", "scene.sog", "written.sog", "scene.compressed.ply", "scene.spz"],
)
def test_a_third_party_reads_every_file_the_same(tmp_path, splat_transform, name):
    made(tmp_path, name, plausible(600, 3))
    compare_with_a_third_party(tmp_path, splat_transform, name)


@pytest.mark.third_party
@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_third_party_reads_ksplat_the_same(tmp_path, splat_transform, level):
    write_ksplat(tmp_path / "scene.ksplat", plausible(600, 2), level)
    compare_with_a_third_party(tmp_path, splat_transform, "scene.ksplat")


@pytest.mark.third_party
def test_a_third_party_reads_sog_of_version_1_the_same(tmp_path, splat_transform):
    write_sog(tmp_path / "scene.sog", sog_files(plausible(600, 2), version=1))
    compare_with_a_third_party(tmp_path, splat_transform, "scene.sog")


@pytest.mark.third_party
def test_a_third_party_reads_our_splat_nearly_the_same(tmp_path, splat_transform):
    """It takes bytes of a rotation from -1 at 0 to 1 at 255; then none of them is 0."""
    made(tmp_path, "scene.splat", plausible(600, 0))
    compare_with_a_third_party(tmp_path, splat_transform, "scene.splat", loose=1e-2)


def compare_with_a_third_party(tmp_path, splat_transform, name, loose=1e-5):
    splat_transform(tmp_path / name, tmp_path / "theirs.ply")
    ours, theirs = load_splat(tmp_path / name), load_splat(tmp_path / "theirs.ply")
    if name.endswith(".spz"):  # since version 3 it keeps the axes of such a file
        theirs = rotate_half_turn(theirs, HALF_TURN_X)
    for field in ("means", "scales", "opacities", "sh"):
        assert torch.allclose(getattr(ours, field), getattr(theirs, field), atol=1e-5, rtol=1e-4)
    assert torch.allclose(covariances(ours), covariances(theirs), atol=loose)


@pytest.mark.third_party
@pytest.mark.parametrize("name", ["scene.compressed.ply", "scene.spz", "scene.glb"])
def test_what_a_third_party_writes_is_read(tmp_path, splat_transform, name):
    save_ply(tmp_path / "ours.ply", plausible(600, 3))
    splat_transform(tmp_path / "ours.ply", tmp_path / name)
    theirs = load_splat(tmp_path / name)
    if name.endswith(".spz"):
        theirs = rotate_half_turn(theirs, HALF_TURN_X)
    assert psnr(theirs, load_splat(tmp_path / "ours.ply")) > 33


@pytest.mark.third_party
def test_a_third_party_writes_the_same_glb(tmp_path, splat_transform):
    save_splat(tmp_path / "ours.ply", plausible(60, 2))
    save_splat(tmp_path / "ours.glb", load_splat(tmp_path / "ours.ply"))
    splat_transform(tmp_path / "ours.ply", tmp_path / "theirs.glb")
    ours, theirs = (load_splat(tmp_path / name) for name in ("ours.glb", "theirs.glb"))
    for field in ("means", "scales", "opacities", "sh"):
        assert torch.allclose(getattr(ours, field), getattr(theirs, field), atol=1e-6, rtol=1e-5)
    assert torch.allclose(covariances(ours), covariances(theirs), atol=1e-6)


def test_merging_keeps_the_labels_of_both():
    parts = [plausible(5, 0), replace(plausible(5, 0), generated=torch.ones(5, dtype=torch.uint8))]
    assert sort_along_morton(merge(parts)).generated.sum() == 5
