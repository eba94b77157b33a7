"""PLY scenes: exact round trips, files of others, and a sentence for every damaged one."""

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from gsply import plyread

from full_disk import limit_file_size
from gscompleter import Gaussians, InputError, load_ply, merge, save_ply
from gscompleter.splats.formats import describe_oddities
from gscompleter.system.files.ply import read_ply_file
from scenes import random_gaussians, scaled

FIELDS = ("means", "quats", "scales", "opacities", "sh", "generated", "encoded")


def saved(tmp_path: Path, gaussians: Gaussians, name: str = "scene.ply") -> Path:
    save_ply(tmp_path / name, gaussians)
    return tmp_path / name


def rewritten(path: Path, out: Path, **options) -> Path:
    """Write the file again with plyfile and its `options` (text, byte_order)."""
    data = plyfile.PlyData.read(str(path))
    plyfile.PlyData(list(data.elements), **options).write(str(out))
    return out


def same(a: Gaussians, b: Gaussians, fields=FIELDS) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in fields)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_file_written_read_and_written_again_has_the_same_bytes(tmp_path, degree):
    first = saved(tmp_path, random_gaussians(500, sh_degree=degree))
    again = saved(tmp_path, load_ply(first), "again.ply")
    assert first.read_bytes() == again.read_bytes()
    assert same(load_ply(first), load_ply(again))


@pytest.mark.parametrize("degree", [0, 3])
def test_what_was_saved_is_loaded_exactly_where_the_file_holds_it_linearly(tmp_path, degree):
    gaussians = random_gaussians(500, sh_degree=degree)
    gaussians = replace(gaussians, generated=torch.arange(500).to(torch.uint8))
    loaded = load_ply(saved(tmp_path, gaussians))
    assert same(gaussians, loaded, ("means", "quats", "sh", "generated"))
    assert torch.allclose(loaded.scales, gaussians.scales, rtol=1e-6)
    assert torch.allclose(loaded.opacities, gaussians.opacities, rtol=1e-5)


def test_any_bits_of_scale_and_opacity_survive_a_round_trip(tmp_path):
    """Exponential and logarithm are no exact inverses in float32; the file's values stay."""
    n = 4000
    encoded = torch.randn(n, 4, generator=torch.Generator().manual_seed(0)) * 6
    path = saved(tmp_path, random_gaussians(n))
    data = plyfile.PlyData.read(str(path))
    for column, name in enumerate(("scale_0", "scale_1", "scale_2", "opacity")):
        data["vertex"][name] = encoded[:, column].numpy()
    path = tmp_path / "any.ply"
    data.write(str(path))
    loaded = load_ply(path)
    assert torch.equal(loaded.encoded, encoded)
    assert saved(tmp_path, loaded, "again.ply").read_bytes() == path.read_bytes()


def test_a_changed_opacity_is_written_and_not_the_one_the_file_held(tmp_path):
    loaded = load_ply(saved(tmp_path, random_gaussians(50)))
    changed = replace(loaded, opacities=loaded.opacities * 0.5)
    again = load_ply(saved(tmp_path, changed, "again.ply"))
    assert torch.allclose(again.opacities, 0.5 * loaded.opacities, rtol=1e-5)
    assert torch.equal(again.scales, loaded.scales)


def test_a_merged_scene_keeps_the_bits_of_the_part_that_was_loaded(tmp_path):
    loaded = load_ply(saved(tmp_path, random_gaussians(50, sh_degree=3)))
    whole = load_ply(saved(tmp_path, merge([loaded, random_gaussians(20, seed=1)]), "whole.ply"))
    assert same(whole[:50], loaded)
    assert len(whole) == 70


def test_extreme_values_are_written_as_finite_ones(tmp_path):
    gaussians = random_gaussians(3)
    gaussians = replace(
        gaussians, opacities=torch.tensor([0.0, 1.0, 0.5]), scales=torch.zeros(3, 3)
    )
    loaded = load_ply(saved(tmp_path, gaussians))
    assert loaded.encoded.isfinite().all()
    assert loaded.opacities[0] < 1e-12
    assert loaded.opacities[1] > 0.9999999
    assert (loaded.scales < 1e-37).all()


