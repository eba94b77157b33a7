"""Stage 4: keep Gaussians in holes (paper, Sec. III-F)."""

from __future__ import annotations

from jaxtyping import Bool, Int
from torch import Tensor

from gscompleter.numerics.geometry import project_mask
from gscompleter.parts import PartOrigin, label_gaussians
from gscompleter.stages.target_view import TargetView
from gscompleter.system.timing import timed_stage
from gscompleter.types import Camera, Gaussians, Registration


@timed_stage("integrate")
def filter_holes(moved: Registration, view: TargetView) -> Gaussians:
    """Keep registered Gaussians inside the dilated hole mask, labelled with the target's id."""
    kept = select_in_mask(
        moved.gaussians, moved.pixel_index, view.addition_mask, view.camera.padded
    )
    return label_gaussians(kept, PartOrigin("target", view.state.next_target_id))


def select_in_mask(
    registered: Gaussians,
    pixel_index: Int[Tensor, "n"] | None,
    mask: Bool[Tensor, "h w"],
    target: Camera,
) -> Gaussians:
    """Keep Gaussians inside `mask`, by their source pixel if known, otherwise by projection."""
    if pixel_index is not None:
        return registered[mask.flatten()[pixel_index]]
    return registered[project_mask(mask, registered, target)]
