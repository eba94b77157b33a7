"""Train the package's MVSplat from nothing on our scenes: a learned Ψ with weights of our own.

    python benchmarks/train_mvsplat.py --out OUT --steps 1000 --minutes 60
    gscompleter evaluate benchmarks/held_out.json --apart --one-per-scene --resolution 128 128 \
        --reconstructor mvsplat-re10k --weights mvsplat-re10k=OUT/mvsplat.ckpt \
        --table models ablation refinement dof alignment --out OUT/tables

The network is the one that published weights fit: 12 M parameters. It learns depth: that which a
scene has measured, and that of plane-sweep elsewhere. Nothing is rendered, and the look of the
Gaussians is no matter of learning: their head begins as opaque discs with the colours of their
pixels, and stays so. What is kept apart takes no part, nor do the frames of the held-out cases.
`mvsplat.ckpt` has the weights under the names of the authors' files, beside the state of the
training: the same command goes on with it. Steps of a seed are the same on a CPU, stopped or not.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from apart import read_used_cases
from gscompleter.data.photographs import Photographs
from gscompleter.evaluation.cases import Case, read_cases
from gscompleter.models.feed_forward.cameras import Cameras
from gscompleter.models.feed_forward.gaussian_adapter import (
    MVSPLAT_SCALES,
    MVSPLAT_SH,
    PixelGaussians,
)
from gscompleter.models.feed_forward.inputs import create_batch
from gscompleter.models.feed_forward.mvsplat import NUM_CANDIDATES, MVSplat
from gscompleter.models.weights import PUBLISHED
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from gscompleter.reconstructors.plane_sweep.gaussians import DISC_SIGMA
from gscompleter.types import SH_C0

DEVELOPMENT = Path(__file__).with_name("development.json")
HELD_OUT = Path(__file__).with_name("held_out.json")
PREFIX = PUBLISHED["mvsplat-re10k"].prefix
"""Prefix of the network's tensors in a file of its authors."""

LEARNING_RATE = 5e-4
WARM_UP = 20
"""Steps until the learning rate is reached."""
MAX_GRADIENT = 1.0
"""Largest norm of a gradient."""
MEAN_DECAY = 0.99
"""Decay of the running mean of the weights. The mean is what is kept: it stands in for a learning
rate that falls, and is as good wherever the training is stopped."""
COARSE_WEIGHT = 0.2
"""Weight of the cross-entropy over the candidate depths, beside the error of the final depth."""
MIN_TRUST = 0.1
"""Weight of depth that plane-sweep did not measure but continued."""
OPACITY = 0.95
LINEAR = 6.0
"""Input from which on a GELU is the identity, to seven digits."""
REFINED = 32
"""Channels before those of the image in the input of the head of the Gaussians."""
LOG_EVERY = 20
SAVE_EVERY = 100


@dataclass(frozen=True)
class Clip:
    """Square photographs of a scene with target depth."""

    images: Float[Tensor, "n 3 s s"]
    cameras: Cameras
    """One scene of n views."""
    depths: Float[Tensor, "n s s"]
    """z-depth in scene units, within near and far."""
    trust: Float[Tensor, "n s s"]
    """Weight of each depth, in [0, 1]."""
    frames: tuple[int, ...]
    max_gap: int
    """Largest difference of the frame numbers of a pair."""


@dataclass(frozen=True)
class Batch:
    """Pairs of photographs of one size with their targets."""

    images: Float[Tensor, "b 2 3 h w"]
    cameras: Cameras
    depths: Float[Tensor, "b 2 h w"]
    trust: Float[Tensor, "b 2 h w"]

    def to(self, device: str) -> Batch:
        """Move all tensors to `device`."""
        return Batch(
            self.images.to(device),
            self.cameras.to(device),
            self.depths.to(device),
            self.trust.to(device),
        )


