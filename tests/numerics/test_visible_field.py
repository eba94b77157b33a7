"""The distance field of what cameras see."""

from dataclasses import replace

import numpy as np
import torch

from gscompleter.numerics.visible_field import TRUNCATION, compute_visible_field
from scenes import camera_at


def exact(x: float):
    camera = camera_at(x, size=64)
    return replace(camera, c2w=camera.c2w.double(), K=camera.K.double())


def test_a_wall_is_where_the_distance_changes_its_sign():
    """Two cameras look at a wall at z = 3, which has a hole on the right."""
    depth = torch.full((64, 64), 3.0)
    holed = depth.clone()
    holed[:, 48:] = 0
    field = compute_visible_field([exact(-0.1), exact(0.1)], [depth, holed])
    assert field is not None
    size = field.voxel_size
    z = field.origin[2] + size * np.arange(field.distance.shape[2])
    middle = field.distance.shape[0] // 2, field.distance.shape[1] // 2
    seen = field.is_seen[middle]
    assert np.allclose(field.distance[middle][seen], (3 - z[seen]).clip(max=TRUNCATION * size))
    # Before the wall and just behind it, and no farther.
    assert seen[z < 3].all()
    assert not seen[z > 3 + 1.01 * TRUNCATION * size].any()
    assert seen.sum() > TRUNCATION


def test_beyond_the_images_nothing_is_known():
    near, far = torch.full((64, 64), 2.0), torch.full((64, 64), 4.0)
    field = compute_visible_field([exact(-1.0), exact(1.0)], [near, far])
    assert field is not None
    assert 0.2 < field.is_seen.mean() < 0.9
    assert not field.distance[~field.is_seen].any()


def test_cameras_that_see_nothing_have_no_field():
    assert compute_visible_field([exact(0)], [torch.zeros(64, 64)]) is None
