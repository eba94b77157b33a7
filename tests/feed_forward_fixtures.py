"""What the authors' code gave for weights that follow from their names, and how to compare.

Weights, rule v1: a tensor named `key` is drawn from a normal distribution whose seed is the hash
of the key, then scaled by its shape, and by a factor from multipliers.json where it is listed.
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

from gscompleter.geometry import quats_from, quats_product, rotations_from
from gscompleter.reconstructors.feed_forward.cameras import Cameras
from gscompleter.reconstructors.feed_forward.gaussian_adapter import PixelGaussians
from parity import relative_error

STORED = Path(__file__).parent / "fixtures" / "feed_forward"
EXTRA = os.environ.get("GSC_EXTRA_FIXTURES")
"""A folder with more fixtures, in the layout of the stored ones; the tests take all that it has."""
EVERY = 97
"""Of the values between the layers each 97th is stored."""


def rule_v1(key: str, shape: torch.Size, multiplier: float = 1.0) -> Tensor:
    """The weight called `key`."""
    digest = hashlib.sha256(key.encode()).digest()
    seed = int.from_bytes(digest[:8], "little") & 0x7FFFFFFFFFFFFFFF
    normal = torch.randn(shape, generator=torch.Generator().manual_seed(seed))
    if len(shape) >= 2:
        return multiplier * normal / prod(shape[1:]) ** 0.5
    if key.rsplit(".", 1)[-1] in ("weight", "gamma", "scale"):
        return multiplier * (1 + 0.1 * normal)
    return multiplier * 0.05 * normal


def with_rule_v1(network: nn.Module, model: str) -> nn.Module:
    """`network` with the weights of the fixtures of `model`."""
    multipliers = json.loads((STORED / model / "multipliers.json").read_text())["multipliers"]
    weights = {
        key: rule_v1(key, value.shape, multipliers.get(key, 1.0))
        for key, value in network.state_dict().items()
    }
    network.load_state_dict(weights, strict=True)
    return network


def published_shapes(model: str, name: str) -> dict[str, tuple[int, ...]]:
    """Names and shapes of all weights of the authors' network."""
    keys = json.loads((STORED / model / f"{name}.json").read_text())["keys"]
    return {key: tuple(shape) for key, (shape, _) in keys.items()}


def extra(model: str, pattern: str = "*.npz") -> list[Path]:
    """The files of a model in the folder of more fixtures."""
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
        """Largest error of each output over the largest value of the authors'.

        Harmonics are compared degree by degree: the rotation changes the higher ones by less
        than a thousandth of the constant.
        """
        step = int(self.values["stride"])
        axes = rotations_from(predicted.quats)
        spread = axes * predicted.scales[..., None, :]
        world_to_camera = quats_from(self.cameras.c2w[..., :3, :3].transpose(-1, -2))
        in_camera = quats_product(world_to_camera[:, :, None, None], predicted.quats)
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
        """Likewise of the values between the layers, all that are stored."""
        names = [name[4:] for name in self.values if name.startswith("mid_")]
        return {
            name: relative_error(between[name].flatten()[::EVERY], self.tensor(f"mid_{name}"))
            for name in names
        }


@dataclass
class Pass:
    """A pass through a network, and what went into and came out of some of its modules."""

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
        """The values that fixtures of MVSplat store."""
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
        """The values that fixtures of DepthSplat store."""
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
