"""Thin gaps: cracks count, wide holes and opaque surfaces do not."""

import pytest
import torch

from gscompleter.evaluation.gap_pictures import LABEL_HEIGHT, PIXEL_ZOOM, draw_gap
from gscompleter.evaluation.metrics.thin_gaps import (
    WINDOW,
    find_thin_gaps,
    find_worst_gap,
    measure_flight,
    measure_thin_gaps,
    plan_flight,
    render_flight,
)
from gscompleter.render.loading import load_renderer
from gscompleter.types import Render
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


@pytest.mark.parametrize(("width", "counted"), [(2, 2), (3, 0)])
def test_along_the_border_of_the_image_a_crack_is_thinner_than_three_pixels(width, counted):
    alpha = torch.ones(SIDE, SIDE)
    alpha[:, :width] = 0.6
    assert measure_thin_gaps(alpha) == pytest.approx(counted / SIDE)


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
    whole = measure_flight(render_flight(scene, cameras, target, renderer))
    # Two of ten columns of pixels are taken out.
    columns = torch.arange(len(scene)) % SIDE
    flight = render_flight(scene[columns % 10 > 1], cameras, target, renderer)
    assert measure_flight(flight) > whole + 0.02
    worst = find_worst_gap(flight)
    assert worst is not None
    assert worst.share == pytest.approx(
        max(measure_thin_gaps(render.alpha) for render in flight.values())
    )


def make_render(alpha: torch.Tensor) -> Render:
    """Return a white surface of some opacity."""
    return Render(alpha[..., None].repeat(1, 1, 3), torch.ones_like(alpha), alpha)


def test_the_worst_place_is_the_window_with_most_gaps_of_all_renders():
    little, much = torch.ones(2, 200, 300)
    little[:, 100] = 0.5
    much[:, 100] = 0.5
    much[40:60, 250:252] = 0.0  # 40 pixels, less than the 64 of a line
    much[150:160, 110:113] = 0.0
    renders = {"at the target": make_render(little), "beside it": make_render(much)}
    worst = find_worst_gap(renders)
    assert worst.where == "beside it"
    assert worst.share == pytest.approx((64 + 30) / WINDOW**2)
    assert worst.left <= 100 < 113 <= worst.left + WINDOW
    assert worst.top <= 150 < 160 <= worst.top + WINDOW
    # Around the middle of its gaps.
    assert worst.left + WINDOW // 2 == (100 + 113) // 2
    window = much[worst.box]
    assert torch.equal(worst.crop[..., 0], window)

    picture = draw_gap(worst)
    side = PIXEL_ZOOM * WINDOW
    assert picture.shape == (LABEL_HEIGHT + side, 2 * side, 3)
    # The pixels of the window as squares below a line that is not empty, and again with marks.
    pixels = picture[LABEL_HEIGHT::PIXEL_ZOOM, ::PIXEL_ZOOM]
    assert (pixels[:, :WINDOW, 0] == (255 * window + 0.5).int().numpy()).all()
    is_marked = (pixels[:, WINDOW:] == (255, 0, 255)).all(axis=-1)
    assert (is_marked == find_thin_gaps(much)[worst.box].numpy()).all()
    assert is_marked.mean() == pytest.approx(worst.share)
    assert (picture[:LABEL_HEIGHT] == 0).any()


def test_without_gaps_there_is_no_place_and_the_picture_says_so():
    assert find_worst_gap({"at the target": make_render(torch.ones(80, 90))}) is None
    assert draw_gap(None).shape == (LABEL_HEIGHT, 2 * PIXEL_ZOOM * WINDOW, 3)
    assert (draw_gap(None) == 0).any()
