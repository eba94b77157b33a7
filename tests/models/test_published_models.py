"""Reconstructors by published names, with random tensors in place of the published weights."""

import json
from pathlib import Path

import pytest
import torch

from command import run
from gscompleter import InputError, load_reconstructor
from gscompleter.models.feed_forward import FeedForward, MVSplat
from gscompleter.models.feed_forward.build import build, create_network
from gscompleter.models.weights import PUBLISHED
from gscompleter.reconstructors import list_reconstructors
from scenes import Room, camera_at, photographed, view_of

SIZE = 64
VIEWS = [view_of(Room(), camera_at(x, size=SIZE)) for x in (-0.3, 0.1)]


def saved(path: Path, network: torch.nn.Module) -> Path:
    """Save a file like the authors' training."""
    state = {f"encoder.{name}": tensor for name, tensor in network.state_dict().items()}
    torch.save({"state_dict": state, "epoch": 3}, path)
    return path


@pytest.fixture(scope="module")
def mvsplat() -> MVSplat:
    torch.manual_seed(0)
    return MVSplat()


@pytest.fixture(scope="module")
def mvsplat_file(mvsplat, tmp_path_factory) -> Path:
    return saved(tmp_path_factory.mktemp("weights") / "re10k.ckpt", mvsplat)


@pytest.mark.parametrize("name", [name for name in list_reconstructors() if name in PUBLISHED])
def test_every_listed_model_has_a_network_of_the_published_size(name):
    published = PUBLISHED[name]
    with torch.device("meta"):
        network = create_network(published)
    assert sum(p.numel() for p in network.parameters()) == published.parameters
    assert network.config.image_size == published.image_size


def test_published_models_are_reconstructors_and_those_of_depth_alone_are_not():
    assert {"mvsplat-re10k", "mvsplat-acid", "depthsplat-small-re10k", "volsplat-re10k"} <= set(
        list_reconstructors()
    )
    assert "depthsplat-depth-base-352x640" not in list_reconstructors()


def test_a_file_by_its_path_fills_the_network(mvsplat, mvsplat_file):
    loaded = load_reconstructor("mvsplat-re10k", mvsplat_file)
    assert isinstance(loaded, FeedForward)
    expected = FeedForward(mvsplat.eval())(VIEWS)
    found = loaded(VIEWS)
    assert torch.equal(found.gaussians.means, expected.gaussians.means)
    assert torch.equal(found.gaussians.sh, expected.gaussians.sh)
    assert load_reconstructor("mvsplat-re10k", mvsplat_file) is loaded


def test_the_file_of_another_model_is_named(mvsplat_file, tmp_path):
    with pytest.raises(InputError, match=r"re10k.ckpt does not fit .* are those of mvsplat-re10k"):
        build("volsplat-re10k", mvsplat_file)
    with pytest.raises(InputError, match="cfeab6b1"):  # the digits that its name announces
        build("depthsplat-small-re10k", mvsplat_file)


def test_without_a_file_it_is_said_where_to_get_it(monkeypatch, tmp_path):
    monkeypatch.setenv("GSCOMPLETER_HOME", str(tmp_path))
    with pytest.raises(InputError, match=r"acid.ckpt from .*drive.google.com.* into .*mvsplat"):
        load_reconstructor("mvsplat-acid")


def test_a_completion_with_random_weights_runs_end_to_end(mvsplat_file, tmp_path, monkeypatch):
    """Random weights: this only checks frames, shapes and stages."""
    cameras = [camera_at(x, size=SIZE) for x in (-0.3, 0.1, 0.6)]
    scene = photographed(tmp_path / "scene", cameras)
    arguments = ["complete", scene, "--context", 0, 1, "--target", 2, "--near", 0.5, "--far", 20]
    model = ["--reconstructor", "mvsplat-re10k", "--weights", mvsplat_file, "--device", "cpu"]
    out = tmp_path / "out"
    assert run(monkeypatch, *arguments, *model, "--out", out, "--quiet") == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["settings"]["reconstructor"] == "mvsplat-re10k"
    assert summary["settings"]["weights"] == str(mvsplat_file)
    assert summary["gaussians"]["context"] == 2 * SIZE * SIZE
    assert summary["targets"][0]["anchor"] in (0, 1)
