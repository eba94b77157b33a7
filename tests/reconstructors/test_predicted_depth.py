"""Monocular depth helps stereo where that measures nothing, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter import InputError, load_reconstructor
from gscompleter.reconstructors import RECONSTRUCTORS
from gscompleter.reconstructors.depth_predictors import predict_nothing
from gscompleter.reconstructors.from_depth import FromDepth
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from gscompleter.reconstructors.plane_sweep.predicted_depth import WEIGHT, add_prediction
from gscompleter.reconstructors.plane_sweep.sweep import Measurement
from gscompleter.types import DepthMap
from scenes import Room, camera_at, view_of

PLANES = np.linspace(0.1, 1.3, 61, dtype=np.float32)
RNG = np.random.default_rng(0)
INVERSE = RNG.uniform(0.2, 1.2, (40, 50)).astype(np.float32)
INDEX = (INVERSE - PLANES[0]) / (PLANES[1] - PLANES[0])
KNOWN = (RNG.random(INVERSE.shape) < 0.5).astype(np.float32)
FOUND = Measurement(PLANES, INDEX * KNOWN, KNOWN, KNOWN)


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


def test_a_prediction_is_aligned_and_fills_what_is_not_measured():
    wrong = np.where(RNG.random(INVERSE.shape) < 0.2, 3.0, 0.4 * INVERSE + 0.3)
    guided = add_prediction(FOUND, predict(wrong.astype(np.float32)))
    right = wrong < 3
    assert np.abs(guided.index - INDEX)[right].max() < 0.05
    assert np.array_equal(guided.index[KNOWN > 0], FOUND.index[KNOWN > 0])
    assert np.array_equal(guided.weight, np.where(KNOWN > 0, KNOWN, WEIGHT))
    assert np.array_equal(guided.confidence, KNOWN)


def test_a_prediction_that_does_not_fit_changes_nothing():
    upside_down = add_prediction(FOUND, predict(1.5 - INVERSE))
    assert np.array_equal(upside_down.weight, FOUND.weight)
    unmeasured = replace(FOUND, confidence=np.zeros_like(KNOWN))
    assert add_prediction(unmeasured, predict(INVERSE)) is unmeasured
    nothing = predict_nothing(view_of(Room(), camera_at(size=40)))
    assert not nothing.valid.any()


def test_true_depth_helps_at_a_blank_wall():
    views = [view_of(Room(), camera_at(x, size=96)) for x in (-0.2, 0.2)]
    blank = [torch.where((v.depth > 2.9)[..., None], 0.5, v.image) for v in views]
    views = [replace(v, image=image) for v, image in zip(views, blank, strict=True)]
    errors = []
    for psi in (PlaneSweep(), PlaneSweep(predict_depth=lambda v: predict((1 / v.depth).numpy()))):
        pairs = zip(psi.estimate_depths(views), views, strict=True)
        errors.append(np.mean([((d.depth - v.depth).abs() / v.depth).mean() for d, v in pairs]))
    assert errors[1] < 0.7 * errors[0]


def test_a_reconstructor_that_uses_no_depth_refuses_it(monkeypatch):
    monkeypatch.setitem(RECONSTRUCTORS, "mine", lambda weights, device: lambda views: None)
    assert load_reconstructor("mine")
    with pytest.raises(InputError, match="'mine' uses no monocular depth; leave it out"):
        load_reconstructor("mine", depth="moge-2")
