"""Thin out additions where several of them stand for one place of a surface (not in the paper).

Ψ makes a Gaussian of each pixel of each photograph, so that a splat that is filled from eight
photographs doubled or trebled. What no photograph needs is dropped, by the rule of the cleaning
(`stages/superfluous.py`), but only where another addition stays in its place: photographs do not
tell what one sees from elsewhere, and a surface that they did not need had holes there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import CleaningConfig
from gscompleter.render.protocols import FrozenScene
from gscompleter.stages.error_budgets import add_psnr_loss
from gscompleter.stages.superfluous import exclude_needed_additions, sum_error_changes
from gscompleter.types import Gaussians, View

THINNING = CleaningConfig(probes=2)
"""What photographs may lose by additions that are dropped: that of the cleaning. Its probes are
fewer, as photographs are compared again afterwards."""
PLACE_REACH = 2.0
"""Distance, in multiples of the largest scale of each of two additions, up to which one stands in
the place of the other. Scales of a pixel's Gaussian are about half of the pixel."""
MAX_STAND_INS = 8
"""Nearest additions that may stand in the place of one."""


def drop_doubled(
    added: Gaussians, views: Sequence[View], frozen: Sequence[FrozenScene]
) -> Gaussians:
    """Drop additions that photographs do not need and in whose place others stay.

    `frozen` is the scene at the photographs without them.
    """
    plans = [scene.vary_opacities(added) for scene in frozen]
    none = torch.zeros_like(added.opacities, dtype=torch.bool)
    changes = sum_error_changes(added.opacities, none, views, frozen, plans, THINNING)
    doubled = find_doubled(added, changes.find_removable(THINNING), changes.lost)

    limits = [add_psnr_loss(error, THINNING.tolerance) for error in changes.errors]
    gone = exclude_needed_additions(plans, added.opacities, doubled, views, limits)
    return added[~gone]


def find_doubled(
    added: Gaussians, removable: Bool[Tensor, "n"], lost: Float[Tensor, "n"]
) -> Bool[Tensor, "n"]:
    """Find removable additions that another one stands for, which stays.

    Those that photographs lose least by, as `lost` tells, are dropped first.
    """
    from scipy.spatial import cKDTree  # loaded by those who need it: it takes 0.1 s

    if len(added) < 2:
        return torch.zeros_like(removable)
    means = added.means.cpu().double().numpy()
    reach = PLACE_REACH * added.scales.amax(dim=1).cpu().double().numpy()
    # The first neighbour of each is itself.
    count = min(MAX_STAND_INS + 1, len(added))
    distances, neighbours = cKDTree(means).query(means, count)
    is_near = distances <= np.minimum(reach[:, None], reach[neighbours])
    near = [row[is_close] for row, is_close in zip(neighbours, is_near, strict=True)]

    gone = np.zeros(len(added), bool)
    # Who stands for another one has to stay.
    is_kept = ~removable.cpu().numpy()
    for row in torch.argsort(lost, stable=True).tolist():
        if is_kept[row]:
            continue
        others = near[row][~gone[near[row]]]
        others = others[others != row]
        if len(others):
            gone[row] = True
            is_kept[others[0]] = True
    return torch.from_numpy(gone).to(removable.device)
