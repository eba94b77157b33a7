"""Given depth is a measurement: it decides where it is known, and corrects stereo beside it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter import GSCompleter, InputError
from gscompleter.evaluation.metrics.geometry import compare_depths
from gscompleter.evaluation.metrics.image import compute_masked_psnr
from gscompleter.reconstructors.features.stereo_image import make_stereo_images
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from gscompleter.reconstructors.plane_sweep.given_depth import add_given
from gscompleter.reconstructors.plane_sweep.rig import build_rig
from gscompleter.reconstructors.plane_sweep.sweep import Measurement, sweep_views
from gscompleter.render.loading import load_renderer
from gscompleter.types import DepthMap, View
from scenes import Room, camera_at, view_of

PLANES = np.linspace(0.1, 1.3, 61, dtype=np.float32)
SIZE = 64


def give(view: View, where: torch.Tensor | float = 1.0) -> View:
    """Give the true depth where a mask is True, and score with the rest."""
    given = view.depth * where
    return replace(view, depth=view.depth - given, given_depth=given)


def measured(index: float) -> Measurement:
    sure = np.ones((SIZE, SIZE), np.float32)
    return Measurement(PLANES, index * sure, sure, sure)


def test_a_given_depth_replaces_stereo():
    depth = torch.zeros(SIZE, SIZE)
    depth[30, 29:32] = 2.0
    view = replace(view_of(Room(), camera_at(size=SIZE)), depth=None, given_depth=depth)
    (image, _), _ = make_stereo_images([view, view_of(Room(), camera_at(1.0, size=SIZE))])
    unsure = replace(measured(5.0), weight=np.full_like(image.given, 0.1))
    found, known = add_given(unsure, image), depth.numpy() > 0
    assert found.index[known] == pytest.approx(20.0, abs=1e-3)  # 1 / 2 in planes
    assert (found.index[~known] == 5).all()
    assert (found.weight == np.where(known, 1, np.float32(0.1))).all()


def test_matching_carries_given_depth_along_a_blank_wall():
    cameras = [replace(camera_at(x, size=SIZE), near=1.8, far=11.0) for x in (0.0, 1.0)]
    wall, stripe, shares = torch.full((SIZE, SIZE, 3), 0.5), torch.zeros(SIZE, SIZE), []
    for depth in 0.0, 3.6:
        stripe[:, 40:42] = depth
        rig = build_rig([View(wall, cameras[0], given_depth=stripe), View(wall, cameras[1])])
        sweep = sweep_views(rig, 1.8 / rig.unit, 11.0 / rig.unit)[0]
        found = rig.unit / sweep.inverse[:, 36:56]
        shares.append((np.abs(found / 3.6 - 1) < 0.05).mean())
    assert shares[0] == 0
    assert shares[1] > 0.95


def test_blocks_of_depth_halve_the_error_between_them():
    views = [view_of(Room(), camera_at(x, size=96)) for x in (-0.2, 0.2)]
    blank = [torch.where((v.depth > 2.9)[..., None], 0.5, v.image) for v in views]
    views = [replace(v, image=image) for v, image in zip(views, blank, strict=True)]
    chessboard = torch.from_numpy(np.indices((96, 96)).sum(0) // 12 % 2 == 0)
    errors = []
    for given in views, [give(view, chessboard) for view in views]:
        depths = PlaneSweep().estimate_depths(given)
        parts = [
            compare_depths(d.depth, v.depth, ~chessboard)
            for d, v in zip(depths, views, strict=True)
        ]
        errors.append(np.mean([part.abs_rel for part in parts]))
    assert errors[1] < 0.5 * errors[0]


def test_given_depth_that_stereo_contradicts_is_left_out_and_a_line_says_so():
    views = [view_of(Room(), camera_at(x, size=64), number) for number, x in enumerate((-0.2, 0.2))]
    rows, columns = torch.linspace(0, 12, 64)[:, None], torch.linspace(0, 18, 64)
    waves = 2.5 + rows.sin() * columns.cos()
    plain = PlaneSweep()([replace(view, depth=None) for view in views])
    wrong = [replace(view, depth=None, given_depth=waves) for view in views]
    misled = PlaneSweep()([give(views[0]), wrong[1]])
    assert misled.contradicted_depths == (1,)
    assert misled.notes[0].startswith("The given depth is not used in photograph 1, because")
    both_wrong = PlaneSweep()(wrong)
    assert torch.equal(both_wrong.gaussians.means, plain.gaussians.means)

    # What the reconstructor refuses, no stage after it uses.
    state = GSCompleter().begin(wrong)
    assert state.context_notes == both_wrong.notes
    assert all(view.given_depth is None for view in state.views)


def test_given_depth_that_stereo_confirms_is_used_without_a_line():
    views = [view_of(Room(), camera_at(x, size=64), number) for number, x in enumerate((-0.2, 0.2))]
    right = PlaneSweep()([give(view) for view in views])
    assert right.contradicted_depths == ()
    assert right.notes == ()


def test_no_depth_both_constrains_and_scores():
    view = view_of(Room(), camera_at(size=SIZE))
    half = torch.arange(SIZE) < SIZE // 2
    split = give(view, half)
    assert not (split.depth * split.given_depth).any()
    with pytest.raises(InputError, match="both constrains and scores"):
        replace(view, given_depth=view.depth)


def predict_shifted(view: View) -> DepthMap:
    """Predict the room from the photograph's place at twice the size."""
    depth = 2 * view_of(Room(), view.camera).depth
    return DepthMap(depth, depth < 2 * 4.5)


@pytest.mark.parametrize("turn", [0.0, 12.0])
def test_one_photograph_with_depth_is_a_context(turn):
    view = give(view_of(Room(), camera_at(size=96)))
    target = camera_at(0.3 if turn == 0 else 0.0, size=96, yaw=turn)
    done = GSCompleter()([view], target)
    truth, renderer = view_of(Room(), target), load_renderer("cpu")
    shown = renderer.render(done.scene, target)
    hole = done.targets[0].hole_mask
    assert 0.05 < hole.float().mean() < 0.6
    assert compare_depths(shown.depth, truth.depth, ~hole).abs_rel < 0.02
    assert compare_depths(shown.depth, truth.depth, hole).abs_rel < 0.25
    before = done.targets[0].before.image

    assert compute_masked_psnr(before, truth.image, ~hole) > 22
    assert shown.alpha[hole].mean() > 0.8


def test_a_predictor_alone_sets_the_scale_of_one_photograph():
    camera = replace(camera_at(size=96), near=None, far=None)
    view = replace(view_of(Room(), camera), depth=None)
    state = GSCompleter(reconstructor=PlaneSweep(predict_depth=predict_shifted)).begin([view])
    shown = load_renderer("cpu").render(state.scene, state.views[0].camera)
    truth = 2 * view_of(Room(), camera).depth
    assert compare_depths(shown.depth, truth, truth < 9.0).abs_rel < 0.03
    with pytest.raises(InputError, match="at least 2; .* a model that predicts it"):
        GSCompleter().begin([view])