def test_other_libraries_read_what_we_write(tmp_path):
    gaussians = random_gaussians(200, sh_degree=3)
    path = saved(tmp_path, gaussians)
    vertex = plyfile.PlyData.read(str(path))["vertex"]
    assert np.array_equal(vertex["x"], gaussians.means[:, 0].numpy())
    assert np.array_equal(vertex["f_rest_0"], gaussians.sh[:, 1, 0].numpy())
    assert np.array_equal(vertex["f_rest_15"], gaussians.sh[:, 1, 1].numpy())
    assert np.allclose(vertex["scale_1"], gaussians.scales[:, 1].log().numpy(), atol=1e-6)
    theirs = plyread(str(path))
    assert np.array_equal(np.asarray(theirs.means), gaussians.means.numpy())
    assert np.array_equal(np.asarray(theirs.quats), gaussians.quats.numpy())
    assert np.allclose(np.asarray(theirs.scales), gaussians.scales.log().numpy(), atol=1e-6)


def test_provenance_is_written_where_there_is_any_or_it_is_asked_for(tmp_path):
    gaussians = random_gaussians(4)

    def written(gaussians: Gaussians, **options) -> list[int] | None:
        save_ply(tmp_path / "scene.ply", gaussians, **options)
        vertex = plyfile.PlyData.read(str(tmp_path / "scene.ply"))["vertex"].data
        return vertex["generated"].tolist() if "generated" in vertex.dtype.names else None

    marked = replace(gaussians, generated=torch.tensor([0, 1, 255, 0], dtype=torch.uint8))
    assert written(gaussians) is None
    assert written(gaussians, provenance=True) == [0, 0, 0, 0]
    assert written(marked) == [0, 1, 255, 0]
    assert written(marked, provenance=False) is None


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_a_reader_that_takes_every_property_for_a_float_reads_the_same(tmp_path, sh_degree):
    """As gsply and many others do."""
    gaussians = random_gaussians(40, sh_degree=sh_degree)
    labels = torch.arange(40, dtype=torch.uint8) * 6
    path = saved(tmp_path, replace(gaussians, generated=labels))
    header, _, body = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1].decode() for line in header.splitlines() if b"property" in line]
    table = dict(zip(names, np.frombuffer(body, "<f4").reshape(40, -1).T, strict=True))
    assert np.array_equal(table["x"], gaussians.means[:, 0].numpy())
    assert np.array_equal(table["generated"], labels.numpy())
    assert np.allclose(table["opacity"], gaussians.opacities.logit().numpy(), atol=1e-4)
    theirs = plyread(str(path))
    assert np.array_equal(np.asarray(theirs.means), gaussians.means.numpy())
    assert np.allclose(np.asarray(theirs.opacities), gaussians.opacities.logit().numpy(), atol=1e-4)


@pytest.mark.parametrize("kind", ["u1", "<f4", ">f4", "<i4", "f8"])
def test_labels_of_any_type_are_read(tmp_path, kind):
    gaussians = replace(random_gaussians(40), generated=torch.arange(40, dtype=torch.uint8) * 6)
    vertex = plyfile.PlyData.read(str(saved(tmp_path, gaussians)))["vertex"].data
    rows = vertex.astype([(n, kind if n == "generated" else "<f4") for n in vertex.dtype.names])
    element = plyfile.PlyElement.describe(rows, "vertex")
    plyfile.PlyData([element], byte_order="<").write(str(tmp_path / "other.ply"))
    assert torch.equal(load_ply(tmp_path / "other.ply").generated, gaussians.generated)


@pytest.mark.parametrize(
    "options", [{"byte_order": ">"}, {"byte_order": "<"}, {"text": True}], ids=str
)
def test_every_byte_order_and_ascii_are_read(tmp_path, options):
    path = saved(tmp_path, random_gaussians(40, sh_degree=1))
    assert same(load_ply(rewritten(path, tmp_path / "other.ply", **options)), load_ply(path))


def foreign(path: Path, out: Path, byte_order: str = "<", text: bool = False) -> Path:
    """Write the scene in doubles, shuffled, among other properties and elements with lists."""
    vertex = plyfile.PlyData.read(str(path))["vertex"].data
    names = [n for n in reversed(vertex.dtype.names) if not n.startswith("n")]
    table = np.zeros(len(vertex), [("segment", "i2"), *((n, "f8") for n in names), ("r", "u1")])
    for name in names:
        table[name] = vertex[name]
    faces = np.empty(2, [("vertex_indices", "O"), ("flag", "u1")])
    faces["vertex_indices"] = [np.array([0, 1, 2], "i4"), np.array([3, 1, 2, 0], "i4")]
    cameras = np.ones(3, [("focal", "f4")])
    elements = [
        plyfile.PlyElement.describe(table, "vertex", comments=["from elsewhere"]),
        plyfile.PlyElement.describe(faces, "face"),
        plyfile.PlyElement.describe(cameras, "camera"),
    ]
    plyfile.PlyData(elements, text=text, byte_order=byte_order, comments=["hello"]).write(str(out))
    return out


