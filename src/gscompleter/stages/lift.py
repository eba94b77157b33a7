"""Stage 2: lift the synthesized image and its anchor to Gaussians (paper, Eq. 7)."""

from __future__ import annotations

from dataclasses import replace

from jaxtyping import Bool
from torch import Tensor

from gscompleter.numerics.geometry import adapt_to_mode, is_inside, project
from gscompleter.reconstructors import Reconstructor, run_reconstructor
from gscompleter.stages.select_anchor import Anchor
from gscompleter.stages.target_view import TargetView
from gscompleter.system.timing import timed_stage
from gscompleter.types import Lift, View


@timed_stage("lift")
def lift(reconstructor: Reconstructor, reference: View, anchor: Anchor, view: TargetView) -> Lift:
    """Lift the pixels near holes to Gaussians in the antialiasing mode of the scene."""
    lifted = lift_pair(reconstructor, reference, anchor.view, view.candidate_mask)
    adapted = adapt_to_mode(view.state.rendered_context, lifted.gaussians, reference.camera)
    return replace(lifted, gaussians=adapted)


def lift_pair(
    reconstructor: Reconstructor,
    reference: View,
    anchor: View,
    pixel_mask: Bool[Tensor, "h w"] | None = None,
) -> Lift:
    """Lift `Ψ((Ĩ_t, P_t), (I_s, P_s))` and keep the target's Gaussians (paper, Eq. 7).

    These are all that the target sees if Ψ is not pixel-aligned, else those inside `pixel_mask`.
    """
    pair = run_reconstructor(reconstructor, [reference, anchor], pixel_mask)
    reference_depth, anchor_depth = pair.depths
    # A Ψ that is not pixel-aligned names no pixels to select by.
    if pair.view_index is None or pair.pixel_index is None:
        seen = is_inside(*project(pair.gaussians.means, reference.camera), reference.camera)
        return Lift(pair.gaussians[seen], reference_depth, anchor_depth, None, pair.notes)
    own = pair.view_index == 0
    if pixel_mask is not None:
        # The anchor may have another size, so that its pixel indices are replaced by 0.
        own &= pixel_mask.flatten()[pair.pixel_index.where(own, 0)]
    pixels = pair.pixel_index[own]
    return Lift(pair.gaussians[own], reference_depth, anchor_depth, pixels, pair.notes)
