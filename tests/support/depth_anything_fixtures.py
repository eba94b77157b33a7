"""Outputs of the authors' Depth Anything 3, and comparison with them."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from feed_forward_fixtures import EVERY, STORED, Case, rule_v1
from gscompleter.models.depth_anything.alignment import fit_robust_similarity
from gscompleter.models.depth_anything.config import (
    VARIANTS,
    WIDE,
    DepthAnythingConfig,
    MetricDepthConfig,
    NestedConfig,
    VitConfig,
)
from gscompleter.models.depth_anything.images import normalize_colors
from gscompleter.models.depth_anything.metric import MetricDepthAnything, set_sky_depth
from gscompleter.models.depth_anything.nested import NestedDepthAnything
from gscompleter.models.depth_anything.network import DepthAnything, Prediction
from gscompleter.models.depth_anything.normalisation import compute_authors_units, normalize_poses
from gscompleter.models.depth_anything.poses import Poses, invert_rigid
from gscompleter.models.depth_anything.reconstructor import get_camera_centers
from gscompleter.models.depth_anything.reference_view import select_reference_view
from gscompleter.models.feed_forward.build import create_depth_anything
from gscompleter.models.feed_forward.gaussian_adapter import PixelGaussians
from parity import relative_error

FIXTURES = STORED / "da3"
NARROW = (48, 96, 192, 384)
TINY = VitConfig(384, 6, 12, (5, 7, 9, 11), 3, is_gated=True)
METRIC_TINY = MetricDepthConfig(VitConfig(384, 6, 24, (4, 11, 17, 23), None), 64, NARROW)
STAND_INS = {
    "small": VARIANTS["da3-small"],
    "gs-tiny": DepthAnythingConfig(TINY, 64, NARROW, has_gaussian_head=True),
    "gs-giantlike": DepthAnythingConfig(
        replace(TINY, blocks=40, output_block_ids=(19, 27, 33, 39), first_multi_view_block=13),
        256,
        WIDE,
        True,
    ),
    "metric-tiny": METRIC_TINY,
    "nested-tiny": NestedConfig(DepthAnythingConfig(), METRIC_TINY),
}
"""Configurations of the fixtures' networks by the prefix of their names."""
OFFICIAL = {
    "da3-small": "da3-small",
    "da3-base": "da3-base",
    "da3-large": "da3-large",
    "da3-giant": "da3-giant",
    "da3metric-large": "da3-metric-large",
}
"""Published lists of tensors and our names of their networks."""


def weighted(network: nn.Module, multipliers: dict[str, float]) -> nn.Module:
    """Load the fixtures' weights; parts of a nested network have names of their own."""
    if isinstance(network, NestedDepthAnything):
        weighted(network.da3, multipliers)
        weighted(network.da3_metric, multipliers)
        return network
    weights = {
        key: rule_v1(key, value.shape, multipliers.get(key, 1.0))
        for key, value in network.state_dict().items()
    }
    network.load_state_dict(weights, strict=True)
    return network


@cache
def network_for(name: str) -> DepthAnything | MetricDepthAnything | NestedDepthAnything:
    """Return the shared network of a fixture with its weights; do not modify it."""
    multipliers = json.loads((FIXTURES / "multipliers.json").read_text())["multipliers"]
    return (
        weighted(create_depth_anything(STAND_INS[name]), multipliers).eval().requires_grad_(False)
    )


def shapes_in(path: Path) -> dict[str, tuple[int, ...]]:
    """List names and shapes in a weight file; shared tensors occur once."""
    listed = json.loads(path.read_text())
    aliases = listed.get("aliases") or {}
    return {key: tuple(s) for key, (s, _) in listed["keys"].items() if key not in aliases}