def main(words: Sequence[str] | None = None) -> None:
    """Load the photographs, and train until the number of steps or the time is reached."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of weights and depths")
    parser.add_argument("--cases", type=Path, default=DEVELOPMENT, help="scenes, near and far")
    parser.add_argument("--left-out", type=Path, default=HELD_OUT, help="cases, frames never used")
    parser.add_argument("--size", type=int, default=64, help="side of the images, in pixels")
    parser.add_argument("--pairs", type=int, default=1, help="pairs of a step")
    parser.add_argument("--steps", type=int, default=1000, help="steps in all")
    parser.add_argument("--minutes", type=float, default=60.0, help="of this call, on the clock")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args(words)
    end = time.monotonic() + 60 * options.minutes
    options.out.mkdir(parents=True, exist_ok=True)
    clips = load_clips(options.cases, options.left_out, 2 * options.size, options.out)
    training = Training(options.seed, options.size, options.pairs, options.device)
    path = options.out / "mvsplat.ckpt"
    if path.is_file():
        training.restore(path)
    while training.step < options.steps and time.monotonic() < end:
        training.take_step(clips)
        if training.step % LOG_EVERY == 0:
            print(training.describe(), flush=True)
        if training.step % SAVE_EVERY == 0:
            training.save(path)
    training.save(path)
    print(f"{path}: {training.describe()}")


def load_clips(cases: Path, left_out: Path, size: int, cache: Path) -> list[Clip]:
    """Load the scenes of a file of cases, without what is apart and the frames of `left_out`."""
    never = list(read_cases(left_out))
    by_scene: dict[Path, list[Case]] = {}
    for case in read_used_cases(cases, uses_apart=False):
        by_scene.setdefault(case.scene, []).append(case)
    return [
        load_clip(of_scene, {frame for case in never for frame in list_frames(case, scene)}, size,
                  cache / f"{scene.name}-{size}.npz")
        for scene, of_scene in by_scene.items()
    ]  # fmt: skip


def list_frames(case: Case, scene: Path) -> tuple[int, ...]:
    """List all frames of a case, if it is one of this scene."""
    is_here = case.scene.resolve() == scene.resolve()
    return (*case.context, case.target, *case.neighbours) if is_here else ()


def load_clip(cases: Sequence[Case], never: set[int], size: int, cache: Path) -> Clip:
    """Load the photographs of a scene that may be used, with their target depth."""
    photographs = cases[0].open()
    frames = tuple(frame for frame in photographs.posed if frame not in never)
    gap = min(abs(case.context[0] - case.context[1]) for case in cases)
    views = photographs.views(frames, (size, size))
    images, cameras, _ = create_batch(views, patch=1)
    if not cache.is_file():
        np.savez(cache, **sweep_depths(photographs, frames, gap, size))
    taught = np.load(cache)
    depths, trust = (torch.from_numpy(taught[key]) for key in ("depths", "trust"))
    trust = trust.clamp_min(MIN_TRUST)
    for number, view in enumerate(views):
        if view.depth is not None:  # measured, where the sensor saw something
            depths[number] = view.depth.where(view.depth > 0, depths[number])
            trust[number] = trust[number].where(view.depth <= 0, 1.0)
        trust[number] *= view.valid_mask
    # What stereo only continued counts a little; the sky is as far as the range allows.
    low, high = cameras.near[0, :, None, None], cameras.far[0, :, None, None]
    # As far apart as the frames of a case: Ψ lifts a target with a photograph of the pair.
    spans = [max(w) - min(w) for w in ((*case.context, case.target) for case in cases)]
    return Clip(images[0], cameras, depths.clamp(low, high), trust, frames, max(spans))


def sweep_depths(
    photographs: Photographs, frames: Sequence[int], gap: int, size: int
) -> dict[str, np.ndarray]:
    """Measure the depth of each frame by plane-sweep, with the frame that is next to `gap` away."""
    views = photographs.views(frames, (size, size))
    depths, trust = {}, {}
    for number, frame in enumerate(frames):
        if number in depths:
            continue
        others = [other for other in range(len(frames)) if other != number]
        partner = min(others, key=lambda other: abs(abs(frames[other] - frame) - gap))
        found = PlaneSweep().estimate_depths([views[number], views[partner]])
        for at, depth in zip((number, partner), found, strict=True):
            sure = depth.valid.float() if depth.confidence is None else depth.confidence
            depths[at] = depth.depth.numpy()
            trust[at] = (sure * depth.valid).numpy()
    order = range(len(frames))
    return {
        "depths": np.stack([depths[at] for at in order]).astype(np.float32),
        "trust": np.stack([trust[at] for at in order]).astype(np.float32),
    }


def draw_batch(clips: Sequence[Clip], size: int, pairs: int, rng: np.random.Generator) -> Batch:
    """Draw pairs, each from a scene drawn at random."""
    drawn = [draw_pair(clips[rng.integers(len(clips))], size, rng) for _ in range(pairs)]
    cameras = [pair.cameras for pair in drawn]
    return Batch(
        torch.cat([pair.images for pair in drawn]),
        Cameras(
            *(
                torch.cat([getattr(c, name) for c in cameras])
                for name in ("c2w", "K", "near", "far")
            )
        ),
        torch.cat([pair.depths for pair in drawn]),
        torch.cat([pair.trust for pair in drawn]),
    )


def draw_pair(clip: Clip, size: int, rng: np.random.Generator) -> Batch:
    """Draw two photographs of a clip, a crop of both, and changes that leave the geometry true."""
    first = int(rng.integers(len(clip.frames)))
    gaps = np.abs(np.subtract(clip.frames, clip.frames[first]))
    chosen = [first, int(rng.choice(np.flatnonzero((gaps > 0) & (gaps <= clip.max_gap))))]
    images, depths, trust = clip.images[chosen], clip.depths[chosen], clip.trust[chosen]
    c2w, K = clip.cameras.c2w[:, chosen].clone(), clip.cameras.K[:, chosen].clone()
    near, far = clip.cameras.near[:, chosen], clip.cameras.far[:, chosen]

    # From a window of `size` pixels, seen as in a larger image, to the whole photograph.
    whole = images.shape[-1]
    side = int(rng.integers(size, whole + 1))
    top, left = (int(rng.integers(whole - side + 1)) for _ in range(2))
    rows, columns = slice(top, top + side), slice(left, left + side)
    K[..., 0, 2] -= left / whole
    K[..., 1, 2] -= top / whole
    K[..., :2, :] *= whole / side
    images = F.interpolate(images[..., rows, columns], (size, size), mode="area")
    maps = torch.stack([depths, trust], 1)[..., rows, columns]
    depths, trust = F.interpolate(maps, (size, size), mode="nearest-exact").unbind(1)

    if rng.random() < 0.5:  # the mirrored scene
        images, depths, trust = (part.flip(-1) for part in (images, depths, trust))
        K[..., 0, 2] = 1 - K[..., 0, 2]
        mirror = torch.diag(c2w.new_tensor([-1, 1, 1, 1]))
        c2w = mirror @ c2w @ mirror
    gains = rng.uniform(0.8, 1.2) * rng.uniform(0.9, 1.1, (3, 1, 1))
    images = (images * torch.from_numpy(gains).float()).clamp(0, 1)
    return Batch(images[None], Cameras(c2w, K, near, far), depths[None], trust[None])


class Training:
    """A network, its optimiser, and the running mean of its weights."""

    def __init__(self, seed: int, size: int, pairs: int, device: str) -> None:
        self.drawn = {"seed": seed, "size": size, "pairs": pairs}
        """Values that the steps are drawn by; a training with others does not go on from these."""
        self.device = device
        torch.manual_seed(seed)
        self.network = MVSplat()
        set_appearance(self.network)
        self.network.to(device)
        self.optimizer = torch.optim.Adam(self.network.parameters(), LEARNING_RATE)
        self.mean = {name: value.clone() for name, value in self.network.state_dict().items()}
        self.step = 0
        self.cpu_seconds = 0.0
        self.losses: dict[str, float] = {}
        """Running mean of each loss."""
        # Logits of the candidate depths, which are no output of the network.
        self.logits: list[Tensor] = []
        head = self.network.depth_predictor.depth_head_lowres
        head.register_forward_hook(lambda module, given, out: self.logits.append(out))

    def take_step(self, clips: Sequence[Clip]) -> None:
        """Draw pairs and follow the gradient of their losses."""
        began = time.process_time()
        # A generator for each step: a training that was stopped goes on as if it was not.
        rng = np.random.default_rng((self.drawn["seed"], self.step))
        batch = draw_batch(clips, self.drawn["size"], self.drawn["pairs"], rng).to(self.device)
        self.logits.clear()
        predicted = self.network(batch.images, batch.cameras)
        losses = {
            "depth": compute_depth_loss(predicted, batch),
            "coarse": COARSE_WEIGHT * compute_coarse_loss(self.logits[0], batch),
        }
        for group in self.optimizer.param_groups:
            group["lr"] = LEARNING_RATE * min(1.0, (self.step + 1) / WARM_UP)
        self.optimizer.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), MAX_GRADIENT)
        self.optimizer.step()

        # The mean begins short, or it would remember the random weights.
        kept = min(MEAN_DECAY, (1 + self.step) / (10 + self.step))
        for name, value in self.network.state_dict().items():
            self.mean[name].lerp_(value, 1 - kept)
        for name, loss in losses.items():
            now = float(loss.detach())
            self.losses[name] = 0.95 * self.losses.get(name, now) + 0.05 * now
        self.step += 1
        self.cpu_seconds += time.process_time() - began

    def describe(self) -> str:
        """Describe how far it came, in a line."""
        losses = ", ".join(f"{name} {value:.4f}" for name, value in self.losses.items())
        return f"step {self.step}, {self.cpu_seconds / 60:.1f} CPU minutes: {losses}"

    def save(self, path: Path) -> None:
        """Save the mean of the weights for the package, and what the next step needs."""
        content = {
            "state_dict": {PREFIX + name: value.cpu() for name, value in self.mean.items()},
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "drawn": self.drawn,
            "step": self.step,
            "cpu_seconds": self.cpu_seconds,
            "losses": self.losses,
        }
        part = path.with_suffix(".part")
        torch.save(content, part)
        os.replace(part, path)  # a training that is killed leaves the last whole file

    def restore(self, path: Path) -> None:
        """Take over the state of a training that was stopped."""
        content: dict[str, Any] = torch.load(path, map_location=self.device, weights_only=True)
        if content["drawn"] != self.drawn:
            raise SystemExit(f"{path} is of {content['drawn']}; name another folder by --out.")
        self.network.load_state_dict(content["network"])
        self.optimizer.load_state_dict(content["optimizer"])
        tensors = content["state_dict"].items()
        self.mean = {name.removeprefix(PREFIX): value for name, value in tensors}
        self.step = content["step"]
        self.cpu_seconds = content["cpu_seconds"]
        self.losses = content["losses"]


def set_appearance(network: MVSplat) -> None:
    """Set the head of the Gaussians to opaque discs with the colours of their pixels.

    The loss has no gradient in this head. The correction of the coarse depth begins at zero.
    """
    into, _, out = network.depth_predictor.to_gaussians
    to_disparity = network.depth_predictor.to_disparity[-1]
    # Offset, scale, rotation (xyzw) and the SH of each colour; the constant coefficient is first.
    _, scale, rotation, *colours = out.bias.split([2, 3, 4, *[MVSPLAT_SH] * 3])
    low, high = MVSPLAT_SCALES
    with torch.no_grad():
        for parameter in (out.weight, out.bias, to_disparity.weight, to_disparity.bias):
            parameter.zero_()
        to_disparity.bias[1] = torch.logit(torch.tensor(OPACITY))
        # The scale is in fifths of a pixel.
        scale.fill_(torch.logit(torch.tensor((5 * DISC_SIGMA - low) / (high - low))))
        rotation[3] = 1.0
        into.weight[:3].zero_()
        into.bias[:3] = LINEAR
        for number, colour in enumerate(colours):
            # From the image, which follows the refined maps, through a unit of its own.
            into.weight[number, REFINED + number, 1, 1] = 1.0
            out.weight[9 + number * MVSPLAT_SH, number, 1, 1] = 1 / SH_C0
            colour[0] = -(LINEAR + 0.5) / SH_C0


def average(values: Float[Tensor, "*n"], weights: Float[Tensor, "*n"]) -> Float[Tensor, ""]:
    """Average values by weights, which may all be 0."""
    return (values * weights).sum() / weights.sum().clamp_min(1e-6)


def compute_depth_loss(predicted: PixelGaussians, batch: Batch) -> Float[Tensor, ""]:
    """Compute the mean error of the logarithm of the depth."""
    distances = batch.depths * compute_ray_lengths(batch)
    return average((predicted.depth.log() - distances.log()).abs(), batch.trust)


def compute_ray_lengths(batch: Batch) -> Float[Tensor, "b 2 h w"]:
    """Compute the distance of the centre of each pixel at a z-depth of 1."""
    h, w = batch.depths.shape[-2:]
    x = (torch.arange(w, device=batch.depths.device) + 0.5) / w
    y = (torch.arange(h, device=batch.depths.device) + 0.5) / h
    columns, rows = torch.meshgrid(x, y, indexing="xy")
    pixels = torch.stack([columns, rows, torch.ones_like(rows)])
    rays = torch.einsum("bvij,jhw->bvihw", torch.linalg.inv(batch.cameras.K), pixels)
    return rays.norm(dim=2)


def compute_coarse_loss(logits: Float[Tensor, "n d p q"], batch: Batch) -> Float[Tensor, ""]:
    """Compute the cross-entropy over the candidates, between the two that the depth lies between.

    Without it, all candidates get their gradient from one number, their mean.
    """
    low, high = batch.cameras.compute_inverse_range()
    # The coarse map is enlarged with corners on corners.
    rows, columns = (
        torch.linspace(0, full - 1, coarse).round().long().to(logits.device)
        for full, coarse in zip(batch.depths.shape[-2:], logits.shape[-2:], strict=True)
    )
    depths = batch.depths.flatten(0, 1)[:, None][..., rows[:, None], columns]
    trust = batch.trust.flatten(0, 1)[..., rows[:, None], columns]
    at = ((1 / depths - low) / (high - low) * (NUM_CANDIDATES - 1)).clamp(0, NUM_CANDIDATES - 1)
    before = at.floor().long().clamp_max(NUM_CANDIDATES - 2)
    chances = logits.log_softmax(1)
    share = at - before
    entropy = -(1 - share) * chances.gather(1, before) - share * chances.gather(1, before + 1)
    return average(entropy[:, 0], trust)


if __name__ == "__main__":
    main()
