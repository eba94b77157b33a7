"""Outputs of the authors' code for pseudo-random weights, and comparison with them.

Rule v1: a tensor named `key` is sampled from a normal distribution with the hash of the key as
seed, then scaled by its shape, and by its factor in multipliers.json, if any.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from math import prod
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from gscompleter.models.feed_forward.cameras import Cameras
from gscompleter.models.feed_forward.gaussian_adapter import PixelGaussians
from gscompleter.numerics.geometry import multiply_quats, quats_to_rotations, rotations_to_quats
from parity import relative_error
from paths import FIXTURES

STORED = FIXTURES / "feed_forward"
EXTRA = os.environ.get("GSC_EXTRA_FIXTURES")
"""Folder with additional fixtures in the same layout, all of which the tests use."""
EVERY = 97
"""Stride of the stored intermediate values."""


def rule_v1(key: str, shape: torch.Size, multiplier: float = 1.0) -> Tensor:
    """Create the weight `key`."""
    digest = hashlib.sha256(key.encode()).digest()
    seed = int.from_bytes(digest[:8], "little") & 0x7FFFFFFFFFFFFFFF
    normal = torch.randn(shape, generator=torch.Generator().manual_seed(seed))
    if len(shape) >= 2:
        return multiplier * normal / prod(shape[1:]) ** 0.5
    if key.rsplit(".", 1)[-1] in ("weight", "gamma", "scale"):
        return multiplier * (1 + 0.1 * normal)
    return multiplier * 0.05 * normal


def with_rule_v1(network: nn.Module, model: str) -> nn.Module:
    """Load the weights of the fixtures of `model`."""
    multipliers = json.loads((STORED / model / "multipliers.json").read_text())["multipliers"]
    weights = {
        key: rule_v1(key, value.shape, multipliers.get(key, 1.0))
        for key, value in network.state_dict().items()
    }
    network.load_state_dict(weights, strict=True)
    return network


def published_shapes(model: str, name: str) -> dict[str, tuple[int, ...]]:
    """List names and shapes of all weights of the authors' network."""
    keys = json.loads((STORED / model / f"{name}.json").read_text())["keys"]
    return {key: tuple(shape) for key, (shape, _) in keys.items()}


def extra(model: str, pattern: str = "*.npz") -> list[Path]:
    """List the additional fixtures of a model."""
    return sorted(Path(EXTRA, model).glob(pattern)) if EXTRA else []


@dataclass(frozen=True)
class Case:
    """One fixture."""

    values: dict[str, np.ndarray]

    @staticmethod
    def load(path: Path) -> Case:
        with np.load(path) as file:
            return Case({name: file[name] for name in file.files})

    def tensor(self, name: str) -> Tensor:
        return torch.from_numpy(self.values[name])

    @property
    def images(self) -> Tensor:
        return self.tensor("in_image")

    @property
    def cameras(self) -> Cameras:
        names = ("extrinsics", "intrinsics", "near", "far")
        return Cameras(*(self.tensor(f"in_{name}") for name in names))

    def output_errors(self, predicted: PixelGaussians) -> dict[str, float]:
        """Compute the largest error of each output, relative to the authors' largest value.

        SH are compared degree by degree, because higher ones are below 0.001 of the constant.
        """
        step = int(self.values["stride"])
        axes = quats_to_rotations(predicted.quats)
        spread = axes * predicted.scales[..., None, :]
        world_to_camera = rotations_to_quats(self.cameras.c2w[..., :3, :3].transpose(-1, -2))
        in_camera = multiply_quats(world_to_camera[:, :, None, None], predicted.quats)
        values = {
            "means": predicted.means,
            "covariances": spread @ spread.transpose(-1, -2),
            "opacities": predicted.opacities,
            "scales": predicted.scales,
        }
        errors = {
            name: relative_error(value.flatten(1, 3)[:, ::step], self.tensor(f"out_{name}"))
            for name, value in values.items()
        }
        quats = self.tensor("out_rotations_xyzw_cam").roll(1, -1)
        ours = in_camera.flatten(1, 3)[:, ::step]
        same_sign = (ours * quats).sum(-1, keepdim=True).sign()  # q and -q are one rotation
        errors["quats"] = relative_error(same_sign * ours, quats)
        errors["depth"] = relative_error(predicted.depth, self.tensor("out_depth"))
        harmonics = self.tensor("out_harmonics").transpose(-1, -2)
        ours = predicted.sh.flatten(1, 3)[:, ::step]
        for degree in range(round(ours.shape[-2] ** 0.5)):
            part = slice(degree**2, (degree + 1) ** 2)
            errors[f"harmonics{degree}"] = relative_error(
                ours[..., part, :], harmonics[..., part, :]
            )
        return errors

    def intermediate_errors(self, between: dict[str, Tensor]) -> dict[str, float]:
        """Compute the same for the stored intermediate values."""
        names = [name[4:] for name in self.values if name.startswith("mid_")]
        return {
            name: relative_error(between[name].flatten()[::EVERY], self.tensor(f"mid_{name}"))
            for name in names
        }


@dataclass
class Pass:
    """A pass through a network, with inputs and outputs of some modules."""

    predicted: PixelGaussians
    inputs: dict[str, tuple]
    outputs: dict[str, object]

    @staticmethod
    def through(network: nn.Module, images: Tensor, cameras: Cameras) -> Pass:
        inputs, outputs = {}, {}

        def remember(name: str):
            def hook(_module, given, out):
                inputs[name], outputs[name] = given, out

            return hook

        hooks = [m.register_forward_hook(remember(name)) for name, m in network.named_modules()]
        with torch.no_grad():
            predicted = network(images, cameras)
        for hook in hooks:
            hook.remove()
        return Pass(predicted, inputs, outputs)

    def of_mvsplat(self) -> dict[str, Tensor]:
        """Collect the values of MVSplat fixtures."""
        names = {
            "corr_refine": "corr_refine_net",
            "depth_logits": "depth_head_lowres",
            "upsampler": "upsampler",
            "refine": "refine_unet",
            "raw_gaussians": "to_gaussians",
            "to_disparity": "to_disparity",
        }
        between = {name: self.outputs[f"depth_predictor.{key}"] for name, key in names.items()}
        trans_features, cnn = self.outputs["backbone"]
        cost_volume = self.inputs["depth_predictor.corr_refine_net"][0][:, :128]
        return {**between, "trans_features": trans_features, "cnn": cnn, "cost_volume": cost_volume}

    def of_depthsplat(self) -> dict[str, Tensor]:
        """Collect the values of DepthSplat fixtures."""
        scenes, views = self.predicted.depth.shape[:2]
        matching = self.outputs["depth_predictor.transformer"].unflatten(0, (scenes, views))
        between = {
            "mv_view0": matching[:, 0],
            "depth_residual": self.outputs["depth_predictor.upsampler"],
            "features": self.outputs["feature_upsampler"],
            "gregr": self.outputs["gaussian_regressor"],
            "raw": self.outputs["gaussian_head"],
        }
        for i, x in enumerate(self.outputs["depth_predictor.backbone"]):
            between[f"cnn{i}"] = x
        for i, x in enumerate(self.inputs["depth_predictor.upsampler"][0]):
            between[f"mono{i}"] = x
        for scale in range(2):
            name = f"depth_predictor.regressor.{scale}"
            if name in self.outputs:
                between[f"costin{scale}"] = self.inputs[name][0]
                between[f"regressor{scale}"] = self.outputs[name]
                between[f"logits{scale}"] = self.outputs[f"depth_predictor.depth_head.{scale}"]
        return between