@dataclass
class Outputs:
    """Outputs of a network's modules in one pass, by name."""

    of: dict[str, object]

    def watch(self, network: nn.Module) -> list[torch.utils.hooks.RemovableHandle]:
        def remember(name: str):
            return lambda _module, _given, out: self.of.__setitem__(name, out)

        return [m.register_forward_hook(remember(name)) for name, m in network.named_modules()]


def images_and_poses(case: Case) -> tuple[Tensor, Poses | None]:
    """Load the network input, with poses normalised as in the authors' inference."""
    images = normalize_colors(case.tensor("in_image_u8"))
    if "in_c2w" not in case.values:
        return images, None
    given = Poses(case.tensor("in_c2w"), case.tensor("in_intrinsics_px"))
    return images, normalize_poses(given, compute_authors_units(given.centers))


def between(outputs: dict[str, object], network: nn.Module) -> dict[str, Tensor]:
    """Collect intermediate values by the names of the fixtures."""
    found = {}
    tokens = outputs["backbone.pretrained"]
    for i, handed_on in enumerate(tokens):
        found[f"feat{i}"], found[f"cls{i}"] = handed_on.patches, handed_on.camera
        found[f"pyr{i}"] = outputs[f"head.resize_layers.{i}"]
    for i in range(network.config.vit.blocks):
        found[f"blk{i}"] = outputs[f"backbone.pretrained.blocks.{i}"]
    names = {
        "ref4": "head.scratch.refinenet4",
        "ref1": "head.scratch.refinenet1",
        "neck": "head.scratch.output_conv1",
        "logits": "head.scratch.output_conv2",
        "cam_token": "cam_enc",
        "pose_enc": "cam_dec",
        "merger": "gs_head.images_merger",
        "gsneck": "gs_head.scratch.output_conv1",
    }
    return found | {name: outputs[key] for name, key in names.items() if key in outputs}


def through_any_view(network: DepthAnything, case: Case) -> tuple[Prediction, dict[str, Tensor]]:
    """Run the network; return intermediate values, too."""
    images, poses = images_and_poses(case)
    outputs = Outputs({})
    hooks = outputs.watch(network)
    with torch.no_grad():
        predicted = network(images, poses)
    for hook in hooks:
        hook.remove()
    found = between(outputs.of, network)
    scenes, views = images.shape[:2]
    if poses is not None:
        found["ext_norm"] = invert_rigid(poses.c2w)
    if predicted.raw is not None:
        found["raw_gs"] = predicted.raw[..., :37]
    start = network.config.vit.first_multi_view_block
    tokens = found[f"blk{start - 2}"].unflatten(0, (scenes, views))[:, :, 0]
    found["ref_view"] = select_reference_view(tokens) if views > 1 else torch.zeros(scenes)
    return predicted, found


def errors_of(found: dict[str, Tensor], case: Case, kind: str, stride: int) -> dict[str, float]:
    """Compute the largest relative error of each array; some are stored in part."""
    errors = {}
    for name, value in found.items():
        if f"{kind}_{name}" not in case.values:
            continue
        expected = case.tensor(f"{kind}_{name}")
        stored = value if value.shape == expected.shape else value.flatten()[::stride]
        if not expected.any():
            assert stored.shape == expected.shape
            errors[f"{kind}_{name}"] = stored.abs().max().item()
            continue
        errors[f"{kind}_{name}"] = relative_error(stored, expected)
    return errors


def any_view_errors(network: DepthAnything, case: Case) -> dict[str, float]:
    """Compute the errors of an any-view network and of its Gaussians, if any."""
    predicted, found = through_any_view(network, case)
    stride = int(case.values["mid_stride"])
    out = outputs_of(predicted) | {"depth": predicted.depth, "depth_conf": predicted.confidence}
    out["pose_enc"] = found["pose_enc"]
    errors = errors_of(found, case, "mid", stride) | errors_of(out, case, "out", stride)
    if "out_align_scale" in case.values:
        pairs = zip(
            case.values["in_c2w"][..., :3, 3], get_camera_centers(predicted.poses), strict=True
        )
        scales = [fit_robust_similarity(known, ours).scale for known, ours in pairs]
        expected = case.tensor("out_align_scale")
        errors["out_align_scale"] = relative_error(torch.tensor(scales).to(expected), expected)
    if predicted.raw is None:
        return errors
    used = case.values.get("out_pose_scale_used", np.ones(len(predicted.raw)))
    gaussians = predicted.create_gaussians(torch.from_numpy(used).float())
    return errors | gaussian_errors(gaussians, case, "out_")


