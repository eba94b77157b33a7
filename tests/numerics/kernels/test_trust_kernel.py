"""Trust in Gaussians, by compiled loops and by plain tensors."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import normalize

from gscompleter.config import TrustConfig
from gscompleter.numerics.geometry import compute_z_depths
from gscompleter.numerics.kernels.support import MIN_ANGLE_WEIGHT, SUPPORT_BLOCK
from gscompleter.render.cpu import CpuRenderer
from gscompleter.trust.photometric import (
    FULL_TRUST_FRACTION,
    PhotoObservations,
    compute_trust,
    gather_observations,
)
from gscompleter.types import View
from scenes import camera_at, random_gaussians


def some_evidence(n: int, k: int) -> tuple[PhotoObservations, torch.Tensor, torch.Tensor]:
    """Make evidence of n Gaussians and k photographs, their means and sums; a third is zero."""
    random = torch.Generator().manual_seed(0)
    centers, means = torch.randn(k, 3, generator=random), torch.randn(n, 3, generator=random)
    areas, agreement = torch.rand(2, k, n, generator=random)
    areas = (areas - 0.3).clamp_min(0.0)
    sums = (torch.rand(n, generator=random) - 0.3).clamp_min(0.0)
    return PhotoObservations(means, centers, areas, agreement * (areas > 0)), means, sums


def expected_support(evidence, means, sums, camera, config):
    """Evaluate the definition in `kernels/support.py` in plain tensors of twice the precision."""
    rays = normalize(means - camera.center, dim=-1).double()
    seen = normalize(means[None] - evidence.centers[:, None], dim=-1).double()
    turn = torch.rad2deg(torch.acos((seen * rays).sum(-1).clamp(-1, 1)))
    weights = evidence.areas * (torch.exp(-((turn / config.angle_sigma) ** 2)) + MIN_ANGLE_WEIGHT)
    mean = (weights * evidence.agreement).sum(0) / weights.sum(0).clamp_min(1e-20)
    z = compute_z_depths(means, camera).clamp_min(0.0)
    needed = sums * z**2 / (camera.K[0, 0] * camera.K[1, 1])
    share = evidence.areas.amax(0) / (FULL_TRUST_FRACTION * needed).clamp_min(1e-20)
    return torch.where(sums > 0, mean * share.clamp_max(1.0), 1.0).float()


@pytest.mark.parametrize("n", [0, 1, SUPPORT_BLOCK - 1, 3 * SUPPORT_BLOCK + 7])
@pytest.mark.parametrize("max_turn", [20.0, 180.0])
def test_support_is_a_mean_by_direction_times_what_is_shown(n, max_turn):
    evidence, means, sums = some_evidence(n, 5)
    camera, config = camera_at(0.3, yaw=10), TrustConfig(angle_sigma=max_turn)
    found = compute_trust(evidence, sums, camera, config)
    wanted = expected_support(evidence, means, sums, camera, config)
    assert torch.allclose(found, wanted, rtol=1e-4, atol=1e-6)


def test_a_gaussian_at_a_camera_is_no_trouble():
    evidence, means, sums = some_evidence(4, 3)
    means[0], camera = evidence.centers[1], camera_at(0.0)
    means[1] = camera.center
    assert compute_trust(evidence, sums, camera).isfinite().all()


def test_evidence_is_what_the_slopes_of_a_drawing_say():
    scene, camera = random_gaussians(60, sh_degree=0), camera_at(size=40)
    frozen = CpuRenderer().freeze(scene, camera)
    view = View(torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(1)), camera)
    evidence = gather_observations(scene, [view], [frozen], TrustConfig())
    sums = frozen.backproject(torch.ones(40, 40, 3))[:, 0]
    z = compute_z_depths(scene.means, camera).clamp_min(0.0)
    areas = sums * z**2 / (camera.K[0, 0] * camera.K[1, 1])
    assert torch.allclose(evidence.areas[0], areas, rtol=1e-5)
    assert evidence.agreement.min() >= 0
    assert evidence.agreement.max() <= 1 + 1e-6
    assert (evidence.agreement[0, sums > 0] > 0).any()
