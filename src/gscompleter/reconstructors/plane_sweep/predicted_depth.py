"""Depth that a network predicts from one image, as a weak observation where stereo measures nothing.

It has to earn its place: it must tell hidden blocks of stereo better than the surfaces that are
continued without it (`hidden_blocks`), and no photograph may be reproduced worse with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gscompleter.reconstructors.plane_sweep.hidden_blocks import (
    MIN_CONFIDENCE,
    anchor_depth,
    compare_in_hidden_blocks,
    support,
)
from gscompleter.reconstructors.plane_sweep.surfaces import Image
from gscompleter.reconstructors.plane_sweep.sweep import Mask, Measurement
from gscompleter.system.errors import join_names
from gscompleter.types import DepthMap

MAX_RATIO = 0.95
"""Largest error in hidden blocks with the prediction, relative to that without it."""
MAX_NAMED = 8
"""Most images that a sentence names."""
UNTESTED = "stereo measures too little there to test it"
CONTRADICTED = "continued surfaces tell hidden blocks of stereo as well as it does, or better"


@dataclass(frozen=True)
class Supported:
    """What is observed of an image with its prediction, or without it."""

    measured: Measurement
    share: float = 0.0
    """Share of the pixels that the prediction supports."""
    refusal: str = ""
    """Why it is not used; empty if it is used, or if it says nothing."""


def add_prediction(
    measured: Measurement, predicted: DepthMap, image: Image, sky: Mask
) -> Supported:
    """Use predicted depth where stereo measured nothing, if stereo confirms it elsewhere.

    The sky has no depth to predict, and its stereo is arbitrary.
    """
    known = predicted.valid.cpu().numpy() & ~sky
    full = measured.resize_to(known.shape)
    share = float((known & (full.weight == 0)).mean())
    if share == 0:
        return Supported(measured)

    guess = np.where(known, 1 / predicted.depth.cpu().numpy().clip(1e-9), 0).astype(np.float32)
    errors = compare_in_hidden_blocks(guess, full, image)
    if errors is None:
        return Supported(measured, refusal=UNTESTED)
    if errors.ratio > MAX_RATIO:
        return Supported(measured, refusal=CONTRADICTED)
    anchored = anchor_depth(guess, full, known & (full.confidence >= MIN_CONFIDENCE))
    if anchored is None:
        return Supported(measured, refusal=CONTRADICTED)
    return Supported(support(full, anchored, known), share)


def describe_support(parts: Sequence[Supported], names: Sequence[str]) -> tuple[str, ...]:
    """Write one line on where predictions are used, and where not and why; none without any."""
    sentences = []
    used = [(part, name) for part, name in zip(parts, names, strict=True) if part.share]
    if used:
        most = max(part.share for part, _ in used)
        sentences.append(
            f"The predicted depth is used in {join_names([name for _, name in used], MAX_NAMED)} "
            f"where stereo measures nothing, at up to {most:.1%} of the pixels."
        )
    for reason in dict.fromkeys(part.refusal for part in parts if part.refusal):
        refused = [
            name for part, name in zip(parts, names, strict=True) if part.refusal == reason
        ]
        sentences.append(
            f"The predicted depth is not used in {join_names(refused, MAX_NAMED)}, because "
            f"{reason}."
        )
    return (" ".join(sentences),) if sentences else ()
