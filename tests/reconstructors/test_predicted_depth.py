"""Monocular depth helps stereo where that measures nothing, if stereo confirms it elsewhere."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter import GSCompleter, InputError, load_reconstructor
from gscompleter.apps.report.plain_words import list_notes
from gscompleter.apps.report.schema import read_summary
from gscompleter.reconstructors import RECONSTRUCTORS
from gscompleter.reconstructors.depth_predictors import predict_nothing
from gscompleter.reconstructors.features.given_range import find_depth_range
from gscompleter.reconstructors.from_depth import FromDepth
from gscompleter.reconstructors.plane_sweep import PlaneSweep, reconstructor
from gscompleter.reconstructors.plane_sweep.hidden_blocks import WEIGHT
from gscompleter.reconstructors.plane_sweep.predicted_depth import (
    CONTRADICTED,
    DISAGREEING,
    UNTESTED,
    add_prediction,
)
from gscompleter.reconstructors.plane_sweep.sweep import Measurement
from gscompleter.stages.context import prepare_single
from gscompleter.types import DepthMap, Reconstruction, View
from scenes import Room, camera_at, view_of

SIZE = 96
PLANES = np.linspace(0.1, 1.3, 61, dtype=np.float32)
Y, X = np.indices((SIZE, SIZE)) / SIZE
TRUE = view_of(Room(), camera_at(size=SIZE)).depth.numpy()
KNOWN = np.float32((X > 0.3) | (Y > 0.6))
"""Stereo measures all but the upper left corner."""
FOUND = Measurement(PLANES, KNOWN * (1 / TRUE - PLANES[0]) / (PLANES[1] - PLANES[0]), KNOWN, KNOWN)
GREY = np.full((SIZE, SIZE, 3), 0.5, np.float32)
NO_SKY = np.zeros((SIZE, SIZE), bool)
WAVES = (2.5 + np.sin(12 * Y) * np.cos(18 * X)).astype(np.float32)
"""Depth of no room."""


def test_a_single_photograph_of_a_surface_before_an_infinite_sky_is_reconstructed():
    view = view_of(Room(), camera_at(size=32))
    bare = View(view.image, replace(view.camera, near=None, far=None), 0)
    depth = torch.full((32, 32), 3.0)
    depth[:8] = torch.inf
    answer = DepthMap(depth, torch.ones_like(depth, dtype=torch.bool))
    (given,) = prepare_single(PlaneSweep(predict_depth=lambda view: answer), [bare])
    assert given.given_depth.tolist() == depth.where(depth == 3.0, 0.0).tolist()
    found = find_depth_range([given])
    assert found.near < 3.0 < found.far


def predict(inverse) -> DepthMap:
    depth = torch.from_numpy(1 / inverse)
    return DepthMap(depth, torch.ones_like(depth, dtype=torch.bool))


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        (lambda d: d, "has to return a gscompleter.types.DepthMap .*, and returned a tensor"),
        (lambda d: None, "has to return a gscompleter.types.DepthMap .*, and returned None"),
        (lambda d: DepthMap(d[:9], d[:9] > 0), r"shape \[9, 32\] for a view of shape \[32, 32\]"),
        (lambda d: DepthMap(0 * d, d > 0), "NaN or not above 0; mark these pixels as not valid"),
        (lambda d: DepthMap(d * float("nan"), d > 0), "NaN or not above 0"),
    ],
)
def test_what_is_no_depth_of_its_view_is_refused(answer, sentence):
    views = [view_of(Room(), camera_at(x, size=32)) for x in (-0.2, 0.2)]
    depth = torch.ones(32, 32)
    with pytest.raises(InputError, match=sentence):
        PlaneSweep(predict_depth=lambda view: answer(depth))(views)
    with pytest.raises(InputError, match=sentence):
        FromDepth(model=lambda views: [answer(depth) for _ in views])(views)


def test_a_depth_model_answers_for_every_view():
    views = [view_of(Room(), camera_at(x, size=32)) for x in (-0.2, 0.2)]
    depth = DepthMap(torch.ones(32, 32), torch.ones(32, 32, dtype=torch.bool))
    with pytest.raises(
        InputError, match="a list of 2 depth maps, one for each view, and returned 1"
    ):
        FromDepth(model=lambda views: [depth])(views)


def photographs(blank_from: float = 4.5) -> list[View]:
    """Take two photographs of a room whose far wall is blank, where stereo measures nothing."""
    views = [view_of(Room(), camera_at(x, size=SIZE), n) for n, x in enumerate((-0.2, 0.2))]
    return [
        replace(v, image=torch.where((v.depth > blank_from)[..., None], 0.5, v.image))
        for v in views
    ]


@pytest.fixture(scope="module")
def plain() -> Reconstruction:
    """Reconstruct them without predicted depths."""
    return PlaneSweep()(photographs())


def reconstruct(depth_of) -> Reconstruction:
    """Reconstruct them with predicted depths by frame."""
    return PlaneSweep(predict_depth=lambda v: predict(1 / depth_of(v).numpy()))(photographs())


def test_a_prediction_is_anchored_and_fills_what_is_not_measured():
    # An affine function of inverse depth, and an error that varies slowly over the image.
    inverse = ((0.4 / TRUE + 0.1) * (1 + 0.1 * X)).astype(np.float32)
    part = add_prediction(FOUND, predict(inverse), GREY, NO_SKY)
    empty = KNOWN == 0
    found = 1 / (PLANES[0] + part.measured.index * (PLANES[1] - PLANES[0]))
    assert np.abs(found / TRUE - 1)[empty].mean() < 0.04
    assert np.array_equal(part.measured.index[~empty], FOUND.index[~empty])
    assert np.array_equal(part.measured.weight, np.where(empty, WEIGHT, 1))
    assert np.array_equal(part.measured.confidence, KNOWN)
    assert part.share == pytest.approx(empty.mean())
    # The sky has no depth to predict.
    assert add_prediction(FOUND, predict(inverse), GREY, empty).measured is FOUND


@pytest.mark.parametrize(
    ("inverse", "refusal"),
    [
        (1 / TRUE + 0.38 / WAVES, CONTRADICTED),
        (1 / WAVES, DISAGREEING),
        (1.5 - 1 / TRUE, DISAGREEING),
        (TRUE, DISAGREEING),
    ],
    ids=["waves on it", "waves", "inverted", "disparity"],
)
def test_a_prediction_that_stereo_contradicts_changes_nothing(inverse, refusal):
    part = add_prediction(FOUND, predict(inverse), GREY, NO_SKY)
    assert part.measured is FOUND
    assert part.refusal == refusal


def test_a_prediction_without_near_and_far_changes_nothing():
    part = add_prediction(FOUND, predict(np.full_like(TRUE, 0.5)), GREY, NO_SKY)
    assert part.measured is FOUND
    assert part.refusal in (CONTRADICTED, DISAGREEING)


def test_infinity_is_tested_as_any_other_depth():
    """Judge an infinite depth as a very large one: stereo measures a surface there."""
    refusals = []
    for inverse in (0.0, 1e-6):
        wrong = np.where((X + Y) % 0.2 < 0.1, np.float32(inverse), 1 / TRUE).astype(np.float32)
        with np.errstate(divide="ignore"):
            refusals.append(add_prediction(FOUND, predict(wrong), GREY, NO_SKY).refusal)
    assert refusals[0] == refusals[1] != ""
    # Where stereo measures nothing, infinity says "far", which costs nothing elsewhere.
    far = np.where(KNOWN > 0, 1 / TRUE, 0).astype(np.float32)
    with np.errstate(divide="ignore"):
        part = add_prediction(FOUND, predict(far), GREY, NO_SKY)
    assert part.share == pytest.approx((KNOWN == 0).mean())
    corner = part.measured.index[: SIZE // 3, : SIZE // 5]
    assert corner.max() < FOUND.index[KNOWN > 0].min()


def test_a_prediction_that_nothing_tests_changes_nothing():
    hardly = np.where(Y < 0.2, KNOWN, 0).astype(np.float32)
    little = replace(FOUND, weight=hardly, confidence=hardly)
    part = add_prediction(little, predict(1 / TRUE), GREY, NO_SKY)
    assert part.measured is little
    assert part.refusal == UNTESTED
    nothing = predict_nothing(view_of(Room(), camera_at(size=40)))
    assert not nothing.valid.any()


def test_true_depth_helps_at_a_blank_wall():
    views = photographs()
    errors = []
    for psi in (PlaneSweep(), PlaneSweep(predict_depth=lambda v: predict((1 / v.depth).numpy()))):
        pairs = zip(psi.estimate_depths(views), views, strict=True)
        errors.append(np.mean([((d.depth - v.depth).abs() / v.depth).mean() for d, v in pairs]))
    assert errors[1] < 0.85 * errors[0]


def test_a_wrong_prediction_changes_no_bit_and_a_line_says_so(plain):
    misled = reconstruct(lambda v: 1 / v.depth)
    assert torch.equal(misled.gaussians.means, plain.gaussians.means)
    assert torch.equal(misled.gaussians.sh, plain.gaussians.sh)
    assert misled.notes == (
        f"The predicted depth is not used in photographs 0, 1, because {DISAGREEING}.",
    )
    assert plain.notes == ()


def test_a_true_prediction_is_used_and_a_line_says_where():
    (note,) = reconstruct(lambda v: 3 * v.depth).notes
    assert re.match(
        r"The predicted depth is used in photographs 0, 1, where stereo measures nothing", note
    )


def test_a_prediction_with_which_a_photograph_loses_is_refused(plain, monkeypatch):
    # The true depth costs nothing here, so that the limit has to be lower.
    monkeypatch.setattr(reconstructor, "MAX_LOSS", -100.0)
    refused = reconstruct(lambda v: v.depth)
    assert torch.equal(refused.gaussians.means, plain.gaussians.means)
    assert re.fullmatch(
        r"The predicted depth is not used in photographs 0, 1, because photograph [01] would be "
        r"reproduced -?\d.\d\d dB worse with it\.",
        refused.notes[0],
    )


def test_losses_are_those_of_each_photograph():
    views = photographs()
    plain = PlaneSweep()(views)
    # Without the Gaussians of the right half of photograph 1, photograph 0 loses less.
    gone = (plain.view_index == 1) & (plain.pixel_index % SIZE > SIZE // 2)
    lacking = replace(plain, gaussians=plain.gaussians[~gone])
    losses = PlaneSweep().measure_losses(views, plain, lacking)
    assert losses[1] > losses[0]
    assert losses[1] > 1
    assert PlaneSweep().measure_losses(views, plain, plain) == [0, 0]


# `test_own_models.py` reads such a note in the row of an evaluation.
@pytest.mark.slow
def test_notes_reach_the_completion_and_its_summary(tmp_path):
    psi = PlaneSweep(
        predict_depth=lambda v: predict(1 / WAVES[: v.camera.height, : v.camera.width])
    )
    views = [replace(view, depth=None) for view in photographs()]
    done = GSCompleter(reconstructor=psi).begin(views)
    (note,) = done.context_notes
    assert f"The predicted depth is not used in photograph 0, because {DISAGREEING}." in note
    done.save(tmp_path / "out")
    summary = read_summary(tmp_path / "out")
    assert summary.context_notes == done.context_notes
    assert note in [line.text for line in list_notes(summary)]


def test_a_reconstructor_that_uses_no_depth_refuses_it(monkeypatch):
    monkeypatch.setitem(RECONSTRUCTORS, "mine", lambda weights, device: lambda views: None)
    assert load_reconstructor("mine")
    with pytest.raises(InputError, match="'mine' uses no monocular depth; leave it out"):
        load_reconstructor("mine", depth="moge-2")
