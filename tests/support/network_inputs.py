"""Records of the inputs that commands give to published networks, without their weights.

A stand-in takes the place of each network: it has the class and the configuration of the published
one, and records its batch. Each case ends there, as a failed row, since no score is wanted.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from gscompleter.evaluation import runner
from gscompleter.evaluation.protocols import Task
from gscompleter.evaluation.runner import RunConfig
from gscompleter.evaluation.steps import PreparedTask
from gscompleter.models.feed_forward import build
from gscompleter.models.feed_forward.cameras import Cameras
from gscompleter.models.feed_forward.gaussian_adapter import PixelGaussians
from gscompleter.models.weights.published import PublishedWeights
from gscompleter.system.errors import InputError
from gscompleter.types import View


@dataclass(frozen=True)
class Fed:
    """Input that a task gave to the network and to the scores."""

    images: Tensor
    """Context [v, 3, h, w] in [0, 1], in the order of the call."""
    cameras: Cameras
    targets: tuple[View, ...]
    """Photographs to score, with their cameras."""


@dataclass
class Recorded:
    """Inputs of the tasks of a run."""

    batches: list[tuple[Tensor, Cameras]] = field(default_factory=list)
    tasks: dict[tuple[str, str], Fed] = field(default_factory=dict)
    """By the names of the model and of the task."""


def predict_plane(images: Tensor, cameras: Cameras) -> PixelGaussians:
    """Return a Gaussian for each pixel, on a plane in front of each camera."""
    _, views, _, height, width = images.shape
    rows = (torch.arange(height) + 0.5) / height
    columns = (torch.arange(width) + 0.5) / width
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    rays = torch.einsum("bvij,hwj->bvhwi", torch.linalg.inv(cameras.K), pixels)
    depth = 2 * cameras.near.amax() + rays.new_zeros(1, views, height, width)
    rotations = cameras.c2w[..., :3, :3]
    means = torch.einsum("bvij,bvhwj->bvhwi", rotations, rays * depth[..., None])
    means = means + cameras.c2w[:, :, None, None, :3, 3]
    return PixelGaussians(
        depth=depth,
        means=means,
        quats=means.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(*depth.shape, 4),
        scales=(depth / width)[..., None].expand_as(means),
        opacities=torch.full_like(depth, 0.9),
        sh=images.new_zeros(*depth.shape, 1, 3),
    )


def make_stand_in(network: nn.Module, recorded: Recorded) -> nn.Module:
    """Make a network of the same class and configuration that records its batches."""
    made = type(network).__new__(type(network))
    nn.Module.__init__(made)
    made.config = network.config
    made.anything = nn.Parameter(torch.zeros(()))  # it tells the device

    def forward(images: Tensor, cameras: Cameras) -> PixelGaussians:
        recorded.batches.append((images, cameras))
        return predict_plane(images, cameras)

    made.forward = forward
    return made


def record_networks(monkeypatch: pytest.MonkeyPatch, keeps_going: bool = False) -> Recorded:
    """Replace the networks of published weights by stand-ins, and record what they are fed.

    Cases of `evaluate` end once their input is recorded, unless `keeps_going`.
    """
    recorded = Recorded()
    create = build.create_network
    prepare = runner.prepare_task

    def create_stand_in(published: PublishedWeights) -> nn.Module:
        with torch.device("meta"):
            return make_stand_in(create(published), recorded).to_empty(device="cpu")

    def prepare_and_record(task: Task, folder: Path, config: RunConfig) -> PreparedTask:
        recorded.batches.clear()
        prepared = prepare(task, folder, config)
        images, cameras = recorded.batches[0]
        fed = Fed(images[0], cameras, prepared.targets)
        recorded.tasks[config.reconstructor, task.name] = fed
        raise InputError("Only the input of the network is recorded.")

    build.build.cache_clear()
    monkeypatch.setattr(build, "create_network", create_stand_in)
    monkeypatch.setattr(build, "fetch", lambda *_: Path())
    monkeypatch.setattr(build, "read_state_dict", lambda *_: {})
    monkeypatch.setattr(build, "load_strictly", lambda *_: None)
    if not keeps_going:
        monkeypatch.setattr(runner, "prepare_task", prepare_and_record)
    return recorded
