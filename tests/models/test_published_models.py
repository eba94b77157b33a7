"""Reconstructors by published names, with random tensors in place of the published weights."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from command import run
from gscompleter import InputError, load_reconstructor
from gscompleter.models.feed_forward import FeedForward, MVSplat
from gscompleter.models.feed_forward.build import build, create_network
from gscompleter.models.weights import PUBLISHED
from gscompleter.reconstructors import get_trained_range, list_reconstructors
from network_inputs import record_networks
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


# `test_weights.py` names the model of a small file.
@pytest.mark.slow
def test_the_file_of_another_model_is_named(mvsplat_file, tmp_path):
    with pytest.raises(InputError, match=r"re10k.ckpt does not fit .* are those of mvsplat-re10k"):
        build("volsplat-re10k", mvsplat_file)
    with pytest.raises(InputError, match="cfeab6b1"):  # the digits that its name announces
        build("depthsplat-small-re10k", mvsplat_file)


def test_without_a_file_it_is_said_where_to_get_it(monkeypatch, tmp_path):
    monkeypatch.setenv("GSCOMPLETER_HOME", str(tmp_path))
    with pytest.raises(InputError, match=r"acid.ckpt from .*drive.google.com.* into .*mvsplat"):
        load_reconstructor("mvsplat-acid")


# `test_feed_forward.py` completes with this network, and a test below has its range.
@pytest.mark.slow
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


RANGED = [name for name in list_reconstructors() if name in PUBLISHED and PUBLISHED[name].near_far]


@pytest.fixture
def recorded(monkeypatch):
    return record_networks(monkeypatch, keeps_going=True)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory) -> Path:
    cameras = [camera_at(x, size=SIZE) for x in (-0.3, 0.1, 0.6)]
    cameras = [replace(camera, near=None, far=None) for camera in cameras]
    return photographed(tmp_path_factory.mktemp("rooms"), cameras)


def complete_room(monkeypatch, scene: Path, out: Path, model: str, *more: object) -> dict:
    """Complete a room without a depth range in its files; return the summary."""
    frames = ("--context", 0, 1, "--target", 2, "--reconstructor", model, "--device", "cpu")
    assert run(monkeypatch, "complete", scene, *frames, "--out", out, *more) == 0
    return json.loads((out / "summary.json").read_text())


@pytest.mark.parametrize(
    "name",
    [
        "mvsplat-re10k",
        pytest.param("depthsplat-base-dl3dv-256x448", marks=pytest.mark.slow),
        pytest.param("volsplat-re10k", marks=pytest.mark.slow),
    ],
)
def test_complete_gives_a_network_the_range_of_its_authors(
    name, rooms, recorded, tmp_path, monkeypatch, capsys
):
    """A scene in metres, which is not remarked upon."""
    summary = complete_room(monkeypatch, rooms, tmp_path / "out", name)
    assert "was trained on" not in capsys.readouterr().err
    near, far = PUBLISHED[name].near_far
    # The context, then the lift of the target.
    assert len(recorded.batches) == 2
    for _, cameras in recorded.batches:
        assert cameras.near.tolist() == [[near, near]]
        assert cameras.far.tolist() == [[far, far]]
    assert summary["depth_range"] == {
        "near": near,
        "far": far,
        "from": dict.fromkeys(("near", "far"), "model"),
    }


def test_a_range_that_is_given_goes_before_that_of_the_authors(
    rooms, recorded, tmp_path, monkeypatch
):
    more = ("--near", 0.25, "--quiet")
    summary = complete_room(monkeypatch, rooms, tmp_path / "out", "mvsplat-re10k", *more)
    assert recorded.batches[0][1].near.tolist() == [[0.25, 0.25]]
    assert recorded.batches[0][1].far.tolist() == [[100.0, 100.0]]
    assert summary["depth_range"]["from"] == {"near": "given", "far": "model"}


@pytest.mark.parametrize("name", RANGED)
def test_a_published_network_is_built_with_the_range_of_its_authors(name, recorded):
    assert load_reconstructor(name).depth_range == PUBLISHED[name].near_far


def test_a_scene_in_another_unit_than_the_network_was_trained_on_is_told(
    recorded, tmp_path, monkeypatch, capsys
):
    cameras = [camera_at(x, size=SIZE, unit=0.01) for x in (-0.3, 0.1, 0.6)]
    cameras = [replace(camera, near=None, far=None) for camera in cameras]
    scene = photographed(tmp_path / "small", cameras, Room(unit=0.01))
    complete_room(monkeypatch, scene, tmp_path / "out", "mvsplat-re10k")
    told = " ".join(capsys.readouterr().err.split())
    assert "this model was trained on 1 to 100: multiply the positions of the cameras by" in told


@dataclass(frozen=True)
class Mine:
    """A reconstructor of one's own."""

    depth_range: Any

    def __call__(self, views):
        raise NotImplementedError


@pytest.mark.parametrize("wrong", [5.0, (1.0,), (2.0, 1.0), (0.0, 1.0), ("a", "b")])
def test_a_range_of_ones_own_model_that_is_none_is_refused(wrong):
    with pytest.raises(InputError, match="The attribute depth_range of the reconstructor is"):
        get_trained_range(Mine(wrong))


def test_a_model_of_ones_own_without_a_range_adapts_to_any():
    assert get_trained_range(lambda views: None) is None
    assert get_trained_range(Mine([1, 5])) == (1.0, 5.0)
