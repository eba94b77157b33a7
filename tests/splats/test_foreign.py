"""Files that are no splat are named for what they are, and intact ones are never called damaged."""

import gzip
import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch

from gscompleter import InputError, load_splat, save_ply, save_splat
from gscompleter.splats import ply
from gscompleter.splats.foreign import refuse_folder
from scenes import random_gaussians


def vertices(names: list[str], faces: bool = False) -> bytes:
    rows = np.zeros(4, [(name, "<f4") for name in names])
    elements = [plyfile.PlyElement.describe(rows, "vertex")]
    if faces:
        corners = np.array([([0, 1, 2],)], dtype=[("vertex_indices", "O")])
        elements.append(plyfile.PlyElement.describe(corners, "face"))
    file = io.BytesIO()
    plyfile.PlyData(elements, byte_order="<").write(file)
    return file.getvalue()


def zipped(files: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as made:
        for name, data in files.items():
            made.writestr(name, data)
    return file.getvalue()


def checkpoint(**options) -> bytes:
    file = io.BytesIO()
    torch.save({"step": 3, "pipeline": {"means": torch.zeros(3, 3)}}, file, **options)
    return file.getvalue()


def glb(table: dict) -> bytes:
    text = json.dumps(table).encode()
    text += b" " * (-len(text) % 4)
    chunk = struct.pack("<II", len(text), 0x4E4F534A) + text
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunk)) + chunk


GLTF = {"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
POINTS = ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]
ANCHORS = ["x", "y", "z", "f_offset_0", "f_anchor_feat_0", "opacity", "scale_0", "rot_0"]
DRAFT = GLTF | {
    "accessors": [{"count": 0}],
    "meshes": [
        {
            "primitives": [
                {
                    "attributes": {"POSITION": 0, "_ROTATION": 0},
                    "extensions": {"KHR_gaussian_splatting": {}},
                }
            ]
        }
    ],
}
PACKED = GLTF | {
    "extensionsUsed": ["EXT_gaussian_splatting_of_others"],
    "meshes": [{"primitives": [{"attributes": {}}]}],
}
MESH = GLTF | {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}]}

