"""A completed scene restores its input file, byte for byte."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch

from command import run
from gscompleter import Gaussians, load_ply, load_splat, merge, save_ply, save_splat
from gscompleter.splats.layout import save_like, save_removed
from scenes import labelled, random_gaussians


def added(count: int = 20, sh_degree: int = 0) -> Gaussians:
    """Make Gaussians generated for two targets."""
    new = random_gaussians(count, seed=9, sh_degree=sh_degree)
    return replace(new, generated=(torch.arange(count) % 2 + 1).to(torch.uint8))


def stripped(monkeypatch: pytest.MonkeyPatch, completed: Path, name: str = "context.ply") -> bytes:
    out = completed.parent / f"stripped-{name}"
    assert run(monkeypatch, "strip", completed, "--out", out, "--quiet") == 0
    return out.read_bytes()


def foreign(path: Path) -> Path:
    """Write a .ply of another program: a comment, normals, two more columns, another order."""
    save_ply(path, random_gaussians(60, sh_degree=1))
    vertex = plyfile.PlyData.read(str(path))["vertex"].data
    names = list(vertex.dtype.names)
    layout = [("label", "<i4"), *((n, "<f4") for n in reversed(names)), ("confidence", "<f8")]
    rows = np.zeros(60, layout)
    for name in names:
        rows[name] = vertex[name]
    rows["nx"], rows["label"], rows["confidence"] = 0.6, np.arange(60), np.pi
    element = plyfile.PlyElement.describe(rows, "vertex")
    eyes = plyfile.PlyElement.describe(np.array([(1, 2)], [("a", "u1"), ("b", "<f4")]), "eyes")
    plyfile.PlyData([element, eyes], comments=["element vertex 5"]).write(str(path))
    return path


@pytest.mark.parametrize("degrees", [(0, 0), (3, 3), (3, 0), (0, 2), (1, 3)])
def test_a_scene_that_we_wrote_comes_back(tmp_path, monkeypatch, degrees):
    """SH padding for the added Gaussians is removed, too."""
    given, new = degrees
    save_ply(tmp_path / "given.ply", random_gaussians(50, sh_degree=given))
    scene = merge([load_ply(tmp_path / "given.ply"), added(sh_degree=new)])
    save_ply(tmp_path / "completed.ply", scene, provenance=True)
    expected = (tmp_path / "given.ply").read_bytes()
    assert stripped(monkeypatch, tmp_path / "completed.ply") == expected


def test_a_scene_to_which_nothing_was_added_comes_back(tmp_path, monkeypatch):
    save_ply(tmp_path / "given.ply", random_gaussians(50))
    for provenance in (False, True):
        save_ply(tmp_path / "completed.ply", load_ply(tmp_path / "given.ply"), provenance)
        context = stripped(monkeypatch, tmp_path / "completed.ply", f"{provenance}.ply")
        assert context == (tmp_path / "given.ply").read_bytes()


def test_a_file_of_another_program_comes_back(tmp_path, monkeypatch):
    given = foreign(tmp_path / "given.ply")
    scene = merge([load_ply(given), added(sh_degree=1)])
    save_like(tmp_path / "completed.ply", load_ply(given), added(sh_degree=1), given)
    loaded = load_ply(tmp_path / "completed.ply")
    for field in ("means", "quats", "scales", "opacities", "sh", "generated"):
        assert torch.allclose(getattr(loaded, field), getattr(scene, field), rtol=1e-5)
    assert len(plyfile.PlyData.read(str(tmp_path / "completed.ply"))["eyes"].data) == 1
    assert stripped(monkeypatch, tmp_path / "completed.ply") == given.read_bytes()


def test_removed_rows_of_a_file_with_further_elements_come_back(tmp_path, monkeypatch):
    given = foreign(tmp_path / "given.ply")
    scene, rows = load_ply(given), torch.tensor([1, 3])
    kept = torch.ones(len(scene), dtype=torch.bool)
    kept[rows] = False
    save_like(tmp_path / "completed.ply", scene[kept], added(sh_degree=1), given, kept)
    save_removed(tmp_path / "removed.ply", scene[rows], rows, given)
    assert stripped(monkeypatch, tmp_path / "completed.ply") == given.read_bytes()


@pytest.mark.parametrize("comment", ["SplatRenderMode: mip", "antialiased 1"])
@pytest.mark.parametrize("aside", [0, 7])
def test_an_antialiased_scene_is_completed_as_one_and_comes_back(
    tmp_path, monkeypatch, comment, aside
):
    given = labelled(tmp_path / "given.ply", random_gaussians(40, sh_degree=1))
    line = f"comment {comment}\nelement vertex".encode()
    given.write_bytes(given.read_bytes().replace(b"element vertex", line, 1))
    scene, rows = load_ply(given), torch.arange(aside)
    kept = torch.ones(len(scene), dtype=torch.bool)
    kept[rows] = False
    new = replace(added(sh_degree=1), is_antialiased=True)
    save_like(tmp_path / "completed.ply", scene[kept], new, given, kept)
    if aside:
        save_removed(tmp_path / "removed.ply", scene[rows], rows, given)
        assert load_ply(tmp_path / "removed.ply").is_antialiased
    assert load_ply(tmp_path / "completed.ply").is_antialiased
    assert stripped(monkeypatch, tmp_path / "completed.ply") == given.read_bytes()


def test_a_removed_ply_of_another_mode_is_refused(tmp_path, monkeypatch, capsys):
    scene = random_gaussians(20)
    save_ply(tmp_path / "completed.ply", replace(scene, is_antialiased=True))
    save_removed(tmp_path / "removed.ply", scene[:2], torch.arange(2))
    out = tmp_path / "out.ply"
    assert run(monkeypatch, "strip", tmp_path / "completed.ply", "--out", out) == 2
    assert "does not say where its Gaussians belong" in capsys.readouterr().err.replace("\n", " ")
    assert not out.exists()


@pytest.mark.parametrize("options", [{"text": True}, {"byte_order": ">"}])
def test_ascii_and_big_endian_scenes(tmp_path, monkeypatch, options):
    save_ply(tmp_path / "ours.ply", random_gaussians(30))
    data = plyfile.PlyData.read(str(tmp_path / "ours.ply"))
    given = tmp_path / "given.ply"
    plyfile.PlyData(list(data.elements), **options).write(str(given))
    save_like(tmp_path / "completed.ply", load_ply(given), added(), given)
    context = stripped(monkeypatch, tmp_path / "completed.ply")
    # An ASCII file keeps its values, not its digits.
    kept = tmp_path / "ours.ply" if "text" in options else given
    assert len(load_ply(tmp_path / "stripped-context.ply")) == 30
    assert "text" in options or context == kept.read_bytes()


def with_bytes(path: Path) -> None:
    """Write labels as earlier versions did: one byte behind the other properties."""
    header, end, body = path.read_bytes().partition(b"end_header\n")
    vertex = plyfile.PlyData.read(str(path), mmap=False)["vertex"].data
    rows = vertex.astype([(n, "u1" if n == "generated" else k) for n, k in vertex.dtype.descr])
    assert b"property float generated\n" in header
    header = header.replace(b"property float generated", b"property uchar generated")
    path.write_bytes(header + end + rows.tobytes() + body[vertex.nbytes :])


@pytest.mark.parametrize("kind", ["ours", "foreign", "big-endian"])
def test_a_result_of_an_earlier_version_is_completed_again_and_comes_back(
    tmp_path, monkeypatch, kind
):
    given = tmp_path / "given.ply"
    if kind == "foreign":
        foreign(given)
        degree = 1
    else:
        degree = 0
        save_ply(given, random_gaussians(60))
        data = plyfile.PlyData.read(str(given), mmap=False)
        order = "<" if kind == "ours" else ">"
        plyfile.PlyData(list(data.elements), byte_order=order).write(str(given))
    expected = given.read_bytes()
    earlier, further = tmp_path / "earlier.ply", tmp_path / "further.ply"
    save_like(earlier, load_ply(given), added(sh_degree=degree), given)
    new = load_ply(earlier)
    with_bytes(earlier)
    for name in ("means", "scales", "opacities", "sh", "generated"):
        assert torch.equal(getattr(load_ply(earlier), name), getattr(new, name)), name
    assert stripped(monkeypatch, earlier, "earlier.ply") == expected

    # Completed again, with some of its Gaussians set aside, all labels are floats.
    scene, rows = load_ply(earlier), torch.tensor([0, 7, 59])
    kept = torch.ones(len(scene), dtype=torch.bool)
    kept[rows] = False
    save_like(further, scene[kept], added(9, degree), earlier, kept)
    vertex = plyfile.PlyData.read(str(further))["vertex"].data
    assert vertex.dtype["generated"].newbyteorder("=") == np.float32
    labels = torch.cat([scene.generated[kept], added(9).generated])
    assert np.array_equal(vertex["generated"], labels.numpy())
    assert torch.equal(load_ply(further).generated, labels)
    save_removed(tmp_path / "removed.ply", scene[rows], rows, earlier)
    assert stripped(monkeypatch, further, "further.ply") == expected


@pytest.mark.parametrize("case", ["labelled", "fewer harmonics", "another scene", "spz"])
def test_where_the_layout_cannot_be_kept_ours_is_written(tmp_path, case):
    given, context = tmp_path / "given.ply", replace(random_gaussians(30), is_antialiased=True)
    if case == "labelled":
        context = replace(context, generated=torch.ones(30, dtype=torch.uint8))
    if case == "spz":
        given = tmp_path / "given.spz"
    save_splat(given, context)
    first = load_splat(given)
    if case == "another scene":
        first = replace(random_gaussians(30, seed=4), is_antialiased=True)
    more = replace(added(sh_degree=1 if case == "fewer harmonics" else 0), is_antialiased=True)
    save_like(tmp_path / "completed.ply", first, more, given)
    save_ply(tmp_path / "ours.ply", merge([first, more]), provenance=True)
    assert (tmp_path / "completed.ply").read_bytes() == (tmp_path / "ours.ply").read_bytes()
    assert load_ply(tmp_path / "completed.ply").is_antialiased


@pytest.mark.parametrize("harmonics", [0, 2])
def test_what_was_set_aside_is_put_back_in_order(tmp_path, monkeypatch, harmonics):
    save_ply(tmp_path / "given.ply", random_gaussians(50, sh_degree=harmonics))
    given = load_ply(tmp_path / "given.ply")
    rows = torch.tensor([0, 7, 8, 30, 49])
    kept = torch.ones(50, dtype=torch.bool)
    kept[rows] = False
    save_removed(tmp_path / "removed.ply", given[rows], rows)
    assert torch.equal(load_ply(tmp_path / "removed.ply").means, given.means[rows])
    for sh_degree in (0, 3):
        scene = merge([given[kept], added(sh_degree=sh_degree)])
        save_ply(tmp_path / "completed.ply", scene, provenance=True)
        context = stripped(monkeypatch, tmp_path / "completed.ply", f"{sh_degree}.ply")
        assert context == (tmp_path / "given.ply").read_bytes()


def test_a_removed_ply_of_another_scene_is_refused(tmp_path, monkeypatch, capsys):
    completed, removed = tmp_path / "completed.ply", tmp_path / "removed.ply"
    save_ply(completed, merge([random_gaussians(10), added()]), provenance=True)

    def refused(sentence: str) -> None:
        assert run(monkeypatch, "strip", completed, "--out", tmp_path / "context.ply") == 2
        assert sentence in capsys.readouterr().err

    save_ply(removed, random_gaussians(2))
    refused("does not say where its Gaussians belong")
    save_removed(removed, random_gaussians(2), torch.tensor([3, 99]))
    refused("does not say where")
    save_removed(removed, random_gaussians(2), torch.tensor([3, 3]))
    refused("does not say where")
    removed.unlink()
    save_ply(completed, added())
    refused("holds only generated Gaussians")
    assert run(monkeypatch, "strip", removed, "--out", tmp_path / "context.ply") == 2
    assert not (tmp_path / "context.ply").exists()


def test_other_formats_give_back_what_they_hold(tmp_path, monkeypatch):
    scene = merge([random_gaussians(40), added()])
    save_splat(tmp_path / "completed.splat", scene)
    stripped(monkeypatch, tmp_path / "completed.splat", "context.splat")
    context = load_splat(tmp_path / "stripped-context.splat")
    assert torch.equal(context.means, scene.means[:40])
    assert not context.generated.any()
