"""Outputs of the authors' VolSplat on MinkowskiEngine, and comparison with them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod

import torch
from torch import Tensor, nn

from feed_forward_fixtures import EVERY, STORED, Case, rule_v1
from gscompleter.models.feed_forward.volsplat import VoxelGaussians
from gscompleter.numerics.geometry import quats_to_rotations
from parity import relative_error

FIXTURES = STORED / "volsplat"


def sparse_rule(key: str, shape: Sequence[int], multiplier: float = 1.0) -> Tensor:
    """Apply rule v1, except for kernels of sparse convolutions and variances."""
    weight = rule_v1(key, torch.Size(shape), multiplier)
    last = key.rsplit(".", 1)[-1]
    if last == "running_var":
        return multiplier + 2 * weight
    if last == "kernel":
        inputs = 8 * shape[1] if len(shape) == 3 else shape[0]
        return weight * (prod(shape[1:]) / inputs) ** 0.5
    return weight


def with_sparse_rule(network: nn.Module) -> nn.Module:
    """Load the fixtures' weights for inference."""
    multipliers = json.loads((FIXTURES / "multipliers.json").read_text())["multipliers"]
    weights = {
        key: sparse_rule(key, value.shape, multipliers.get(key, 1.0))
        if value.is_floating_point()
        else value
        for key, value in network.state_dict().items()
    }
    network.load_state_dict(weights, strict=True)
    return network.eval()


@dataclass
class VoxelPass:
    """A pass through the network, with inputs and outputs of its sparse parts."""

    predicted: VoxelGaussians
    between: dict[str, Tensor]

    @staticmethod
    def through(network: nn.Module, case: Case) -> VoxelPass:
        between = {}

        def of_unet(_module, given, out):
            between.update(sparse_in=given[0], sparse_out=out)

        def of_head(_module, _given, out):
            between.update(head=out)

        hooks = [
            network.spare_unet.register_forward_hook(of_unet),
            network.gaussian_head.register_forward_hook(of_head),
        ]
        with torch.no_grad():
            predicted = network(case.images, case.cameras)
        for hook in hooks:
            hook.remove()
        return VoxelPass(predicted, between)

    def rows_of(self, case: Case) -> Tensor:
        """Find our row of each of the authors' voxels; -1 if there is none."""
        ours = {tuple(row): i for i, row in enumerate(self.predicted.grid.coordinates.tolist())}
        return torch.tensor([ours.get(tuple(row), -1) for row in case.values["voxel_coords"]])

    def errors(self, case: Case) -> dict[str, float]:
        """Compute the largest relative error of all stored values at common voxels.

        SH are compared degree by degree, because higher ones are small.
        """
        rows = self.rows_of(case)
        errors = {"depth": relative_error(self.predicted.depth[None], case.tensor("out_depth"))}
        step = int(case.values["stride"])
        for name, value in self.outputs().items():
            part = rows[::step]
            errors[name] = relative_error(
                value[part[part >= 0]], expected_of(name, case)[part >= 0]
            )
        for name, value in self.between.items():
            flat = torch.arange(0, len(rows) * value.shape[1], EVERY)
            place, channel = rows[flat // value.shape[1]], flat % value.shape[1]
            shared = place >= 0
            ours = value[place[shared], channel[shared]]
            errors[name] = relative_error(ours, case.tensor(f"mid_{name}")[shared])
        return errors

    def outputs(self) -> dict[str, Tensor]:
        g = self.predicted
        spread = quats_to_rotations(g.quats) * g.scales[:, None, :]
        values = {
            "means": g.means,
            "covariances": spread @ spread.transpose(-1, -2),
            "opacities": g.opacities,
        }
        return values | {f"harmonics{d}": g.sh[:, d**2 : (d + 1) ** 2] for d in range(3)}


def expected_of(name: str, case: Case) -> Tensor:
    """Load the stored output `name` of each `stride`-th voxel."""
    if not name.startswith("harmonics"):
        return case.tensor(f"out_{name}")[0]
    degree = int(name[-1])
    harmonics = case.tensor("out_harmonics")[0].transpose(-1, -2)
    return harmonics[:, degree**2 : (degree + 1) ** 2]
