"""Ignored parts of photographs: nothing is made of them or compared with them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter import InputError
from gscompleter.config import RefineConfig, TrustConfig
from gscompleter.data.driving.vehicle import compute_moving_boxes
from gscompleter.data.formats import open_photographs
from gscompleter.data.moving_boxes import mask_moving
from gscompleter.editing.cleaning import halve_view
from gscompleter.evaluation.metrics.scores import Truth, score
from gscompleter.generators.warp import warp_photographs
from gscompleter.numerics.geometry import compute_sparse_depth, unproject
from gscompleter.render.loading import load_renderer
from gscompleter.splats.alignment.fit import score_image
from gscompleter.splats.alignment.matching import extract_view_features
from gscompleter.stages.context import drop_ignored
from gscompleter.stages.error_budgets import compute_squared_error, meet_error_budgets
from gscompleter.stages.refine import refine_opacities
from gscompleter.system.files.image import write_image
from gscompleter.trust.photometric import gather_observations
from gscompleter.types import ErrorBudget, GeneratorInput, View, sh_from_rgb
from scenes import Room, camera_at, gaussians_of, half_a_room_of, photographed, reconstruction_of
from scenes import view_of as photograph_of

SIZE = 48
ROOM = Room()
CAMERA = camera_at(size=SIZE)
RENDERER = load_renderer("cpu")


def square(low: int = 12, high: int = 30) -> torch.Tensor:
    """Make a square mask of ignored pixels."""
    mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    mask[low:high, low:high] = True
    return mask


def with_something_red(view: View) -> View:
    """Take the photograph with a red object that is to be ignored."""
    mask = square()
    red = torch.tensor([1.0, 0.0, 0.0])
    return replace(view, image=torch.where(mask[..., None], red, view.image), ignore_mask=mask)


@pytest.mark.parametrize("aligned", [True, False])
def test_nothing_is_made_of_what_is_ignored(aligned):
    views = [photograph_of(ROOM, camera_at(x, size=SIZE)) for x in (0.0, 0.3)]
    views[0] = with_something_red(views[0])
    made = reconstruction_of(views, [view.depth for view in views])
    unaligned = replace(made, view_index=None, pixel_index=None)
    scene = drop_ignored(made if aligned else unaligned, views)
    red = sh_from_rgb(torch.tensor([[1.0, 0.0, 0.0]]))
    assert ((made.gaussians.sh - red).abs().amax((1, 2)) < 1e-5).sum() == square().sum()
    assert ((scene.sh - red).abs().amax((1, 2)) > 1e-5).all()
    gone = len(made.gaussians) - len(scene)
    if aligned:
        assert gone == square().sum()
    else:
        assert square().sum() < gone < 2.2 * square().sum()


def test_what_is_ignored_forbids_nothing():
    """Additions to the right half differ from a photograph that is black there."""
    view, context, added = half_a_room_of(ROOM, CAMERA)
    mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    mask[:, SIZE // 2 :] = True
    wrong = replace(view, image=torch.where(mask[..., None], 0.0, view.image))
    frozen = RENDERER.freeze(context, CAMERA)
    for photograph, kept in ((wrong, False), (replace(wrong, ignore_mask=mask), True)):
        before = photograph.fill_ignored(frozen.render.image)
        allowed = 2 * compute_squared_error(before, photograph.image).item() + 1e-3
        plan = frozen.vary_opacities(added)
        budgets = [[ErrorBudget(photograph, "mse", allowed)]]
        mended = meet_error_budgets(added, [frozen], budgets, [plan])
        assert torch.equal(mended.opacities, added.opacities) == kept


def test_refinement_asks_nothing_there():
    view, context, added = half_a_room_of(ROOM, CAMERA)
    frozen = RENDERER.freeze(context, CAMERA)
    mask = torch.ones(SIZE, SIZE, dtype=torch.bool)
    odd = replace(view, image=1 - view.image)
    reference = photograph_of(ROOM, CAMERA)

    def refined(photographs: list[View]) -> torch.Tensor:
        plan, config = frozen.vary_opacities(added), RefineConfig(iterations=3)
        plans = [plan] * len(photographs)
        return refine_opacities(added, plan, reference, plans, photographs, config)[0].opacities

    assert torch.equal(refined([replace(odd, ignore_mask=mask)]), refined([]))
    assert not torch.equal(refined([odd]), refined([]))


def test_what_is_ignored_is_not_carried_over():
    target = camera_at(0.1, size=SIZE)
    views = (with_something_red(photograph_of(ROOM, CAMERA)),)
    scene = gaussians_of(photograph_of(ROOM, CAMERA))
    at_views = (RENDERER.render(scene, CAMERA),)
    context = GeneratorInput(views, at_views, RENDERER.render(scene, target))
    careless = replace(context, views=(replace(views[0], ignore_mask=None),))

    def reds(known: GeneratorInput) -> int:
        red, green, blue = warp_photographs(views[0], target, known).image.unbind(-1)
        return int((red - (green + blue) / 2 > 0.9).sum())

    assert reds(careless) > 0.8 * square().sum()
    assert reds(context) == 0


def test_a_splat_is_neither_distrusted_nor_placed_by_what_is_ignored():
    """The splat is right, and one of its photographs shows something red before it."""
    view = photograph_of(ROOM, CAMERA)
    scene = gaussians_of(view)
    red = with_something_red(view)
    frozen = [RENDERER.freeze(scene, CAMERA)]

    def observe(photograph: View) -> tuple[torch.Tensor, torch.Tensor]:
        found = gather_observations(scene, [photograph], frozen, TrustConfig())
        return found.areas[0], found.agreement[0]

    areas, agreement = observe(red)
    known = areas > 0
    assert known.float().mean() == pytest.approx(1 - square().float().mean().item(), abs=0.15)
    assert (agreement[known] - observe(view)[1][known]).min() > -0.1
    assert observe(replace(red, ignore_mask=None))[1].min() < 0.1
    plain, ignoring, counting = (
        score_image(frozen[0].render, photograph)
        for photograph in (view, red, replace(red, ignore_mask=None))
    )
    assert ignoring.psnr > plain.psnr - 1
    assert counting.psnr < plain.psnr - 5
    pixels = extract_view_features(red)[0].astype(int)
    assert not square()[pixels[:, 1], pixels[:, 0]].any()


def test_a_halved_photograph_ignores_what_the_whole_one_does():
    halved = halve_view(with_something_red(photograph_of(ROOM, CAMERA)))
    reds = halved.image[..., 0] - halved.image[..., 1:].mean(-1) > 0.9
    assert reds.any()
    assert not (reds & halved.valid_mask).any()


def test_scores_count_nothing_there():
    view = photograph_of(ROOM, CAMERA)
    scene = gaussians_of(view)
    red = with_something_red(view)

    def scored(photograph: View):
        truth = Truth((photograph, photograph), photograph, (photograph,))
        return score(scene, scene, scene[:0], truth, RENDERER)[0]

    plain, ignoring, counting = (scored(v) for v in (view, red, replace(red, ignore_mask=None)))
    assert counting.target_after.psnr < plain.target_after.psnr - 5
    assert ignoring.target_after.psnr == pytest.approx(plain.target_after.psnr, abs=1.0)
    assert ignoring.context_psnr[0].after == ignoring.target_after.psnr
    assert ignoring.neighbours_psnr[0].after == pytest.approx(ignoring.target_after.psnr)
    assert ignoring.target_after.ssim > plain.target_after.ssim - 1e-6
    assert counting.target_after.ssim < plain.target_after.ssim - 0.1
    moved = replace(red, depth=torch.where(square(), 5 * view.depth, view.depth))
    assert scored(moved).depth_observed.abs_rel == pytest.approx(ignoring.depth_observed.abs_rel)
    counted = scored(replace(moved, ignore_mask=None)).depth_observed
    assert counted.abs_rel > ignoring.depth_observed.abs_rel + 0.1


def test_masks_of_files_are_ignored_unless_left_out(tmp_path):
    folder = photographed(tmp_path, [camera_at(x, size=SIZE) for x in (0.0, 0.3)])
    photographs = open_photographs(folder)
    for name, mask in (("one.png", square()), ("all.png", torch.ones(SIZE, SIZE) > 0)):
        write_image(tmp_path / name, ~mask)
    frames = [
        replace(frame, mask=tmp_path / name)
        for frame, name in zip(photographs.frames, ("one.png", "all.png"), strict=True)
    ]
    masked = replace(photographs, frames=tuple(frames))
    assert torch.equal(masked.views([0])[0].ignore_mask, square())
    assert photographs.views([0])[0].ignore_mask is None
    (whole,) = masked.leave_out_masks().views([0])
    assert whole.ignore_mask is None
    assert torch.equal(whole.image, photographs.views([0])[0].image)
    assert [masked.is_hidden(frame) for frame in (0, 1)] == [False, True]
    with pytest.raises(InputError, match="All of frame 1 of .* is masked"):
        masked.views([1])


def box_at(center: tuple[float, ...], speed: float, turn: float = 0.0) -> np.ndarray:
    """Return the corners of a cube of 1 m, or none if it stands."""
    return compute_moving_boxes(np.eye(4), np.array([[*center, 1, 1, 1, turn, speed, 0.0]]))


def test_a_box_covers_its_outline():
    """A cube with its front face 2 m ahead is widened to 1.1 m: 0.55 m to either side."""
    mask = mask_moving(box_at((0.0, 0.0, 2.55), 3.0), CAMERA, CAMERA.center.double().numpy())
    half = 0.55 / 2.0 * 0.9 * SIZE
    rows, columns = torch.nonzero(torch.from_numpy(mask), as_tuple=True)
    for found in (rows, columns):
        assert found.min().item() == pytest.approx(SIZE / 2 - half, abs=1.5)
        assert found.max().item() == pytest.approx(SIZE / 2 + half, abs=1.5)
    assert mask.sum() == pytest.approx((2 * half) ** 2, rel=0.15)


@pytest.mark.parametrize(
    ("center", "speed", "share"),
    [
        ((0.0, 0.0, 3.0), 0.2, 0.0),
        ((0.0, 0.0, 3.0), np.nan, 0.03),
        ((0.0, 0.0, -3.0), 3.0, 0.0),
        ((0.0, 0.0, 0.2), 3.0, 0.99),
        ((1e7, 0.0, 3.0), 3.0, 0.0),
    ],
)
def test_boxes_that_stand_lie_behind_or_around(center, speed, share):
    mask = mask_moving(box_at(center, speed, 0.7), CAMERA, CAMERA.center.double().numpy())
    assert mask.mean() >= share
    assert share > 0 or not mask.any()


def test_the_nearest_point_of_a_pixel_tells_its_depth():
    wall = torch.full((SIZE, SIZE), 4.0)
    points = torch.cat([unproject(0.5 * (i + 2) * wall, CAMERA).reshape(-1, 3) for i in range(2)])
    behind = -points
    depth = compute_sparse_depth(torch.cat([points, behind])[::2], CAMERA)
    assert (depth[:, ::2] - 4.0).abs().max() < 1e-5
    assert (depth[:, 1::2] == 0).all()
