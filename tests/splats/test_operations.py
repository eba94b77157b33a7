"""What `convert` does to Gaussians: cut, scale, turn, move, and reduce."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gscompleter import InputError, load_renderer
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.splats.operations import Operations, make_rotation
from gscompleter.types import Camera, Gaussians
from scenes import Room, camera_at, gaussians_of, random_gaussians, view_of

RENDERER = load_renderer("cpu")
SCENE = random_gaussians(300, seed=4, sh_degree=3)
CAMERA = camera_at(size=48)


def moved_with(camera: Camera, operations: Operations) -> Camera:
    """Move a camera as the splat is moved; a scale moves its centre only."""
    similarity = operations.similarity
    assert similarity is not None
    rotation = make_rotation(operations.rotate).float()
    c2w = torch.eye(4)
    c2w[:3, :3] = rotation @ camera.c2w[:3, :3]
    c2w[:3, 3] = similarity[:3, :3].float() @ camera.center + similarity[:3, 3].float()
    near = None if camera.near is None else operations.scale * camera.near
    far = None if camera.far is None else operations.scale * camera.far
    return replace(camera, c2w=c2w, near=near, far=far)


@pytest.mark.parametrize(
    "operations",
    [
        Operations(translate=(0.5, -2.0, 1.0)),
        Operations(scale=3.0),
        Operations(rotate=(20.0, -130.0, 75.0)),
        Operations(scale=0.5, rotate=(90.0, 0.0, 180.0), translate=(1.0, 2.0, 3.0)),
    ],
)
def test_a_camera_that_moves_with_the_splat_sees_the_same(operations):
    """Harmonics of degree 3 turn with it, too."""
    before = RENDERER.render(SCENE, CAMERA)
    after = RENDERER.render(operations.apply(SCENE), moved_with(CAMERA, operations))
    assert before.alpha.max() > 0.5
    assert (before.image - after.image).abs().max() < 1e-3 * before.image.max()


def test_angles_are_about_x_then_y_then_z():
    turned = make_rotation((90.0, 0.0, 90.0)) @ torch.tensor([0.0, 1.0, 0.0]).double()
    # About x, y becomes z, which a turn about z leaves as it is.
    assert turned.tolist() == [0.0, 0.0, 1.0]
    assert torch.allclose(
        make_rotation((0.0, 30.0, 0.0)) @ make_rotation((10.0, 0.0, 0.0)),
        make_rotation((10.0, 30.0, 0.0)),
    )


def test_a_box_and_a_sphere_keep_what_lies_in_both():
    box = (-0.5, -0.4, 0.0, 0.6, 0.4, 9.0)
    center = SCENE.means.mean(dim=0)
    radius = (SCENE.means - center).norm(dim=1).median().item()
    kept = Operations(box=box, sphere=(*center.tolist(), radius)).apply(SCENE)
    low, high = torch.tensor(box[:3]), torch.tensor(box[3:])
    inside = ((SCENE.means >= low) & (SCENE.means <= high)).all(dim=1)
    inside &= (SCENE.means - center).norm(dim=1) <= radius
    assert 0 < inside.sum() < len(SCENE)
    assert torch.equal(kept.means, SCENE.means[inside])
    assert torch.equal(kept.sh, SCENE.sh[inside])


def test_what_is_cut_off_is_cut_before_it_moves():
    operations = Operations(sphere=(0.0, 0.0, 0.0, 1e3), translate=(5000.0, 0.0, 0.0))
    assert len(operations.apply(SCENE)) == len(SCENE)


def test_a_shift_leaves_everything_else_bit_for_bit():
    moved = Operations(translate=(1.0, 0.0, 0.0)).apply(SCENE)
    for name in ("quats", "scales", "opacities", "sh", "generated"):
        assert torch.equal(getattr(moved, name), getattr(SCENE, name))


@pytest.mark.parametrize("bands", [0, 1, 2, 3])
def test_bands_above_a_degree_are_left_out(bands):
    kept = Operations(bands=bands).apply(SCENE)
    assert kept.sh_degree == bands
    assert torch.equal(kept.sh, SCENE.sh[:, : (bands + 1) ** 2])
    assert Operations(bands=3).apply(random_gaussians(5, sh_degree=1)).sh_degree == 1


@pytest.mark.parametrize("wanted", [0.5, 0.25, 700])
def test_a_number_or_a_share_is_kept_and_covers_the_same(wanted):
    """What is merged looks better than as many that are left over."""
    view = view_of(Room(), camera_at(size=64))
    scene = gaussians_of(view)
    count = round(wanted * len(scene)) if isinstance(wanted, float) else wanted
    kept = Operations(decimate=wanted).apply(scene)
    assert 0.95 * count <= len(kept) <= count

    def score(part: Gaussians) -> float:
        return psnr(RENDERER.render(part, view.camera).image, view.image)

    order = torch.randperm(len(scene), generator=torch.Generator().manual_seed(0))
    assert score(kept) > score(scene[order[:count]]) + 1.0
    assert len(Operations(decimate=10 * len(scene)).apply(scene)) == len(scene)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"box": (1.0, 0.0, 0.0, 0.0, 1.0, 1.0)}, "smallest x, y and z"),
        ({"sphere": (0.0, 0.0, 0.0, 0.0)}, "positive radius"),
        ({"scale": 0.0}, "above 0"),
        ({"translate": (float("inf"), 0.0, 0.0)}, "A number is needed"),
        ({"decimate": 0}, "have to be left"),
    ],
)
def test_numbers_that_mean_nothing_are_refused(wrong, sentence):
    with pytest.raises(InputError, match=sentence):
        Operations(**wrong)
