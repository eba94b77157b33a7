"""Measure of how a splat without photographs looks after its completion.

It is seen from further cameras around it, which took no part in the completion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gscompleter.config import PsnrGuardConfig
from gscompleter.evaluation.metrics.image import compute_masked_psnr
from gscompleter.evaluation.verdict.held_out import render_before_after
from gscompleter.render.protocols import Renderer
from gscompleter.render.removed import mask_removed
from gscompleter.state import Completion
from gscompleter.types import Camera
from gscompleter.virtual_capture.render_views import MIN_OPAQUE

INVISIBLE_PSNR = PsnrGuardConfig().invisible_psnr
"""PSNR in dB from which on a change cannot be seen. It is that of the guard by default: what a user
sees does not depend on the guard of a run."""


@dataclass(frozen=True)
class KeptRow:
    """Renders of the completed scene against those of the splat, where the splat was opaque.

    Elsewhere it has a hole or a rim of one, which the completion was to change.
    """

    cameras: int
    """Number of cameras that see something opaque of the splat."""
    worst_psnr: float
    """Smallest PSNR over these cameras, in dB."""
    mean_psnr: float
    """Mean PSNR over them, in dB."""

    @property
    def is_visibly_unchanged(self) -> bool:
        """True if no change can be seen from any of the cameras."""
        return self.worst_psnr >= INVISIBLE_PSNR


def measure_kept(
    completion: Completion, cameras: Sequence[Camera], renderer: Renderer
) -> KeptRow | None:
    """Measure how much the splat changed; None if no camera sees anything opaque of it.

    What additions in front of the splat hide counts, and so do new colours. Pixels that showed what
    was removed do not: they were to change. A camera counts from one opaque pixel on.
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
