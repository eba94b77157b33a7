"""Thin gaps: cracks count, wide holes and opaque surfaces do not."""

import pytest
import torch

from gscompleter.evaluation.metrics.thin_gaps import (
    find_thin_gaps,
    measure_flight,
    measure_thin_gaps,
    plan_flight,
)
from gscompleter.render.loading import load_renderer
from scenes import Room, camera_at, gaussians_of, view_of

SIDE = 40


def make_alpha(width: int, value: float) -> torch.Tensor:
    """Return opaque pixels with an upright gap in the middle."""
    alpha = torch.ones(SIDE, SIDE)
    alpha[:, 20 : 20 + width] = value
    return alpha


@pytest.mark.parametrize("width", [1, 2, 4])
def test_a_crack_counts_with_its_area(width):
    assert measure_thin_gaps(make_alpha(width, 0.6)) == pytest.approx(width / SIDE)


def test_a_wide_hole_its_rim_and_what_is_opaque_do_not_count():
    alpha = make_alpha(8, 0.2)
    assert not find_thin_gaps(alpha).any()
    # A rim that is uneven by a pixel is none, either.
    alpha[::3, 19] = 0.6
    assert not find_thin_gaps(alpha).any()
    assert not find_thin_gaps(make_alpha(2, 0.9)).any()


def test_a_crack_beside_a_hole_counts():
    alpha = make_alpha(8, 0.0)
    alpha[:, 5] = 0.7
    assert find_thin_gaps(alpha)[:, 5].all()
    assert measure_thin_gaps(alpha) == pytest.approx(1 / SIDE)


def test_a_flight_leads_from_the_nearest_photograph_to_the_target():
    photographs = [camera_at(-1.0, size=SIDE), camera_at(0.0, size=SIDE)]
    target = camera_at(0.5, size=SIDE)
    places = [camera.center[0].item() for camera in plan_flight(photographs, target)]
    assert places == pytest.approx([0.1, 0.2, 0.3, 0.4], abs=1e-5)


def test_gaps_open_on_the_flight_where_gaussians_are_missing():
    view = view_of(Room(), camera_at(0.0, size=SIDE))
    scene = gaussians_of(view)
    renderer = load_renderer("cpu")
    cameras = [view.camera]
    target = camera_at(0.05, size=SIDE)
    whole = measure_flight(scene, cameras, target, renderer)
    # Two of ten columns of pixels are taken out.
    columns = torch.arange(len(scene)) % SIDE
    torn = measure_flight(scene[columns % 10 > 1], cameras, target, renderer)
    assert torn > whole + 0.02