FOREIGN = {
    "model.ckpt": (checkpoint(), "is a checkpoint of a trainer"),
    "model.pth": (checkpoint(_use_new_zipfile_serialization=False), "is a checkpoint of a trainer"),
    "splat.ply.pt": (checkpoint(), "is a checkpoint of a trainer"),
    "renamed.ply": (checkpoint(), "is a checkpoint of a trainer"),
    "photos.zip": (zipped({"a.jpg": b"x"}), "is a .zip archive without a splat"),
    "export.zip": (
        zipped({"out/splat.ply": b"ply"}),
        "is a .zip archive; unpack it, and name out/",
    ),
    "mac.zip": (
        zipped({"__MACOSX/._a.ply": b"x", "a.ply": b"ply"}),
        "unpack it, and name a.ply in it",
    ),
    "scene.ply.gz": (gzip.compress(b"ply\nformat"), "is packed with gzip; unpack it"),
    "scene.gltf": (json.dumps(GLTF).encode(), "is glTF with its data in other files"),
    "draft.glb": (glb(DRAFT), "stores Gaussians as a draft of KHR_gaussian_splatting did"),
    "packed.glb": (glb(PACKED), "EXT_gaussian_splatting_of_others, a draft or another"),
    "mesh.glb": (glb(MESH), "holds a mesh or points, no Gaussians"),
    "points.ply": (vertices(POINTS), "is no 3DGS scene but a point cloud"),
    "mesh.ply": (vertices(POINTS, faces=True), "is no 3DGS scene but a mesh"),
    "anchors.ply": (vertices(ANCHORS), "but anchors of Scaffold-GS"),
    "points.las": (b"LASF" + bytes(200), "is a point cloud"),
    "points.pcd": (b"# .PCD v0.7\n", "is a point cloud"),
    "points.xyz": (b"0 0 0\n", "is a point cloud"),
    "mesh.obj": (b"v 0 0 0\n", "is a mesh"),
    "lod-meta.json": (b'{"lodLevels": 3, "filenames": []}', "index of a streamed scene"),
    "garden.rad": (b"RAD0" + bytes(60), "is a .rad of Spark, in levels of detail"),
    "renamed.splat": (b"RAD0" + bytes(60), "is a .rad of Spark, in levels of detail"),
    "flame.splatv": (b"Kg\0\0" + bytes(60), "is a moving splat of splaTV"),
    "checkpoint_7000.resume": (b"PKFL" + bytes(60), "is a checkpoint of LichtFeld Studio"),
    "scene.spx": (b"spx\x01" + bytes(124), "is a .spx of Reall3D"),
    "meta.lcc": (b'{"version": "4", "totalSplats": 5, "totalLevel": 3}', "a scene of XGRIDS"),
    "scene.lcc2": (b'{"totalSplats": 5, "splatType": ".sog"}', "a scene of XGRIDS"),
    "room.ssproj": (zipped({"document.json": b"{}", "splat_0.ply": b"ply"}), "of SuperSplat"),
    "room.psht": (b"\x01\x02" + bytes(60), "is a project of Postshot"),
    "transforms.json": (b'{"frames": []}', "is a JSON file without Gaussians"),
    "cut.json": (b'{"frames": [', "is a JSON file without Gaussians"),
    "packed.splat": (gzip.compress(b"ply\nformat", mtime=0), "is packed with gzip; unpack it"),
    "settings.splat": (b'{"a": 1}', "is a JSON file without Gaussians"),
    "settings.txt": (b"[section]\nkey = 1\n", "holds no Gaussians in a format that is known"),
    "cameras.json": (b"[]", "is a JSON file without Gaussians"),
    "page.ply": (b"<!DOCTYPE html><html>", "is a web page; download the file"),
    "other.bin": (b"hello", "holds no Gaussians in a format that is known"),
    "new.spz": (b"NGSP" + struct.pack("<IIBBBB", 9, 1, 0, 12, 0, 0), "is .spz version 9"),
    "high.spz": (
        b"NGSP" + struct.pack("<IIBBBB", 3, 1, 4, 12, 0, 0),
        "harmonics of SH degree 4, .* convert",
    ),
    "new.ksplat": (b"\x09" + bytes(4095), "is .ksplat version 9"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_file_of_another_kind_is_named_for_what_it_is(tmp_path, name):
    data, sentence = FOREIGN[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=sentence) as error:
        load_splat(tmp_path / name)
    said = str(error.value).replace(name, "")
    assert "meta.json" not in said
    assert ".sog" not in said
    assert not any(word in said for word in ("fetch", "damaged", "truncated", "again"))
    assert "\n" not in said
    assert len(said) <= 300


@pytest.mark.parametrize("start", [b"{", b"[", b" \n{", b"\x1f\x8b", b"\x1f\x8b\x08"])
def test_a_splat_without_a_header_may_begin_with_any_bytes(tmp_path, start):
    """The first bytes of a .splat are those of a coordinate."""
    scene = random_gaussians(5)
    number = start + b"\x14\x9e\x3f"[len(start) - 1 :]
    scene.means[0, 0] = np.frombuffer(number, "<f4")[0].item()
    save_splat(tmp_path / "scene.splat", scene)
    assert (tmp_path / "scene.splat").read_bytes().startswith(start)
    assert load_splat(tmp_path / "scene.splat").means[0, 0] == scene.means[0, 0]


@pytest.mark.parametrize("content", ['{"scene": "x"}', '[{"frame": 1}]'])
def test_a_meta_json_of_something_else_does_not_hide_a_splat(tmp_path, content):
    (tmp_path / "meta.json").write_text(content)
    with pytest.raises(InputError, match="is a folder without a splat"):
        load_splat(tmp_path)
    save_ply(tmp_path / "splat.ply", random_gaussians(3))
    assert len(load_splat(tmp_path)) == 3


def test_a_damaged_meta_json_is_that_of_a_sog(tmp_path):
    save_ply(tmp_path / "splat.ply", random_gaussians(3))
    (tmp_path / "meta.json").write_text('{"version": 2, "mea')
    with pytest.raises(InputError, match="cannot be read"):
        load_splat(tmp_path)


def test_a_folder_that_cannot_be_listed_is_not_called_empty(tmp_path, monkeypatch):
    def refuse(path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("os.listdir", refuse)
    with pytest.raises(InputError, match="cannot be read: Permission denied"):
        refuse_folder(tmp_path)


def test_hidden_files_are_not_named(tmp_path):
    for name in ("._a.ply", "b.ply", "._meta.lcc"):
        (tmp_path / name).write_bytes(b"ply")
    with pytest.raises(InputError, match=r"such as b\.ply"):
        load_splat(tmp_path)


def test_a_folder_of_a_streamed_scene_is_named(tmp_path):
    (tmp_path / "lod-meta.json").write_text('{"lodLevels": 2}')
    with pytest.raises(InputError, match="is a streamed scene .* in several levels of detail"):
        load_splat(tmp_path)


def test_the_folder_of_a_scene_of_xgrids_is_named(tmp_path):
    for name in ("meta.lcc", "data.bin", "index.bin"):
        (tmp_path / name).write_bytes(b"{}")
    with pytest.raises(InputError, match=r"meta\.lcc, which is the index of a scene of XGRIDS"):
        load_splat(tmp_path)


def test_a_folder_of_pngs_of_gsplat_is_named(tmp_path):
    entry = {"shape": [9, 3], "dtype": "float32", "mins": [0], "maxs": [1]}
    (tmp_path / "meta.json").write_text(json.dumps({"means": entry, "scales": entry}))
    (tmp_path / "means_l.png").write_bytes(b"png")
    with pytest.raises(InputError, match="that gsplat compressed to PNGs"):
        load_splat(tmp_path)


def test_a_newer_sog_is_named_with_its_version(tmp_path):
    (tmp_path / "meta.json").write_text(json.dumps({"version": 3, "count": 1, "means": {}}))
    with pytest.raises(InputError, match=r"is a \.sog of version 3, and versions 1 and 2 are read"):
        load_splat(tmp_path)


def damaged_sog(tmp_path: Path, method: int) -> Path:
    """Write a .sog packed by another method, with damage in its first entry."""
    save_splat(tmp_path / "plain.sog", random_gaussians(60))
    path = tmp_path / "scene.sog"
    with zipfile.ZipFile(tmp_path / "plain.sog") as old, zipfile.ZipFile(path, "w", method) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    data = bytearray(path.read_bytes())
    start = 30 + sum(struct.unpack("<HH", data[26:30])) + 9
    data[start : start + 40] = b"\xff" * 40
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_damaged_bundle_of_any_packing_is_refused(tmp_path, method):
    with pytest.raises(InputError, match="cannot be read"):
        load_splat(damaged_sog(tmp_path, method))


def test_sentences_about_images_name_them(tmp_path):
    """Pillow's own sentence holds the address of an object, which differs from run to run."""
    save_splat(tmp_path / "scene.sog", random_gaussians(60))
    with zipfile.ZipFile(tmp_path / "scene.sog") as old:
        files = {name: old.read(name) for name in old.namelist()}
    with zipfile.ZipFile(tmp_path / "scene.sog", "w") as new:
        for name, data in (files | {"quats.webp": b"no image"}).items():
            new.writestr(name, data)
    with pytest.raises(InputError, match=r"its quats\.webp is no WebP image"):
        load_splat(tmp_path / "scene.sog")


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("you can't allocate memory: 9")])
def test_a_splat_that_does_not_fit_into_memory_is_no_traceback(tmp_path, monkeypatch, error):
    save_ply(tmp_path / "scene.ply", random_gaussians(5))

    def exhaust(scene):
        raise error

    monkeypatch.setattr(ply, "decode_gaussians", exhaust)
    with pytest.raises(InputError, match="needs more memory than there is"):
        load_splat(tmp_path / "scene.ply")


@pytest.mark.parametrize(
    "name", ["a.ply", "a.splat", "a.spz", "a.sog", "a.glb", "a.compressed.ply"]
)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gaussians_that_require_gradients_are_written(tmp_path, name, degree):
    learned = random_gaussians(30, sh_degree=degree)
    for part in (learned.means, learned.quats, learned.scales, learned.opacities, learned.sh):
        part.requires_grad_()
    save_splat(tmp_path / name, learned)
    assert len(load_splat(tmp_path / name)) == 30


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "name", ["a.ply", "a.splat", "a.spz", "a.sog", "a.glb", "a.compressed.ply"]
)
@pytest.mark.parametrize(
    ("part", "value"),
    [("quats", 1e17), ("quats", 1e-10), ("scales", 0.0), ("sh", 9e5), ("sh", -9e5)],
)
def test_what_is_written_can_be_read(tmp_path, name, part, value):
    gaussians = random_gaussians(30)
    getattr(gaussians, part)[3] = value
    save_splat(tmp_path / name, gaussians)
    loaded = load_splat(tmp_path / name)
    assert len(loaded) == 30
    assert loaded.quats.isfinite().all()


@pytest.mark.parametrize(
    "name", ["a.ply", "a.splat", "a.spz", "a.sog", "a.glb", "a.compressed.ply"]
)
@pytest.mark.parametrize(("part", "value"), [("quats", 1e38), ("quats", 0.0), ("sh", -1e38)])
def test_what_could_not_be_read_is_not_written(tmp_path, name, part, value):
    gaussians = random_gaussians(30)
    getattr(gaussians, part)[3] = value
    with pytest.raises(InputError, match="The scene to write has 1 of 30 Gaussians"):
        save_splat(tmp_path / name, gaussians)
