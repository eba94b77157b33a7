"""VolSplat: equal to the authors' code on stored cases, and at work in a completion."""

import json
from dataclasses import replace
from functools import cache

import pytest
import torch

from feed_forward_fixtures import Case, extra, published_shapes
from gscompleter import GSCompleter, InputError
from gscompleter.models.feed_forward import FeedForward, VolSplat, VolSplatConfig
from gscompleter.models.feed_forward.depth_predictor import DepthConfig
from gscompleter.models.feed_forward.inputs import create_batch
from gscompleter.models.feed_forward.volsplat import MAX_VOXEL_OFFSET, VoxelGaussians
from gscompleter.numerics.geometry import is_inside, project
from gscompleter.stages.lift import lift_pair
from gscompleter.types import SH_C0, View
from parity import assert_within
from scenes import Room, camera_at, unchecked, view_of
from volsplat_fixtures import FIXTURES, VoxelPass, with_sparse_rule

SMALL = VolSplatConfig(DepthConfig("vits", 1, 4, 4), voxel_resolution=0.02)
"""A smaller network than the published one, for tests of what does not depend on its size."""


@cache
def published() -> VolSplat:
    """Create the published architecture with the fixtures' weights."""
    return with_sparse_rule(VolSplat())


@cache
def random_network() -> VolSplat:
    torch.manual_seed(0)
    return VolSplat(SMALL).eval()


def photographs(size: int = 64) -> list[View]:
    return [view_of(Room(), camera_at(x, size=size), i) for i, x in enumerate((-0.3, 0.1))]


def test_names_and_shapes_of_the_weights_are_those_of_the_published_file():
    keys = json.loads((FIXTURES / "keys-re10k-vitb.json").read_text())["keys"]
    assert len(keys) == 806
    with torch.device("meta"):
        weights = VolSplat().state_dict()
    ours = {key: tuple(value.shape) for key, value in weights.items()}
    assert ours == published_shapes("volsplat", "keys-re10k-vitb")


def check(case: Case) -> None:
    """Compare all stored arrays at common voxels.

    Points on the border of two voxels are assigned by the last bit of their depth, so a few voxels
    exist only here or only in the authors' output.
    """
    network = published()
    network.config = VolSplatConfig(voxel_resolution=float(case.values["voxel_resolution"]))
    run = VoxelPass.through(network, case)
    ours, theirs = len(run.predicted.means), int(case.values["num_voxels"])
    shared = int((run.rows_of(case) >= 0).sum())
    assert ours + theirs - 2 * shared < 1e-3 * theirs
    errors = run.errors(case)
    assert len(errors) == 10
    assert_within(errors)


def test_voxels_with_neighbours_agree_with_the_authors_code():
    check(Case.load(FIXTURES / "v2_64x64_vox0.02.npz"))


# `test_voxels_with_neighbours_agree_with_the_authors_code` has other sizes.
@pytest.mark.slow
def test_voxels_of_the_published_size_agree_with_the_authors_code(shared):
    check(Case.load(shared / "fixtures" / "volsplat" / "v2_64x64_vox0.001.npz"))


@pytest.mark.parametrize("path", extra("volsplat"), ids=lambda path: path.stem)
def test_voxels_agree_with_the_authors_code_in_more_cases(path):
    check(Case.load(path))


def predict(network: VolSplat) -> VoxelGaussians:
    images, cameras, _ = create_batch(photographs(), SMALL.patch)
    with torch.no_grad():
        return network(images, cameras)


# `test_feed_forward.py` does so with another network.
@pytest.mark.slow
def test_weights_can_be_assigned_to_a_network_that_was_built_without_any():
    given = random_network()
    with torch.device("meta"):
        empty = VolSplat(SMALL)
    empty.load_state_dict(given.state_dict(), strict=True, assign=True)
    assert torch.equal(predict(empty.eval()).means, predict(given).means)


@pytest.mark.slow
@pytest.mark.parametrize("lower_precision", [False, True])
def test_a_gaussian_lies_within_reach_of_its_voxel(lower_precision):
    with torch.autocast("cpu", torch.bfloat16, enabled=lower_precision):
        predicted = predict(random_network())
    for field in ("depth", "means", "quats", "scales", "opacities", "sh"):
        assert getattr(predicted, field).dtype == torch.float32
        assert getattr(predicted, field).isfinite().all()
    centers = predicted.grid.coordinates[:, 1:] * SMALL.voxel_resolution
    away = (predicted.means - centers).abs().max().item() / SMALL.voxel_resolution
    assert 0.5 < away < 0.5 + MAX_VOXEL_OFFSET + 1e-3
    assert len(predicted.means) < 2 * 64 * 64


