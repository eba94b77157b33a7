"""Splats of other trainers in the layout of a .ply: fused filters, surfels, model folders."""

import math
import zipfile
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch

from gscompleter import InputError, load_ply, load_renderer, load_splat, merge, save_ply, save_splat
from gscompleter.splats.layout import save_like, strip
from scenes import camera_at, random_gaussians

COUNT = 300


def write_columns(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """Write a binary .ply of float32 properties in the given order."""
    rows = np.empty(len(columns["x"]), [(name, "<f4") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    element = plyfile.PlyElement.describe(rows, "vertex")
    plyfile.PlyData([element], byte_order="<").write(str(path))
    return path


def read_columns(path: Path) -> dict[str, np.ndarray]:
    rows = plyfile.PlyData.read(str(path))["vertex"].data
    return {name: np.array(rows[name]) for name in rows.dtype.names}


def plain_columns(tmp_path: Path) -> dict[str, np.ndarray]:
    save_ply(tmp_path / "plain.ply", random_gaussians(COUNT, sh_degree=1))
    return read_columns(tmp_path / "plain.ply")


def raw_columns(tmp_path: Path, radius: float = 0.03) -> dict[str, np.ndarray]:
    """Add the filter of Mip-Splatting, a different one for each Gaussian."""
    columns = plain_columns(tmp_path)
    return columns | {"filter_3D": np.linspace(0, 2 * radius, COUNT, dtype=np.float32)}


def fused_columns(raw: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Fuse the filter by the formulas of the paper, in float64."""
    scales = np.exp(np.stack([raw[f"scale_{i}"] for i in range(3)], axis=1).astype(np.float64))
    opacity = 1 / (1 + np.exp(-raw["opacity"].astype(np.float64)))
    smooth = np.sqrt(scales**2 + raw["filter_3D"].astype(np.float64)[:, None] ** 2)
    opacity = opacity * np.sqrt((scales**2).prod(1) / (smooth**2).prod(1))
    fused = {name: values for name, values in raw.items() if name != "filter_3D"}
    fused |= {f"scale_{i}": np.log(smooth[:, i]) for i in range(3)}
    return fused | {"opacity": np.log(opacity / (1 - opacity))}


def test_the_filter_of_mip_splatting_is_fused(tmp_path):
    raw = raw_columns(tmp_path)
    loaded = load_ply(write_columns(tmp_path / "raw.ply", raw))
    expected = load_ply(write_columns(tmp_path / "fused.ply", fused_columns(raw)))
    assert torch.allclose(loaded.scales, expected.scales, rtol=1e-5)
    assert torch.allclose(loaded.opacities, expected.opacities, rtol=1e-4)
    images = [load_renderer("cpu").render(g, camera_at(size=64)).image for g in (loaded, expected)]
    assert (images[0] - images[1]).abs().max() < 1e-4 * images[1].max()
    ignored = load_ply(tmp_path / "plain.ply")
    assert (ignored.opacities - expected.opacities).abs().max() > 0.1 * expected.opacities.max()


def test_converted_files_hold_what_was_fused(tmp_path):
    loaded = load_ply(write_columns(tmp_path / "raw.ply", raw_columns(tmp_path)))
    save_splat(tmp_path / "out.ply", loaded)
    again = load_ply(tmp_path / "out.ply")
    assert "filter_3D" not in read_columns(tmp_path / "out.ply")
    assert torch.allclose(again.scales, loaded.scales, rtol=1e-6)
    assert torch.allclose(again.opacities, loaded.opacities, rtol=1e-5)


def test_strip_gives_the_file_with_its_filter_back(tmp_path):
    """Additions have a filter of zero, so that they are read as they are."""
    given = write_columns(tmp_path / "raw.ply", raw_columns(tmp_path))
    context = load_ply(given)
    added = random_gaussians(40, seed=1, sh_degree=1)
    added.generated[:] = 1
    save_like(tmp_path / "completed.ply", context, added, given)
    completed = load_ply(tmp_path / "completed.ply")
    assert torch.equal(completed.scales[:COUNT], context.scales)
    assert torch.equal(completed.opacities[:COUNT], context.opacities)
    assert torch.allclose(completed.scales[COUNT:], added.scales, rtol=1e-6)
    assert torch.allclose(completed.opacities[COUNT:], added.opacities, rtol=1e-5)
    strip(tmp_path / "completed.ply", tmp_path / "back.ply")
    assert (tmp_path / "back.ply").read_bytes() == given.read_bytes()


def surfel_file(tmp_path: Path) -> Path:
    """Write Gaussians as 2DGS does, with two scales."""
    columns = plain_columns(tmp_path)
    del columns["scale_2"]
    return write_columns(tmp_path / "surfels.ply", columns)


def test_surfels_have_a_thin_third_scale(tmp_path):
    loaded, plain = load_ply(surfel_file(tmp_path)), load_ply(tmp_path / "plain.ply")
    assert torch.equal(loaded.scales[:, :2], plain.scales[:, :2])
    thickness = loaded.scales[:, 2] / loaded.scales[:, :2].amin(1)
    assert torch.allclose(thickness, torch.full((COUNT,), 1e-3), rtol=1e-4)


def test_additions_to_surfels_keep_their_thickness(tmp_path):
    """Two scales cannot hold them, so the completed file has the standard layout."""
    given = surfel_file(tmp_path)
    context, added = load_ply(given), random_gaussians(40, seed=1, sh_degree=1)
    added.generated[:] = 1
    save_like(tmp_path / "completed.ply", context, added, given)
    completed = load_ply(tmp_path / "completed.ply")
    assert torch.allclose(completed.scales, merge([context, added]).scales, rtol=1e-6)
    strip(tmp_path / "completed.ply", tmp_path / "back.ply")
    assert torch.equal(load_ply(tmp_path / "back.ply").scales, context.scales)


@pytest.mark.parametrize(
    ("names", "newest"),
    [
        (
            [
                "point_cloud/iteration_7000/point_cloud.ply",
                "point_cloud/iteration_30000/point_cloud.ply",
            ],
            1,
        ),
        (["iteration_900/point_cloud.ply", "iteration_1000/point_cloud.ply"], 1),
        (["ply/point_cloud_6999.ply", "ply/point_cloud_29999.ply"], 1),
        (["splat_30000.ply", "splat_7000.ply"], 0),
        (["export_5000.ply", "export_10000.ply"], 1),
        (["splat.ply"], 0),
        (["export_30000_0.ply", "export_7000_1.ply"], 0),
        (["ckpts/ckpt_29999_rank0.ply", "ckpts/x_v2.ply", "ckpts/._ckpt_39999.ply"], 0),
    ],
)
def test_a_trainers_folder_opens_its_newest_iteration(tmp_path, names, newest):
    folder = tmp_path / "model_2024"
    for count, name in enumerate(names, 3):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        save_ply(folder / name, random_gaussians(count))
    (folder / "input.ply").write_bytes(b"ply\n")  # the points that the training began with
    (folder / "cameras.json").write_text("[]")
    assert len(load_splat(folder)) == newest + 3


def test_a_folder_without_a_splat_names_what_is_in_it(tmp_path):
    with pytest.raises(InputError, match="is a folder without a splat; name the file of a splat"):
        load_splat(tmp_path)
    save_ply(tmp_path / "chair.ply", random_gaussians(3))
    with pytest.raises(InputError, match=r"name one of the splats in it, such as chair\.ply"):
        load_splat(tmp_path)


def test_a_folder_names_no_file_of_another_kind_for_its_ending(tmp_path):
    """As matrices in a .npz would be, if a format of splats had that ending."""
    with zipfile.ZipFile(tmp_path / "cameras.sog", "w") as archive:
        archive.writestr("world_mat_0.npy", b"")
    with pytest.raises(InputError, match="is a folder without a splat; name the file of a splat"):
        load_splat(tmp_path)
    # A damaged one is worth naming: what is wrong with it is said then.
    (tmp_path / "cut.sog").write_bytes(b"PK\x03\x04")
    with pytest.raises(InputError, match=r"such as cut\.sog"):
        load_splat(tmp_path)


def test_the_quaternion_of_a_box_may_be_of_any_length():
    from gscompleter.apps.inputs.removal import find_in_boxes

    points = torch.tensor([[0.9, 0.0, 0.0], [0.0, 0.9, 0.0]], dtype=torch.float64)
    box = (-1.0, -0.1, -0.1, 1.0, 0.1, 0.1)
    turned = math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)
    for length in (1.0, 1e200, 1e-200):
        rotation = [part * length for part in turned]
        assert find_in_boxes(points, box, rotation).tolist() == [False, True]
