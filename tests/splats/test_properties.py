"""Files that are more or other than plain 3DGS are named, and read right where that is certain."""

import gzip
import json
import math
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import gscompleter as gsc
from command import run
from gscompleter import InputError, load_ply, load_splat, save_ply, save_splat
from gscompleter.splats.conversion import convert_splat
from gscompleter.splats.formats import describe_oddities
from gscompleter.splats.layout import find_layout, save_like, strip
from gscompleter.splats.ply import read_scene
from gscompleter.splats.properties import find_further_properties
from scenes import random_gaussians

COUNT = 200


def add_columns(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """Replace or append columns of a .ply of ours."""
    header, body = path.read_bytes().split(b"end_header\n")
    names = [line.split()[2].decode() for line in header.splitlines() if b"property" in line]
    rows = np.frombuffer(body, "<f4").reshape(-1, len(names))
    table = {name: rows[:, place] for place, name in enumerate(names)} | columns
    lines = header.decode().partition("property")[0]
    lines += "".join(f"property float {name}\n" for name in table)
    values = np.stack(list(table.values()), axis=1).astype("<f4")
    path.write_bytes(lines.encode() + b"end_header\n" + values.tobytes())
    return path


def make(path: Path, **columns: np.ndarray) -> Path:
    """Write a scene of small Gaussians with further or other columns."""
    gaussians = random_gaussians(COUNT, seed=2)
    save_ply(path, replace(gaussians, scales=gaussians.scales * 0.3))
    return add_columns(path, columns)


RANDOM = np.random.default_rng(0)
MOVING = {"trbf_center": RANDOM.uniform(0, 1, COUNT), "trbf_scale": np.full(COUNT, -2.3)}
MOVING |= {f"motion_{i}": RANDOM.normal(0, 0.5, COUNT) for i in range(9)}
MOVING |= {f"omega_{i}": np.zeros(COUNT) for i in range(4)}
KINDS = {
    "moving": (MOVING, "is a moving splat .*trbf_center, trbf_scale, motion_0"),
    "time": ({"t": MOVING["trbf_center"], "scale_t": MOVING["trbf_scale"]}, "is a moving splat"),
    "beta": ({"beta": np.full(COUNT, 2.0)}, "another kernel than a Gaussian .*beta"),
    "shape": ({"shape": np.full(COUNT, 2.0)}, "another kernel than a Gaussian .*shape"),
    "texture": ({"texture_0": np.full(COUNT, 2.0)}, "is a textured splat .*texture_0"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_what_surely_looks_wrong_is_refused_and_can_be_gone_on_with(tmp_path, kind):
    columns, sentence = KINDS[kind]
    path = make(tmp_path / "scene.ply", **columns)
    plain = load_ply(make(tmp_path / "plain.ply"))
    for load in (load_ply, load_splat):
        with pytest.raises(InputError, match=sentence) as error:
            load(path)
        assert error.value.argument == "ignore_properties"
        assert torch.equal(load(path, ignore_properties=True).means, plain.means)
    for name in ("out.ply", "out.spz"):
        with pytest.raises(InputError, match=sentence):
            convert_splat(path, tmp_path / name)
        assert not (tmp_path / name).exists()
        assert convert_splat(path, tmp_path / name, ignore_properties=True).gaussians == COUNT
    assert len(describe_oddities(path)) == 1


def test_properties_that_change_nothing_pass_and_others_are_named(tmp_path):
    zeros = np.zeros(COUNT)
    harmless = ("red", "green", "blue", "alpha", "generated", "label", "segment_id", "confidence")
    path = make(tmp_path / "a.ply", **dict.fromkeys(harmless, zeros))
    load_ply(path)
    assert describe_oddities(path) == []
    path = make(tmp_path / "b.ply", roughness=zeros, metallic=zeros, label=zeros)
    load_ply(path)
    (line,) = describe_oddities(path)
    assert "not used: roughness, metallic." in line


def test_our_own_files_have_nothing_further(tmp_path):
    gaussians = random_gaussians(COUNT, seed=1, sh_degree=3)
    labels = torch.arange(COUNT).remainder(3).to(torch.uint8)
    save_ply(tmp_path / "a.ply", replace(gaussians, generated=labels))
    assert describe_oddities(tmp_path / "a.ply") == []
    for name in ("a.spz", "a.splat", "a.sog", "a.glb"):
        save_splat(tmp_path / name, gaussians)
        assert describe_oddities(tmp_path / name) == []


def test_names_that_tell_a_kind_come_first():
    found = find_further_properties(["x", "y", "z", "odd", "omega_0", "red"])
    assert found.names == ("omega_0", "odd")
    assert found.kind is not None


# Numbers in another form.


def decode(path: Path) -> gsc.Gaussians:
    return load_splat(path)


def raw_scales(path: Path, factor: float = 1.0) -> tuple[Path, gsc.Gaussians]:
    """Write sizes in place of their logarithms; return the Gaussians that are meant."""
    gaussians = random_gaussians(COUNT, seed=2)
    gaussians = replace(
        gaussians,
        means=gaussians.means * factor,
        scales=(gaussians.scales * 0.3).clamp(0.001, 0.1),
    )
    save_ply(path, gaussians)
    sizes = {f"scale_{i}": gaussians.scales[:, i].numpy() for i in range(3)}
    return add_columns(path, sizes), gaussians


@pytest.mark.parametrize("factor", [1.0, 30.0])
def test_sizes_without_logarithm_are_read_as_sizes(tmp_path, factor):
    path, meant = raw_scales(tmp_path / "scene.ply", factor)
    loaded = load_splat(path)
    assert (loaded.scales - meant.scales).abs().max() <= 1e-5 * meant.scales.max()
    assert torch.equal(loaded.opacities, load_splat(path).opacities)
    assert any("sizes, not their logarithms" in line for line in describe_oddities(path))
    convert_splat(path, tmp_path / "out.ply")
    written = load_splat(tmp_path / "out.ply")
    assert (written.scales - meant.scales).abs().max() <= 1e-5 * meant.scales.max()
    assert describe_oddities(tmp_path / "out.ply") == []


def test_opacities_without_logit_are_read_as_opacities(tmp_path):
    path, _ = raw_scales(tmp_path / "scene.ply")
    fractions = np.linspace(0.3, 0.8, COUNT)
    # Beside sizes that are no logarithms, any fractions are certain.
    loaded = load_splat(add_columns(path, {"opacity": fractions}))
    assert np.abs(loaded.opacities.numpy() - fractions).max() < 1e-6
    # Alone, those that fill [0, 1] are; 0 and 1 stay what they are.
    fractions = np.linspace(0, 1, COUNT)
    path = make(tmp_path / "alone.ply", opacity=fractions)
    loaded = load_splat(path)
    assert np.abs(loaded.opacities.numpy() - fractions).max() < 1e-6
    assert any("fractions, not logits" in line for line in describe_oddities(path))


def test_what_is_not_certain_is_named_and_read_as_it_stands(tmp_path):
    logits = np.linspace(0.3, 0.8, COUNT)
    path = make(tmp_path / "a.ply", opacity=logits)
    assert torch.allclose(load_splat(path).opacities, torch.from_numpy(logits).float().sigmoid())
    assert any("from 50 to 73 %" in line for line in describe_oddities(path))
    # Gaussians that are a sixth of the scene.
    large = {f"scale_{i}": np.full(COUNT, math.log(0.6)) for i in range(3)}
    path = make(tmp_path / "b.ply", **large)
    assert (load_splat(path).scales - 0.6).abs().max() < 1e-6
    assert any("Half of the Gaussians are larger" in line for line in describe_oddities(path))


def test_scenes_in_millimetres_are_no_raw_sizes(tmp_path):
    """All of their logarithms are positive, and right."""
    for name, gaussians in (("a", random_gaussians(COUNT, seed=4)),):
        scaled = replace(
            gaussians,
            means=gaussians.means * 1000,
            scales=(gaussians.scales * 300).clamp_min(1.0),
        )
        save_ply(tmp_path / f"{name}.ply", scaled)
        assert read_scene(tmp_path / f"{name}.ply").is_usual
        assert torch.allclose(load_splat(tmp_path / f"{name}.ply").scales, scaled.scales)


def test_additions_do_not_join_rows_of_raw_numbers(tmp_path):
    path, _ = raw_scales(tmp_path / "scene.ply")
    assert find_layout(path) is None
    context = load_splat(path)
    added = replace(context[:5], generated=torch.ones(5, dtype=torch.uint8), encoded=None)
    save_like(tmp_path / "completed.ply", context, added, path)
    completed = load_splat(tmp_path / "completed.ply")
    assert torch.equal(completed.scales[:COUNT], context.scales)
    assert torch.allclose(completed.scales[COUNT:], added.scales)
    strip(tmp_path / "completed.ply", tmp_path / "context.ply")
    assert torch.equal(load_splat(tmp_path / "context.ply").scales, context.scales)


# Commands.


def test_commands_say_what_they_ignore(tmp_path, monkeypatch, capsys):
    path = make(tmp_path / "moving.ply", **MOVING)
    assert run(monkeypatch, "inspect", str(path), "--json") == 0
    assert "looks like a moving splat" in json.loads(capsys.readouterr().out)["notes"][0]
    assert run(monkeypatch, "inspect", str(path)) == 0
    assert "looks like a moving splat (trbf_center" in capsys.readouterr().out
    out = tmp_path / "out.ply"
    assert run(monkeypatch, "convert", str(path), str(out)) == 2
    assert "(--ignore-properties)" in capsys.readouterr().err
    assert run(monkeypatch, "convert", str(path), str(out), "--ignore-properties") == 0
    assert "looks like a moving splat" in capsys.readouterr().out


@pytest.mark.slow
def test_complete_refuses_a_moving_splat(tmp_path, monkeypatch, capsys):
    path = make(tmp_path / "moving.ply", **MOVING)
    assert run(monkeypatch, "complete", str(path), "--auto", "--out", str(tmp_path / "OUT")) == 2
    assert "all of its moments would be shown at once" in capsys.readouterr().err


# Other formats.


def add_to_glb(path: Path, name: str) -> Path:
    """Give the Gaussians of a .glb an attribute more, whose numbers are their opacities."""
    data = path.read_bytes()
    size = int.from_bytes(data[12:16], "little")
    table = json.loads(data[20 : 20 + size])
    attributes = table["meshes"][0]["primitives"][0]["attributes"]
    attributes[name] = attributes["KHR_gaussian_splatting:OPACITY"]
    text = json.dumps(table).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    total = 20 + len(text) + len(rest)
    header = data[:8] + total.to_bytes(4, "little") + len(text).to_bytes(4, "little")
    path.write_bytes(header + data[16:20] + text + rest)
    return path


def add_to_sog(path: Path, name: str) -> Path:
    """Give the Gaussians of a .sog an image more, which is that of their colours."""
    with zipfile.ZipFile(path) as bundle:
        files = {entry: bundle.read(entry) for entry in bundle.namelist()}
    table = json.loads(files["meta.json"])
    table[name] = {"files": table["sh0"]["files"]}
    files["meta.json"] = json.dumps(table).encode()
    with zipfile.ZipFile(path, "w") as bundle:
        for entry, content in files.items():
            bundle.writestr(entry, content)
    return path


def add_to_compressed(path: Path, name: str) -> Path:
    """Give the Gaussians of a compressed .ply a property more."""
    header, body = path.read_bytes().split(b"end_header\n")
    after = b"property uint packed_color\n"
    bounds = 4 * 18 * math.ceil(COUNT / 256)
    rows = np.frombuffer(body[bounds:], "<u4", 4 * COUNT).reshape(COUNT, 4)
    wider = np.column_stack([rows, np.ones(COUNT, "<f4").view("<u4")])
    rest = body[bounds + rows.nbytes :]
    header = header.replace(after, after + f"property float {name}\n".encode())
    path.write_bytes(header + b"end_header\n" + body[:bounds] + wider.tobytes() + rest)
    return path


@pytest.mark.parametrize(
    ("ending", "add", "moving", "harmless", "odd"),
    [
        (".glb", add_to_glb, "_TRBF_CENTER", "_CONFIDENCE", "_ODD"),
        (".sog", add_to_sog, "trbf_center", "confidence", "odd"),
        (".compressed.ply", add_to_compressed, "trbf_center", "confidence", "odd"),
    ],
)
def test_properties_of_other_formats_are_named_by_the_same_table(
    tmp_path, ending, add, moving, harmless, odd
):
    def write(name: str) -> Path:
        path = tmp_path / f"{name}{ending}"
        save_splat(path, random_gaussians(COUNT, seed=2))
        return path

    plain = write("plain")
    assert describe_oddities(plain) == []
    path = add(write("moving"), moving)
    with pytest.raises(InputError, match=r"is a moving splat \(trbf_center\)"):
        load_splat(path)
    assert torch.equal(load_splat(path, ignore_properties=True).means, load_splat(plain).means)
    assert "looks like a moving splat (trbf_center)" in describe_oddities(path)[0]
    assert describe_oddities(add(write("harmless"), harmless)) == []
    path = add(write("odd"), odd)
    assert torch.equal(load_splat(path).means, load_splat(plain).means)
    assert describe_oddities(path) == [
        "Properties that plain 3DGS does not have are not used: odd."
    ]


def test_extensions_of_a_spz_are_named(tmp_path):
    path = tmp_path / "splat.spz"
    save_splat(path, random_gaussians(COUNT, seed=2))
    assert describe_oddities(path) == []
    data = bytearray(gzip.decompress(path.read_bytes()))
    data[14] |= 2
    path.write_bytes(gzip.compress(bytes(data)))
    assert describe_oddities(path) == [
        "Properties that plain 3DGS does not have are not used: extensions."
    ]
    assert len(load_splat(path)) == COUNT