def test_a_single_voxel_has_the_mean_colour_of_all_pixels():
    views = photographs()
    network = random_network()
    try:
        network.config = replace(SMALL, voxel_resolution=1e4)
        (colour,) = FeedForward(network)(views).gaussians.sh[:, 0]
    finally:
        network.config = SMALL
    mean = torch.stack([view.image for view in views]).mean(dim=(0, 1, 2))
    assert torch.allclose(0.5 + SH_C0 * colour, mean, atol=1e-5)


def test_a_reconstruction_of_voxels_names_no_pixels_and_has_depths_within_the_crop():
    views = [
        View(view.image[:70, :75].contiguous(), replace(view.camera, width=75, height=70), i)
        for i, view in enumerate(photographs(80))
    ]
    reconstruction = FeedForward(random_network())(views)
    assert reconstruction.view_index is None
    assert reconstruction.pixel_index is None
    assert reconstruction.gaussians.sh.shape[1:] == (9, 3)
    assert (reconstruction.gaussians.generated == 0).all()
    expected = torch.zeros(70, 75, dtype=torch.bool)
    expected[3:67, 5:69] = True
    for depth, view in zip(reconstruction.depths, views, strict=True):
        assert torch.equal(depth.valid, expected)
        assert (depth.depth[~expected] == 0).all()
        within = depth.depth[expected]
        assert within.min() >= view.camera.near * 0.999
        assert within.max() <= view.camera.far * 1.001


def test_the_depth_maps_are_those_of_the_voxels():
    """Unprojected, each pixel lies in a voxel that has a Gaussian."""
    views = photographs()
    predicted = predict(random_network())
    occupied = {tuple(row) for row in predicted.grid.coordinates[:, 1:].tolist()}
    found = 0
    for view, depth in zip(views, predicted.depth, strict=True):
        points = view.camera.center + depth[..., None] * view.camera.z_rays()
        cells = torch.round(points / SMALL.voxel_resolution).long().reshape(-1, 3)
        found += sum(tuple(cell) in occupied for cell in cells.tolist())
    assert found > 0.999 * predicted.depth.numel()


def test_several_scenes_at_once_are_refused():
    images, cameras, _ = create_batch(photographs(), SMALL.patch)
    with pytest.raises(ValueError, match="one scene"):
        random_network()(images.repeat(2, 1, 1, 1, 1), cameras)


def test_a_single_view_is_refused():
    with pytest.raises(InputError, match="at least 2"):
        FeedForward(random_network())(photographs()[:1])


def test_places_that_cannot_be_counted_are_refused():
    first, second = photographs()
    c2w = second.camera.c2w.clone()
    c2w[0, 3] = 1e30
    # The constructor refuses such a camera on a CPU; on a GPU it reads no numbers.
    lost = replace(second, camera=unchecked(second.camera, c2w=c2w))
    with pytest.raises(InputError, match="not finite"):
        FeedForward(random_network())([first, lost])


def test_all_that_the_target_sees_is_lifted():
    reference, anchor = photographs()
    reconstructor = FeedForward(random_network())
    lifted = lift_pair(reconstructor, reference, anchor)
    whole = reconstructor([reference, anchor]).gaussians
    seen = is_inside(*project(whole.means, reference.camera), reference.camera)
    assert lifted.pixel_index is None
    assert torch.equal(lifted.gaussians.means, whole.means[seen])
    assert 0 < len(lifted.gaussians) <= len(whole)


class Truth:
    """Generator that renders the true scene."""

    def __call__(self, nearest, target, context):
        return view_of(Room(), target).image


# The smoke test of `test_feed_forward.py` completes with another network.
@pytest.mark.slow
def test_smoke_a_completion_runs_with_random_weights():
    """Random weights: this only checks that the stages accept Gaussians of voxels."""
    views, target = photographs(), camera_at(0.7, yaw=12, size=64)
    completion = GSCompleter(FeedForward(random_network()), Truth())(views, target)
    (result,) = completion.targets
    assert result.hole_fraction > 0.05
    assert len(result.losses["register"]) > 0
    assert len(completion.added) > 0
    assert (completion.added.generated == 1).all()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.isfinite(getattr(completion.scene, name)).all(), name
