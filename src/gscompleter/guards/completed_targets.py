"""Completed targets (not in the paper): what is added for one target hides no other one.

An addition may hang before what was completed earlier, where no photograph sees it, and so may what
closes the gaps beside a target before that target itself. Its colours suit the camera that it was
made for, and are wrong from others. Their images are no truth: small changes of many pixels, as by
a surface that grows denser, are let through, and only Gaussians that show as a spot are dropped
(decision 149).
"""

from __future__ import annotations

from jaxtyping import Bool
from torch import Tensor

from gscompleter.guards import Attempt, Guard
from gscompleter.render.protocols import FrozenScene
from gscompleter.render.spherical_harmonics import evaluate_colors
from gscompleter.types import Camera, Gaussians

VISIBLE_CHANGE = 20 / 255
"""Change of a colour, in any channel, from which a pixel is a spot in the image of a completed
target."""
NUM_ROUNDS = 2
"""Rounds: a Gaussian that is dropped may have hidden another one."""


class CompletedTargets(Guard):
    """Drop added Gaussians that show as spots in the images of completed targets."""

    name = "completed-targets"
    loss = "a filling would show as spots at targets before"

    def verify(self, added: Gaussians, attempt: Attempt) -> Gaussians:
        """Drop what shows mostly where the image of a completed target changes visibly."""
        view = attempt.view
        max_alpha = view.state.config.gaps.max_alpha
        for camera, frozen in zip(view.completed_cameras, view.frozen_completed, strict=True):
            # What is half transparent there shows a gap, which may be closed.
            covered = frozen.render.alpha >= max_alpha
            for _ in range(NUM_ROUNDS):
                kept = added[~find_in_spots(added, frozen, camera, covered)]
                # Without a loss another round would find the same.
                if len(kept) == len(added):
                    break
                added = kept
        return added


def find_in_spots(
    added: Gaussians, frozen: FrozenScene, camera: Camera, where: Bool[Tensor, "h w"]
) -> Bool[Tensor, "n"]:
    """Find the Gaussians that show mostly in pixels whose colour all of them change visibly.

    `frozen` is the scene without them at a camera, and only pixels of `where` count.
    """
    before = frozen.render.image
    after = frozen.composite(added).image
    change = (after.clamp(0, 1) - before.clamp(0, 1)).abs().amax(dim=-1)
    spots = (change > VISIBLE_CHANGE) & where
    # With their own colours the residual of this image is 1 in spots, and 0 elsewhere.
    colors = evaluate_colors(added.sh, added.means, camera.center)
    shown_in_spots, shown = frozen.vary_colors(added)(colors, after + spots[..., None])
    return shown_in_spots[:, 0] > 0.5 * shown
