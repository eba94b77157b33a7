"""Matching within depth bands: the same costs and paths as with all planes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter.evaluation.metrics.image import compute_gradient_energy_ratio
from gscompleter.numerics.kernels import stereo
from gscompleter.numerics.kernels.stereo import TILE_COLUMNS, TILE_ROWS
from gscompleter.reconstructors.plane_sweep import PlaneSweep, matching, sweep
from gscompleter.reconstructors.plane_sweep.matching import compute_costs
from gscompleter.reconstructors.plane_sweep.rig import build_rig
from gscompleter.reconstructors.plane_sweep.sweep import (
    compute_plane_index,
    compute_tile_grid,
    make_bands,
    make_full_bands,
    make_guided_bands,
    place_planes,
    sweep_views,
)
from gscompleter.render.loading import load_renderer
from gscompleter.types import sh_from_rgb
from scenes import Room, camera_at, view_of

SIZE = 200
NEAR, FAR = 1.0, 10.0


def volume(costs, bands, size, planes, missing):
    """Costs [h, w, d], `missing` at the planes outside of the band of their tile."""
    dense = np.full((*size, planes), missing, np.float32)
    for row, top in enumerate(range(0, size[0], TILE_ROWS)):
        for column, left in enumerate(range(0, size[1], TILE_COLUMNS)):
            block = np.s_[top : top + TILE_ROWS, left : left + TILE_COLUMNS]
            low, high = bands.low[row, column], bands.high[row, column]
            start, end = bands.start[row * bands.low.shape[1] + column :][:2]
            part = costs[start:end].reshape(*dense[block].shape[:2], high - low)
            dense[block][..., low:high] = part
    return dense


def one_path(costs, dy, dx, small, large):
    """Costs along the paths that arrive from (-dy, -dx), plane by plane and pixel by pixel."""
    h, w = costs.shape[:2]
    reached = np.zeros_like(costs)
    rows = range(h) if dy > 0 or (dy == 0 and dx > 0) else range(h - 1, -1, -1)
    columns = range(w) if dx > 0 or (dx == 0 and dy > 0) else range(w - 1, -1, -1)
    for y in rows:
        for x in columns:
            reached[y, x] = costs[y, x]
            if 0 <= y - dy < h and 0 <= x - dx < w:
                before = reached[y - dy, x - dx]
                beside = np.pad(before, 1, constant_values=1e9)
                steps = np.minimum(beside[:-2], beside[2:]) + small
                cheapest = np.minimum(np.minimum(steps, before), before.min() + large)
                reached[y, x] += cheapest - before.min()
    return reached


@pytest.fixture(scope="module")
def rig():
    """Two photographs of a room, large enough to be matched at half their size first."""
    views = [view_of(Room(), camera_at(x, size=SIZE)) for x in (-0.2, 0.2)]
    return build_rig(views), views


def test_costs_lie_without_gaps_in_the_order_of_the_tiles():
    size = (2 * TILE_ROWS + 3, TILE_COLUMNS + 5)
    high = np.arange(6).reshape(compute_tile_grid(size)) + 1
    bands = make_bands(np.zeros_like(high), high, size)
    pixels = np.outer([TILE_ROWS, TILE_ROWS, 3], [TILE_COLUMNS, 5])
    np.testing.assert_array_equal(np.diff(bands.start), (pixels * high).flatten())


def test_a_band_holds_the_very_costs_of_all_planes(rig):
    (image, other), transform = rig[0].images, rig[0].transforms[0, 1]
    planes = place_planes(image, [(other, transform)], NEAR, FAR)
    everything = make_full_bands(image.size, len(planes))
    low = np.random.default_rng(0).integers(0, len(planes) - 9, everything.low.shape)
    bands = make_bands(low, low + 9, image.size)
    dense, banded = (
        volume(
            compute_costs(image, [(other, transform)], planes, b), b, image.size, len(planes), -1
        )
        for b in (everything, bands)
    )
    within = banded >= 0
    assert within.sum() == 9 * SIZE**2
    np.testing.assert_array_equal(banded[within], dense[within])


def test_paths_cross_from_band_to_band():
    size, planes = (2 * TILE_ROWS, TILE_COLUMNS + 9), 12
    rng = np.random.default_rng(0)
    low = np.array([[0, 3], [5, 7]])
    bands = make_bands(low, low + np.array([[6, 4], [7, 5]]), size)
    costs = rng.integers(0, 254, bands.start[-1]).astype(np.uint8)
    h, w = size
    small, large = np.int16(25), np.int16(90)
    penalties = [
        np.full(s, large) for s in ((h, w - 1), (h - 1, w), (h - 1, w - 1), (h - 1, w - 1))
    ]
    total = stereo.aggregate_semi_globally(costs, bands, *penalties, small)
    dense = volume(costs, bands, size, planes, 1e9)
    steps = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]
    expected = sum(one_path(dense, dy, dx, small, large) for dy, dx in steps)
    found = volume(total, bands, size, planes, -1)
    within = found >= 0
    np.testing.assert_array_equal(found[within], expected[within])
    index, margin = stereo.select_planes(total, bands, h, w)
    best = np.where(within, expected, 1e9).argmin(-1)
    assert (np.abs(index - best) <= 0.5).all()
    assert (margin >= 0).all()


def test_bands_around_a_guess_hold_the_truth_at_a_fraction_of_the_planes(rig):
    stereo_rig, views = rig
    guess, _ = sweep_views(stereo_rig.halve(), NEAR / stereo_rig.unit, FAR / stereo_rig.unit)
    image = stereo_rig.images[0]
    sources = [(stereo_rig.images[1], stereo_rig.transforms[0, 1])]
    planes = place_planes(image, sources, NEAR / stereo_rig.unit, FAR / stereo_rig.unit)
    bands = make_guided_bands(
        compute_plane_index(planes, guess.inverse), 2, image.size, len(planes)
    )
    true = compute_plane_index(planes, stereo_rig.unit / views[0].depth.numpy())
    rows, columns = np.indices(image.size) // np.array([TILE_ROWS, TILE_COLUMNS])[:, None, None]
    low, high = bands.low[rows, columns], bands.high[rows, columns]
    assert ((true >= low) & (true <= high - 1)).mean() > 0.96
    assert (high - low).mean() < 0.5 * len(planes)


def test_two_large_photographs_are_measured_as_well_as_at_all_planes(rig, monkeypatch):
    views, truth = rig[1], rig[1][0].depth
    guided = PlaneSweep().estimate_depths(views)[0]
    monkeypatch.setattr("gscompleter.reconstructors.plane_sweep.sweep.MIN_GUIDED_SIDE", SIZE + 1)
    plain = PlaneSweep().estimate_depths(views)[0]

    def off(found):
        return ((found.depth - truth).abs() / truth).median().item()

    assert off(guided) < 1.1 * off(plain)
    assert guided.valid.float().mean() > 0.95 * plain.valid.float().mean()


def test_coarse_images_say_first_where_to_look_down_to_the_smallest(rig, monkeypatch):
    stereo_rig, views = rig
    depths, seen = (NEAR / stereo_rig.unit, FAR / stereo_rig.unit), []

    def counted(reference, sources, planes, bands):
        seen.append((reference.size, bands.start[-1]))
        return compute_costs(reference, sources, planes, bands)

    monkeypatch.setattr(matching, "compute_costs", counted)
    monkeypatch.setattr(sweep, "MIN_GUIDED_SIDE", SIZE // 2)
    guided = sweep_views(stereo_rig, *depths)
    assert [size for size, _ in seen] == [
        (s, s) for s in (SIZE // 4, SIZE // 2, SIZE) for _ in "ab"
    ]
    work = sum(cells for _, cells in seen)
    seen.clear()
    monkeypatch.setattr(sweep, "MIN_GUIDED_SIDE", SIZE + 1)
    plain = sweep_views(stereo_rig, *depths)
    assert work < 0.6 * sum(cells for _, cells in seen)
    truth = stereo_rig.unit / views[0].depth.numpy()
    errors = [np.abs(sweeps[0].inverse - truth) / truth for sweeps in (guided, plain)]
    assert np.median(errors[0]) < 1.1 * np.median(errors[1])


def test_of_a_synthesized_image_only_what_is_wanted_is_lifted(rig):
    views = rig[1]
    wanted = torch.zeros(views[0].image.shape[:2], dtype=torch.bool)
    wanted[50:90, 120:] = True
    found = PlaneSweep().lift(views, wanted)
    assert (found.view_index == 0).all()
    assert found.pixel_index.tolist() == torch.nonzero(wanted.flatten())[:, 0].tolist()
    z = (found.gaussians.means - views[0].camera.center) @ views[0].camera.forward
    truth = views[0].depth.flatten()[found.pixel_index]
    assert ((z - truth).abs() / truth).median() < 0.02
    assert len(found.depths) == 2


def test_what_is_lifted_shows_the_synthesized_image_as_sharply_as_it_is(rig):
    views = rig[1]
    wanted = torch.zeros(views[0].image.shape[:2], dtype=torch.bool)
    wanted[40:100, 90:] = True
    inner = torch.zeros_like(wanted)
    inner[45:95, 95:-5] = True
    lifted = PlaneSweep().lift(views, wanted).gaussians
    plain = replace(lifted, sh=sh_from_rgb(views[0].image[wanted]))
    fitted, blurred = (
        load_renderer("cpu").render(g, views[0].camera).image for g in (lifted, plain)
    )
    ratios = [compute_gradient_energy_ratio(x, views[0].image, inner) for x in (fitted, blurred)]
    assert ratios[1] < 0.9
    assert 0.9 < ratios[0] < 1.1
    errors = [(x - views[0].image)[inner].square().mean() for x in (fitted, blurred)]
    assert errors[0] < 0.5 * errors[1]
