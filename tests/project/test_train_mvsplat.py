"""Training of MVSplat from nothing: what it learns from, and weights that the package loads."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from command import run
from gscompleter import load_reconstructor
from gscompleter.models.feed_forward import FeedForward, MVSplat
from gscompleter.numerics.geometry import unproject
from gscompleter.reconstructors.plane_sweep.gaussians import DISC_SIGMA
from gscompleter.types import SH_C0, Camera
from scenes import Room, camera_at, photographed, view_of
from train_mvsplat import (
    Training,
    compute_depth_loss,
    draw_pair,
    load_clips,
    main,
    set_appearance,
)

SIZE = 32
"""Side of the images of the training; the photographs have twice as many pixels."""
CAMERAS = tuple(camera_at(x, size=2 * SIZE) for x in (-0.3, -0.1, 0.1, 0.3, 0.5, 0.7))
CASES = {"cases": ((0, 1), 2), "held_out": ((3, 5), 4)}
"""Context and target of the case in each file."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder with a room, and a file with a case to train on and one that is held out."""
    folder = tmp_path_factory.mktemp("train")
    photographed(folder / "room", CAMERAS)
    for name, (context, target) in CASES.items():
        case = {"scene": "room", "context": context, "target": target, "near": 0.5, "far": 20}
        content = {"resolution": [2 * SIZE, 2 * SIZE], "cases": [case]}
        (folder / f"{name}.json").write_text(json.dumps(content))
    return folder


@pytest.fixture(scope="module")
def clip(folder):
    """Return the photographs of the room that teach."""
    (clip,) = load_clips(folder / "cases.json", folder / "held_out.json", 2 * SIZE, folder)
    return clip


def train(folder: Path, out: Path, steps: int) -> Path:
    """Train a few steps by the command, and return the file of weights."""
    cases = ("--cases", folder / "cases.json", "--left-out", folder / "held_out.json")
    words = ("--out", out, *cases, "--size", SIZE, "--steps", steps)
    main([str(word) for word in words])
    return out / "mvsplat.ckpt"


def test_frames_of_held_out_cases_teach_nothing(clip):
    assert clip.frames == (0, 1, 2)
    assert clip.max_gap == 2


# A crop, a mirror image and other colours must leave cameras and depths of one scene.
@pytest.mark.parametrize("seed", range(4))
def test_pairs_are_two_photographs_of_one_scene(clip, seed):
    batch = draw_pair(clip, SIZE, np.random.default_rng(seed))
    K = batch.cameras.K[0] * torch.tensor([SIZE, SIZE, 1.0])[:, None]
    first, second = (
        Camera(c2w, k, SIZE, SIZE) for c2w, k in zip(batch.cameras.c2w[0], K, strict=True)
    )
    points = unproject(batch.depths[0, 0], first).reshape(-1, 3)
    projected = (points - second.center) @ second.c2w[:3, :3]
    z = projected[:, 2]
    x, y = ((projected @ second.K.T)[:, :2] / z[:, None]).T.long()
    seen = (x >= 0) & (x < SIZE) & (y >= 0) & (y < SIZE)
    there = batch.depths[0, 1][y[seen], x[seen]]
    assert seen.float().mean() > 0.3
    assert ((z[seen] / there).log().abs()).median() < 0.05


# `test_the_loss_falls_and_the_weights_complete_a_scene` has steps before it.
def test_the_package_loads_the_weights(tmp_path):
    training = Training(0, SIZE, 1, "cpu")
    training.save(tmp_path / "mvsplat.ckpt")
    loaded = load_reconstructor("mvsplat-re10k", tmp_path / "mvsplat.ckpt").network.state_dict()
    assert all(torch.equal(loaded[name], value) for name, value in training.mean.items())


def test_gaussians_begin_as_opaque_discs_with_the_colours_of_their_pixels():
    network = MVSplat()
    set_appearance(network)
    views = [view_of(Room(), camera_at(x, size=SIZE)) for x in (-0.3, -0.1)]
    gaussians = FeedForward(network.eval())(views).gaussians
    colours = 0.5 + SH_C0 * gaussians.sh[:, 0]
    images = torch.stack([view.image for view in views]).reshape(-1, 3)
    distances = (gaussians.means - views[0].camera.center).norm(dim=1)[: len(images) // 2]
    pixels = gaussians.scales[: len(distances)] * views[0].camera.K[0, 0] / distances[:, None]
    assert (colours - images).abs().max() < 1e-4
    assert (pixels - DISC_SIGMA).abs().max() < 0.01
    assert gaussians.opacities.min() > 0.9


def test_steps_of_another_seed_do_not_go_on(folder, clip, tmp_path):
    (tmp_path / "mvsplat.ckpt").touch()
    torch.save({"drawn": {"seed": 1, "size": SIZE, "pairs": 1}}, tmp_path / "mvsplat.ckpt")
    with pytest.raises(SystemExit, match="name another folder by --out"):
        train(folder, tmp_path, 1)


@pytest.mark.slow
def test_a_stopped_training_goes_on_as_if_it_was_not(folder, tmp_path):
    for steps in (3, 6):
        stopped = train(folder, tmp_path / "stopped", steps)
    whole = train(folder, tmp_path / "whole", 6)
    one, other = (torch.load(path, weights_only=True) for path in (stopped, whole))
    assert one["step"] == other["step"] == 6
    kept, mean = one["state_dict"], other["state_dict"]
    assert all(torch.equal(kept[name], mean[name]) for name in mean)


@pytest.mark.slow
def test_the_loss_falls_and_the_weights_complete_a_scene(folder, clip, tmp_path, monkeypatch):
    training = Training(0, SIZE, 1, "cpu")
    batch = draw_pair(clip, SIZE, np.random.default_rng(0))

    def measure() -> float:
        with torch.no_grad():
            return float(compute_depth_loss(training.network(batch.images, batch.cameras), batch))

    before = measure()
    for _ in range(40):
        training.take_step([clip])
    assert measure() < 0.7 * before

    training.save(tmp_path / "mvsplat.ckpt")
    frames = ("--context", 0, 1, "--target", 2, "--near", 0.5, "--far", 20)
    model = ("--reconstructor", "mvsplat-re10k", "--weights", tmp_path / "mvsplat.ckpt")
    out = tmp_path / "out"
    words = ("complete", folder / "room", *frames, *model, "--device", "cpu", "--out", out)
    assert run(monkeypatch, *words) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["settings"]["weights"] == str(tmp_path / "mvsplat.ckpt")
    assert 0 < summary["gaussians"]["context"] <= 2 * (2 * SIZE) ** 2
