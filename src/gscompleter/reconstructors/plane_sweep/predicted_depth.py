"""Depth that a network predicts of an image, as a weak observation where stereo measures nothing.

It has to earn its place: it must tell hidden blocks of stereo better than the surfaces that are
continued without it (`hidden_blocks`). No photograph may be reproduced worse with it by more than
`MAX_LOSS` of `reconstructor`; of a synthesized image only the blocks are asked, as what its
additions do to photographs is the business of the guards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gscompleter.reconstructors.plane_sweep.hidden_blocks import (
    MIN_CONFIDENCE,
    anchor_depth,
    compare_in_hidden_blocks,
    support,
)
from gscompleter.reconstructors.plane_sweep.surfaces import ColorImage
from gscompleter.reconstructors.plane_sweep.sweep import Mask, Measurement
from gscompleter.types import DepthMap

MAX_PREDICTED_RATIO = 0.95
"""Largest error in hidden blocks with the prediction, relative to that without it: decision 078."""
UNTESTED = "stereo measures too little there to test it"
CONTRADICTED = "continued surfaces tell hidden blocks of stereo as well as it does, or better"
DISAGREEING = "its near and far disagree with stereo, as those of disparity instead of depth do"


@dataclass(frozen=True)
class Supported:
    """What is observed of an image with its prediction, or without it."""

    measured: Measurement
    """At full size if the prediction is used, else as it was given, perhaps halved."""
    share: float = 0.0
    """Share of the pixels that the prediction supports."""
    refusal: str = ""
    """Why it is not used; empty if it is used, or if it says nothing."""

    def refuse(self, reason: str) -> Supported:
        """Return a copy that says why a used prediction is not; `measured` still holds it."""
        return replace(self, share=0.0, refusal=reason) if self.share else self


def add_prediction(
    measured: Measurement, predicted: DepthMap, image: ColorImage, sky: Mask
) -> Supported:
    """Use predicted depth where stereo measured nothing, if stereo confirms it elsewhere.

    The sky has no depth to predict, and its stereo is arbitrary.
    """
    # Infinity is far away and known: its inverse depth is 0, and stereo tests it as any other.
    known = predicted.valid.cpu().numpy() & ~sky
    full = measured.resize_to(known.shape)
    share = float((known & (full.weight == 0)).mean())
    if share == 0:
        return Supported(measured)

    guess = np.where(known, 1 / predicted.depth.cpu().numpy().clip(1e-9), 0).astype(np.float32)
    errors = compare_in_hidden_blocks(guess, known, full, image)
    if errors is None:
        return Supported(measured, refusal=UNTESTED)
    if not errors.is_anchored:
        return Supported(measured, refusal=DISAGREEING)
    if errors.ratio > MAX_PREDICTED_RATIO:
        return Supported(measured, refusal=CONTRADICTED)
    anchored = anchor_depth(guess, full, known & (full.confidence >= MIN_CONFIDENCE))
    if anchored is None:
        return Supported(measured, refusal=DISAGREEING)
    return Supported(support(full, anchored, known), share)


def describe_support(
    parts: Sequence[Supported], name_images: Callable[[Sequence[int]], str]
) -> tuple[str, ...]:
    """Write one line on where predictions are used, and where not and why; none without any.

    `name_images` names images by their indices.
    """
    sentences = []
    used = [number for number, part in enumerate(parts) if part.share]
    if used:
        most = max(part.share for part in parts)
        sentences.append(
            f"The predicted depth is used in {name_images(used)}, where stereo measures nothing "
            f"(up to {most:.1%} of the pixels)."
        )
    for reason in dict.fromkeys(part.refusal for part in parts if part.refusal):
        refused = [number for number, part in enumerate(parts) if part.refusal == reason]
        sentences.append(
            f"The predicted depth is not used in {name_images(refused)}, because {reason}."
        )
    return (" ".join(sentences),) if sentences else ()