def outputs_of(predicted: Prediction, scale: float = 1.0) -> dict[str, Tensor]:
    """Convert the predicted cameras to a unit of 1 / `scale`."""
    w2c = invert_rigid(predicted.poses.c2w)[:, :, :3].clone()
    w2c[..., 3] *= scale
    return {
        "extrinsics": w2c,
        "intrinsics": predicted.poses.K,
    }


def gaussian_errors(gaussians: PixelGaussians, case: Case, prefix: str) -> dict[str, float]:
    """Compute the errors of Gaussians: SH degree by degree, rotations up to sign."""
    step = int(case.values["stride"])
    names = ("means", "scales", "opacities")
    values = {name: getattr(gaussians, name).flatten(1, 3)[:, ::step] for name in names}
    errors = {
        prefix + name: relative_error(value, case.tensor(prefix + name))
        for name, value in values.items()
        if prefix + name in case.values
    }
    expected = case.tensor(prefix + "rotations")
    ours = gaussians.quats.flatten(1, 3)[:, ::step]
    same_sign = (ours * expected).sum(-1, keepdim=True).sign()
    errors[prefix + "rotations"] = relative_error(same_sign * ours, expected)
    if prefix + "harmonics" in case.values:
        harmonics = case.tensor(prefix + "harmonics").transpose(-1, -2)
        ours = gaussians.sh.flatten(1, 3)[:, ::step]
        for degree in range(3):
            part = slice(degree**2, (degree + 1) ** 2)
            key = f"{prefix}harmonics_{degree}"
            errors[key] = relative_error(ours[..., part, :], harmonics[..., part, :])
    return errors


def metric_errors(network: MetricDepthAnything, case: Case) -> dict[str, float]:
    """Compute the errors of the metric network."""
    images, _ = images_and_poses(case)
    outputs = Outputs({})
    hooks = outputs.watch(network)
    with torch.no_grad():
        predicted = network(images)
    for hook in hooks:
        hook.remove()
    found = between(outputs.of, network) | {"depth_before_sky": predicted.depth}
    out = {"depth": set_sky_depth(predicted.depth, predicted.solid_mask), "sky": predicted.sky}
    stride = int(case.values["mid_stride"])
    return errors_of(found, case, "mid", stride) | errors_of(out, case, "out", stride)


def nested_errors(network: NestedDepthAnything, case: Case) -> dict[str, float]:
    """Compute the errors of the nested network."""
    images, poses = images_and_poses(case)
    outputs = Outputs({})
    hooks = outputs.watch(network)
    with torch.no_grad():
        predicted = network(images, poses)
    for hook in hooks:
        hook.remove()
    out = outputs_of(predicted.any_view, predicted.scale) | {
        "pose_enc": outputs.of["da3.cam_dec"],
        "depth": predicted.depth,
        "depth_conf": predicted.confidence,
        "scale_factor": torch.tensor(predicted.scale, dtype=torch.float64),
    }
    return errors_of(out, case, "out", EVERY)


def errors_in(path: Path) -> dict[str, float]:
    """Compute the errors of all arrays of a case."""
    case, network = Case.load(path), network_for(path.stem.split("_")[0])
    if isinstance(network, NestedDepthAnything):
        return nested_errors(network, case)
    if isinstance(network, MetricDepthAnything):
        return metric_errors(network, case)
    return any_view_errors(network, case)