@pytest.mark.parametrize("options", [{}, {"byte_order": ">"}, {"text": True}], ids=str)
def test_doubles_other_properties_and_elements_are_read(tmp_path, options):
    path = saved(tmp_path, random_gaussians(40, sh_degree=2))
    loaded = load_ply(foreign(path, tmp_path / "other.ply", **options))
    assert same(loaded, load_ply(path))


def test_a_header_with_windows_line_ends_is_read(tmp_path):
    path = saved(tmp_path, random_gaussians(40))
    head, mark, data = path.read_bytes().partition(b"end_header\n")
    (tmp_path / "crlf.ply").write_bytes((head + mark).replace(b"\n", b"\r\n") + data)
    assert same(load_ply(tmp_path / "crlf.ply"), load_ply(path))


def refused(path: Path, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as error:
        load_ply(path)
    assert "\n" not in str(error.value)
    assert path.name in str(error.value)


def test_a_truncated_file_says_how_much_is_there(tmp_path):
    path = saved(tmp_path, random_gaussians(100))
    whole = path.read_bytes()
    row = 17 * 4
    path.write_bytes(whole[: -10 * row - 5])
    refused(path, "ends after 89 of 100 Gaussians")
    path.write_bytes(whole[:60])
    refused(path, "truncated: its header")
    text = rewritten(saved(tmp_path, random_gaussians(5)), tmp_path / "text.ply", text=True)
    text.write_bytes(b"\n".join(text.read_bytes().split(b"\n")[:-3]) + b"\n")
    refused(text, "ends after 3 of 5 Gaussians")


def test_what_is_no_scene_is_refused(tmp_path):
    refused(tmp_path / "nowhere.ply", "No such file")
    (tmp_path / "folder.ply").mkdir()
    refused(tmp_path / "folder.ply", "folder")
    path = tmp_path / "scene.ply"
    path.write_bytes(b"")
    refused(path, "empty")
    path.write_bytes(b"solid stl")
    refused(path, "not a PLY")
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n")
    refused(path, "git lfs pull")
    path.write_text("ply\nformat ascii 1.0\nelement vertex many\nend_header\n")
    refused(path, "broken header")
    path.write_text("ply\nformat binary_middle_endian 1.0\nelement vertex 1\nend_header\n")
    refused(path, "binary_middle_endian")


def test_a_point_cloud_is_told_from_a_scene(tmp_path):
    points = np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    path = tmp_path / "points.ply"
    plyfile.PlyData([plyfile.PlyElement.describe(points, "vertex")]).write(str(path))
    refused(path, "no 3DGS scene but a point cloud")


def test_a_wrong_number_of_harmonics_and_no_gaussians_are_refused(tmp_path):
    path = saved(tmp_path, random_gaussians(3, sh_degree=1))
    path.write_bytes(path.read_bytes().replace(b"f_rest_8", b"other_88"))
    refused(path, "8 properties f_rest")
    refused(saved(tmp_path, random_gaussians(3)[:0]), "holds no Gaussian")


@pytest.mark.parametrize("name", ["means", "quats", "sh"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_damaged_gaussians_are_counted_and_dropped_if_asked(tmp_path, name, value):
    columns = {"means": ("x", "z"), "quats": ("rot_1",), "sh": ("f_dc_0", "f_rest_4")}
    path = saved(tmp_path, random_gaussians(20, sh_degree=1))
    path = with_values(path, columns[name], slice(3), value)
    refused(path, "3 of 20 Gaussians .* drop what is not finite")
    assert len(load_ply(path, drop_nonfinite=True)) == 17


def with_values(path: Path, columns: Sequence[str], rows: slice, value: float) -> Path:
    """Replace values of a file, which `save_ply` would refuse."""
    data = plyfile.PlyData.read(str(path), mmap=False)
    for column in columns:
        data["vertex"].data[column][rows] = value
    data.write(str(path))
    return path


def with_logits(path: Path, rows: dict[int, float]) -> Path:
    """Replace opacity logits in some rows of the file."""
    data = plyfile.PlyData.read(str(path), mmap=False)
    for row, logit in rows.items():
        data["vertex"].data["opacity"][row] = logit
    data.write(str(path))
    return path


def test_infinite_logits_are_opacities_of_one_and_zero(tmp_path):
    """They are valid, NaN is not, and written values are finite."""
    scene, infinity = random_gaussians(20), float("inf")
    path = with_logits(saved(tmp_path, scene), {2: infinity, 5: -infinity, 7: infinity})
    loaded = load_ply(path)
    assert loaded.opacities[[2, 5, 7]].tolist() == [1, 0, 1]
    others = [n for n in range(20) if n not in (2, 5, 7)]
    assert torch.allclose(loaded.opacities[others], scene.opacities[others])
    again = load_ply(saved(tmp_path, loaded, "again.ply"))
    assert again.encoded.isfinite().all()
    assert again.opacities[[2, 5, 7]].tolist() == pytest.approx([1, 0, 1], abs=1e-7)
    path = with_logits(path, {3: float("nan")})
    refused(path, "1 of 20 Gaussians .* drop what is not finite")
    kept = load_ply(path, drop_nonfinite=True)
    assert kept.opacities[[2, 4, 6]].tolist() == [1, 0, 1]


@pytest.mark.parametrize("value", [float("inf"), float("nan")])
def test_infinite_scales_are_damage(tmp_path, value):
    path = with_values(saved(tmp_path, random_gaussians(20)), ["scale_1"], slice(4, 5), value)
    refused(path, "1 of 20 Gaussians .* drop what is not finite")


@pytest.mark.filterwarnings("error")
def test_infinite_positions_print_no_warnings_of_numpy(tmp_path):
    """Of scales that may be sizes the extent of the scene decides."""
    path = saved(tmp_path, scaled(random_gaussians(400), 1e3))
    scales = [f"scale_{axis}" for axis in range(3)]
    with_values(path, scales, slice(None), 0.5)
    with_values(path, ["x"], slice(0, 30, 2), float("inf"))
    with_values(path, ["x"], slice(1, 30, 2), -float("inf"))
    refused(path, "30 of 400 Gaussians .* drop what is not finite")
    describe_oddities(path)
    with_values(path, ["y"], slice(None), float("nan"))
    refused(path, "400 of 400 Gaussians")


def test_flat_gaussians_have_a_scale_of_zero(tmp_path):
    """Their logarithm is minus infinity in files of some surface splatters."""
    path = saved(tmp_path, random_gaussians(20))
    path = with_values(path, ["scale_2"], slice(4, 6), -float("inf"))
    loaded = load_ply(path)
    assert (loaded.scales[:, 2] == 0).tolist() == [n in (4, 5) for n in range(20)]
    again = load_ply(saved(tmp_path, loaded, "again.ply"))
    assert again.encoded.isfinite().all()
    assert torch.allclose(again.scales, loaded.scales)


@pytest.mark.parametrize("value", [0.0, 1e38])
def test_rotations_of_zeros_or_of_infinite_length_count_as_damage(tmp_path, value):
    path = saved(tmp_path, random_gaussians(20))
    path = with_values(path, [f"rot_{i}" for i in range(4)], slice(5, 6), value)
    refused(path, "1 of 20")
    assert len(load_ply(path, drop_nonfinite=True)) == 19


@pytest.mark.linux
def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path):
    path = saved(tmp_path, random_gaussians(5))
    before = path.read_bytes()
    with limit_file_size(4096), pytest.raises(InputError, match="Cannot write"):
        save_ply(path, random_gaussians(5000))
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == [path.name]
    with pytest.raises(InputError, match="Cannot write"):
        save_ply(tmp_path / "missing" / "scene.ply", random_gaussians(5))


def test_community_files_are_read_or_refused(shared):
    folder = shared / "formats"
    guitar = folder / "gaussians" / "guitar.from-compressed.ply"
    assert (load_ply(guitar).opacities == 1).sum() == 667  # written as infinite logits
    assert load_ply(folder / "gaussians" / "playbot_lod4.from-sog.ply").sh_degree > 0
    with pytest.raises(InputError, match="no 3DGS scene"):
        load_ply(folder / "gaussians" / "biker.compressed.ply")
    for pointer in (folder / "lfs_pointers").glob("*.ply"):
        refused(pointer, "git lfs pull")


@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        (b"vertex 3", b"vertex -3", "broken header"),
        (b"property float nx", b"property float ny", "more than once"),
        (
            b"element vertex",
            b"element eye 1\nproperty int a\nelement vertex",
            "not begin with vertices",
        ),
        (b"property float nx", b"property quad nx", "broken header"),
        (b"property float nx", b"property list uchar float nx", "no lists"),
        (b"format binary_little_endian 1.0\n", b"", "no format is named before"),
        (b"element vertex", b"format ascii 1.0\nelement vertex", r"broken header \(format ascii"),
        # The number of rows could be read there, but not replaced.
        (b"element vertex", b"  element vertex", "'element vertex 3' is indented"),
        (b"vertex 3", b"vertex 99999999999999999999", "ends after 3 of 99,999,999,999,999,999,999"),
    ],
)
def test_a_header_that_lies_is_refused(tmp_path, before, after, sentence):
    path = saved(tmp_path, random_gaussians(3))
    path.write_bytes(path.read_bytes().replace(before, after))
    refused(path, sentence)


