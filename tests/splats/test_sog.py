"""Written .sog bundles: quantised within their steps, and laid out as readers expect."""

import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from gscompleter import load_splat, merge, save_splat
from gscompleter.splats.morton import sort_along_morton
from splat_files import covariances, plausible, psnr


def log_scale(x: torch.Tensor) -> torch.Tensor:
    return x.sign() * x.abs().log1p()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_sog_rounds_no_more_than_its_codes(tmp_path, degree):
    gaussians = sort_along_morton(plausible(700, degree))
    save_splat(tmp_path / "scene.sog", gaussians)
    loaded = load_splat(tmp_path / "scene.sog")
    logs = log_scale(gaussians.means)
    step = (logs.amax(0) - logs.amin(0)) / 65535
    assert ((log_scale(loaded.means) - logs).abs() <= 0.6 * step + 1e-6 * logs.abs().max()).all()
    for ours, given in ((loaded.scales.log(), gaussians.scales.log()), (loaded.sh, gaussians.sh)):
        assert (ours - given).abs().max() <= (given.max() - given.min()) / 127
    assert (loaded.opacities - gaussians.opacities).abs().max() <= 0.51 / 255
    assert torch.allclose(covariances(loaded), covariances(gaussians), atol=5e-3)
    assert loaded.sh.shape == gaussians.sh.shape
    assert psnr(loaded, gaussians) > 40


def test_many_harmonics_share_a_palette(tmp_path):
    """Copies that differ little stand for each other, and numbers above 255 take two bytes."""
    base = plausible(400, 3)
    parts = [
        replace(base, means=base.means + 1e-3 * i, sh=base.sh * (1 + 1e-3 * i)) for i in range(15)
    ]
    gaussians = sort_along_morton(merge(parts))
    save_splat(tmp_path / "scene.sog", gaussians)
    with zipfile.ZipFile(tmp_path / "scene.sog") as bundle:
        table = json.loads(bundle.read("meta.json"))["shN"]
    assert 256 < table["count"] < len(gaussians)
    loaded = load_splat(tmp_path / "scene.sog")
    assert (loaded.sh - gaussians.sh).square().mean().sqrt() < 0.02 * gaussians.sh.std()


def test_a_bundle_has_what_its_specification_asks_for(tmp_path):
    gaussians = replace(plausible(90, 2), opacities=torch.zeros(90))
    save_splat(tmp_path / "scene.sog", gaussians)
    with zipfile.ZipFile(tmp_path / "scene.sog") as bundle:
        assert {entry.compress_type for entry in bundle.infolist()} == {zipfile.ZIP_STORED}
        files = {name: bundle.read(name) for name in bundle.namelist()}
    table = json.loads(files.pop("meta.json"))
    named = [
        name for key in ("means", "scales", "quats", "sh0", "shN") for name in table[key]["files"]
    ]
    assert sorted(named) == sorted(files)
    assert (table["version"], table["count"], table["shN"]["bands"]) == (2, 90, 2)
    assert all(len(table[key]["codebook"]) == 256 for key in ("scales", "sh0", "shN"))
    sizes = {}
    for name, data in files.items():
        assert data[12:16] == b"VP8L"  # lossless
        sizes[name] = Image.open(io.BytesIO(data)).size
    width, height = sizes.pop("shN_centroids.webp")
    assert (width, height) == (64 * 8, -(-table["shN"]["count"] // 64))
    assert len(set(sizes.values())) == 1
    # Transparent pixels keep their colours.
    colours = np.sort(load_splat(tmp_path / "scene.sog").sh[:, 0].numpy(), axis=None)
    assert np.abs(colours - np.sort(gaussians.sh[:, 0].numpy(), axis=None)).max() < 0.05


def test_the_same_gaussians_give_the_same_bundle(tmp_path):
    for name in ("a.sog", "b.sog"):
        save_splat(tmp_path / name, plausible(300, 1))
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_a_flat_scene_and_a_single_gaussian_are_written(tmp_path):
    flat = plausible(50, 1)
    flat.means[:, 1] = 0.5
    for given in (flat, plausible(1, 3)):
        save_splat(tmp_path / "scene.sog", given)
        loaded = load_splat(tmp_path / "scene.sog")
        assert torch.allclose(loaded.means.mean(0), given.means.mean(0), atol=1e-3)


def test_scales_of_zero_do_not_spoil_others(tmp_path):
    gaussians = sort_along_morton(plausible(300, 0))
    gaussians.scales[5] = 0
    save_splat(tmp_path / "scene.sog", gaussians)
    loaded = load_splat(tmp_path / "scene.sog")
    assert (loaded.scales[5] < 1e-6).all()
    others = torch.arange(300) != 5
    assert torch.allclose(loaded.scales[others], gaussians.scales[others], rtol=0.1)
