"""Data sets loaded as by the data loaders of the networks' authors in test mode.

Ours reads any posed photographs exactly. The loaders of pixelSplat (MVSplat, VolSplat) and of
DepthSplat differ from it and from each other in the crop, in the scenes that they leave out and in
the order of the views. Published scores belong to their batches, so the presets make the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gscompleter.config.settings import Settings
from gscompleter.data.photographs import AuthorsCrop, Photographs
from gscompleter.evaluation.cases import SkippedScene
from gscompleter.evaluation.protocols import EvaluationIndex, EvaluationProtocol, Split


@dataclass(frozen=True, kw_only=True)
class AuthorsLoader(Settings):
    """Rules by which the authors' code loads a data set."""

    image_size: tuple[int, int]
    """Height and width of the stored photographs; scenes with another size are left out."""
    is_resized: bool
    """True if photographs are resized to cover the crop, False if it is cut out of them."""
    sorts_frames: bool
    """True if context and targets are sorted by frame, False if they keep the index's order."""
    max_coordinate: float | None = None
    """Largest coordinate of a camera that is used, in scene units; None for any. The authors test
    the positive side alone."""

    def make_crop(self, height: int, width: int) -> AuthorsCrop:
        """Return the crop to this size."""
        return AuthorsCrop(height, width, self.is_resized)

    def find_skip_reason(self, clip: Photographs, frames: Sequence[int]) -> str | None:
        """Explain why the authors' code leaves out these frames of a clip; None if it does not.

        Their limit of the field of view is that of `Photographs.find_skip_reason`.
        """
        for number in frames:
            width, height = clip.frame(number).size()
            if (height, width) != self.image_size:
                needed = f"{self.image_size[1]} × {self.image_size[0]}"
                return (
                    f"frame {number}: its {width} × {height} pixels are not the {needed} of this "
                    "data set (another resolution takes any)"
                )
            # In the world of the file: the origin of `clip` moves for remote cameras.
            highest = float(clip.frame(number).c2w[:3, 3].max())
            if self.max_coordinate is not None and highest > self.max_coordinate:
                return (
                    f"frame {number}: its coordinate {highest:g} is above {self.max_coordinate:g}"
                )
        return None

    def choose_splits(
        self, protocol: EvaluationProtocol, clip: Photographs, skipped: list[SkippedScene]
    ) -> EvaluationProtocol:
        """Return the splits of a clip that the authors' code keeps, and append to `skipped`."""
        kept: list[Split] = []
        reasons: list[str] = []
        for split in protocol.select_splits(clip):
            # Frames beyond the end are reported with the protocol (`make_tasks`).
            frames = [frame for frame in (*split.context, *split.targets) if frame < len(clip)]
            reason = self.find_skip_reason(clip, frames)
            if reason is None:
                kept.append(split.sort_frames() if self.sorts_frames else split)
            else:
                reasons.append(reason)
        if reasons:  # one line for a scene, which has the same defect in all of its cases
            count = f" (and {len(reasons) - 1} more cases)" if len(reasons) > 1 else ""
            skipped.append(SkippedScene(clip.name, reasons[0] + count))
        return EvaluationIndex(protocol.name, {clip.name: tuple(kept)})