@pytest.mark.parametrize(
    "rows", ["1 2 3 4 5 6\n7 8 9 10 11 12\n", "1 2 3\n4 5\n", "1 2 a\n4 5 6\n"]
)
def test_ascii_rows_have_a_number_for_each_property(tmp_path, rows):
    """Two points with normals, of which the header knows nothing, would become four points."""
    path = tmp_path / "points.ply"
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex 2\n{names}end_header\n{rows}")
    with pytest.raises(InputError, match="rows that are not 3 numbers each"):
        read_ply_file(path, tuple("xyz"), "point cloud")


@pytest.mark.parametrize(
    ("name", "value"),
    [("scales", math.inf), ("scales", -1.0), ("sh", math.nan), ("quats", 0.0), ("opacities", 2.0)],
)
def test_what_load_ply_would_refuse_is_not_written(tmp_path, name, value):
    gaussians = random_gaussians(5)
    getattr(gaussians, name)[2] = value
    with pytest.raises(InputError, match="The scene to write has 1 of 5 Gaussians"):
        save_ply(tmp_path / "scene.ply", gaussians)
    assert list(tmp_path.iterdir()) == []


def test_part_of_a_loaded_scene_keeps_its_bits(tmp_path):
    """Decoding must not depend on the position of a Gaussian in the array."""
    loaded = load_ply(saved(tmp_path, random_gaussians(10_007)))
    odd = load_ply(saved(tmp_path, loaded[1::2], "odd.ply"))
    assert same(odd, loaded[1::2])


