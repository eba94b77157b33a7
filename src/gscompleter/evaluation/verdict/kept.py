"""Measure of what a completion keeps of a given splat, seen from cameras that decided nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gscompleter.evaluation.metrics.image import compute_masked_psnr
from gscompleter.evaluation.verdict.held_out import render_before_after
from gscompleter.render.protocols import Renderer
from gscompleter.render.removed import mask_removed
from gscompleter.state import Completion
from gscompleter.types import Camera
from gscompleter.virtual_capture.render_views import MIN_OPAQUE

INVISIBLE = 45.0
"""PSNR in dB from which on a change cannot be seen, as in `psnr_guard.invisible_psnr`."""


@dataclass(frozen=True)
class KeptRow:
    """Renders of the completed scene against those of the splat, where the splat was opaque."""

    cameras: int
    """Number of cameras that see something opaque of the splat."""
    worst_psnr: float
    """Smallest PSNR over these cameras, in dB."""
    mean_psnr: float

    @property
    def is_unseen(self) -> bool:
        """True if none of the cameras sees a change."""
        return self.worst_psnr >= INVISIBLE


def measure_kept(
    completion: Completion, cameras: Sequence[Camera], renderer: Renderer
) -> KeptRow | None:
    """Measure what is kept; None if no camera sees anything opaque of the splat.

    Pixels that showed what was removed do not count: they were to change.
    """
    scores = []
    for camera in cameras:
        pair = render_before_after(completion, camera, renderer)
        is_kept = pair.before.alpha >= MIN_OPAQUE
        if len(completion.source.removed) > 0:
            is_kept = is_kept & ~mask_removed(completion.source, camera, renderer)
        wanted = pair.before.image.clamp(0, 1)
        score = compute_masked_psnr(pair.after.image, wanted, is_kept)
        if score is not None:
            scores.append(score)
    if not scores:
        return None
    return KeptRow(len(scores), min(scores), sum(scores) / len(scores))