def test_rows_beyond_one_block_are_in_their_place(tmp_path):
    gaussians = random_gaussians(20_000, sh_degree=1)
    loaded = load_ply(saved(tmp_path, gaussians))
    assert same(loaded, gaussians, ("means", "quats", "sh"))


@pytest.mark.parametrize(
    ("comments", "antialiased"),
    [
        (["SplatRenderMode: mip"], True),
        (["splatrendermode:MIP"], True),
        (["SplatRenderMode  mip "], True),
        (["antialiased 1"], True),
        (["Antialiased = true"], True),
        (["postshot.anti_aliasing=1"], True),
        (["antialiased 0"], False),
        (["SplatRenderMode: default"], False),
        (["antialiased 1", "SplatRenderMode: default"], False),
        (["Exported from Brush", "Vertical axis: y", "SplatRenderMode: mip", "SH degree: 0"], True),
        (["mip", "antialiased", "not antialiased 1"], False),
    ],
)
@pytest.mark.parametrize("ending", [b"\n", b"\r\n"])
def test_comments_mark_antialiased_gaussians(tmp_path, comments, antialiased, ending):
    path = saved(tmp_path, random_gaussians(5))
    assert not load_ply(path).is_antialiased
    header, _, rows = path.read_bytes().partition(b"end_header\n")
    lines = header.splitlines()
    lines[2:2] = [f"comment {text}".encode() for text in comments]
    path.write_bytes(ending.join([*lines, b"end_header", rows]))
    assert load_ply(path).is_antialiased == antialiased


def test_antialiased_gaussians_are_written_as_such_and_others_as_ever(tmp_path):
    scene = random_gaussians(5)
    marked = saved(tmp_path, replace(scene, is_antialiased=True), "marked.ply").read_bytes()
    plain = saved(tmp_path, scene, "plain.ply").read_bytes()
    assert marked.replace(b"comment SplatRenderMode: mip\n", b"") == plain != marked
