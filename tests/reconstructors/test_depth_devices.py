"""Plane-sweep on tensors, as a GPU computes it, against the compiled loops of the CPU."""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from fake_cuda import BETWEEN_STAGES, fake_cuda, get_device
from gscompleter import InputError, load_reconstructor
from gscompleter.numerics import tensor_stereo
from gscompleter.numerics.kernels import stereo, tgv
from gscompleter.numerics.tensor_stereo import (
    OUTSIDE,
    JumpPenalties,
    MatchedSource,
    TilePlanes,
    aggregate_volumes,
    compute_cost_volume,
    prefer_given_planes,
    select_volume_planes,
)
from gscompleter.numerics.tensor_tgv import FIT_BYTES, LAUNCHES_PER_ITERATION, fit_on_device
from gscompleter.reconstructors.features.stereo_image import StereoImage
from gscompleter.reconstructors.plane_sweep import PlaneSweep, depth_devices, matching
from gscompleter.reconstructors.plane_sweep.depth_devices import TensorDepth
from gscompleter.reconstructors.plane_sweep.matching import (
    COST_RULE,
    PlaneSearch,
    aggregate,
    compute_costs,
    compute_jumps,
    estimate_group_bytes,
    group_searches,
    list_tile_planes,
    search_with_tensors,
    spread_over_tiles,
)
from gscompleter.reconstructors.plane_sweep.surfaces import FitHeights, fit_surfaces
from gscompleter.reconstructors.plane_sweep.sweep import (
    MAX_PLANES,
    make_bands,
    make_full_bands,
)
from scenes import Room, camera_at, view_of

SIZE = 40, 76
"""Rows and columns of the images, of which the last tiles are incomplete."""
NUM_PLANES = 12


def make_image(seed: int, size: tuple[int, int] = SIZE) -> StereoImage:
    """Make an image of smooth noise; its camera is not used."""
    noise = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(seed))
    smooth = torch.nn.functional.avg_pool2d(noise, 5, stride=1, padding=2)[0]
    none = np.zeros(size, np.float32)
    image = np.ascontiguousarray(smooth.permute(1, 2, 0).numpy())
    return StereoImage(image, np.eye(3), np.eye(3), np.zeros(3), none)


def make_search(size: tuple[int, int] = SIZE, planes: int = NUM_PLANES) -> PlaneSearch:
    """Make a search with three sources, of which one has another size, and bands of all widths."""
    transform = np.array(
        [[1.0137, 0.0213, -0.517, 9.137], [0.0117, 0.9913, 0.317, 1.137], [1e-4, 2e-4, 0.98, 0.11]],
        np.float32,
    )
    back = transform.copy()
    back[:, 3] *= -1
    sources = [
        (make_image(1, size), transform),
        (make_image(2, (size[0] + 9, size[1] - 7)), back),
        (make_image(3, size), np.eye(3, 4, dtype=np.float32)),
    ]
    random = np.random.default_rng(0)
    shape = make_full_bands(size, planes).low.shape
    low = random.integers(0, planes - 3, shape)
    high = random.integers(low + 1, planes + 1)
    given = random.uniform(0, planes - 1, size).astype(np.float32)
    given[random.random(size) < 0.9] = -1
    inverse_depths = np.linspace(0.0123, 1.377, planes).astype(np.float32)
    return PlaneSearch(
        make_image(0, size), sources, inverse_depths, make_bands(low, high, size), given
    )


def upload(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array))


def to_volume(costs: np.ndarray, search: PlaneSearch) -> torch.Tensor:
    """Lay costs in bands out as a volume."""
    (h, w), bands = search.reference.size, search.bands
    volume = np.full((h, w, len(search.planes)), OUTSIDE, np.uint8)
    rows, columns = stereo.TILE_ROWS, stereo.TILE_COLUMNS
    for number, (row, column) in enumerate(np.ndindex(bands.low.shape)):
        block = volume[row * rows : (row + 1) * rows, column * columns : (column + 1) * columns]
        part = costs[bands.start[number] : bands.start[number + 1]]
        low, high = bands.low[row, column], bands.high[row, column]
        block[..., low:high] = part.reshape(*block.shape[:2], high - low)
    return torch.from_numpy(volume)


def match(search: PlaneSearch) -> torch.Tensor:
    """Compute the costs of a search on tensors of the CPU."""
    sources = [
        MatchedSource(upload(image.image).permute(2, 0, 1).flatten(1), image.size, upload(moved))
        for image, moved in search.sources
    ]
    return compute_cost_volume(
        upload(search.reference.image),
        sources,
        upload(search.planes),
        TilePlanes(*map(upload, list_tile_planes(search.bands))),
        len(search.planes),
        COST_RULE,
    )


def test_matching_costs_are_those_of_the_kernel():
    search = make_search()
    costs = compute_costs(search.reference, search.sources, search.planes, search.bands)
    expected = to_volume(costs, search)
    found = match(search)
    assert found.shape == (*SIZE, NUM_PLANES)
    within = expected != OUTSIDE
    assert torch.equal(found != OUTSIDE, within)
    assert len(expected[within].unique()) > 150
    # Where the processor rounds a product and a sum at once; elsewhere more may differ, by one.
    difference = (found.int() - expected.int()).abs()
    assert difference.max() <= 1
    assert (difference > 0).sum() < 0.01 * within.sum()


def test_parts_of_a_search_make_no_difference(monkeypatch):
    search = make_search()
    whole = search_with_tensors([search], "cpu")
    monkeypatch.setattr(tensor_stereo, "PART_BYTES", 20_000)
    assert np.array_equal(search_with_tensors([search], "cpu"), whole)


@pytest.mark.parametrize("cells", [0, 2 * 40 * 76 * 17, 2**27])
def test_views_that_are_searched_together_find_what_each_finds_alone(monkeypatch, cells):
    """Of several numbers of planes, of which one has an image of another size."""
    monkeypatch.setattr(matching, "GROUP_CELLS", cells)
    searches = [
        make_search(),
        make_search((32, 65)),
        make_search(planes=17),
        replace(make_search(), reference=make_image(5)),
    ]
    sizes = {0: [1, 1, 1, 1], 2**27: [1, 3]}.get(cells, [1, 1, 2])
    assert sorted(map(len, group_searches(searches))) == sizes
    together = search_with_tensors(searches, "cpu")
    for search, found in zip(searches, together, strict=True):
        (alone,) = search_with_tensors([search], "cpu")
        assert np.array_equal(found, alone)


def test_given_depth_is_preferred_as_by_the_kernel():
    search = make_search()
    costs = np.random.default_rng(1).integers(0, 255, search.bands.start[-1]).astype(np.uint8)
    volume = to_volume(costs, search)
    prefer_given_planes(volume, upload(search.given), 1 / 8, 60.0)
    before = costs.copy()
    stereo.prefer_given(costs, search.bands, search.given, np.float32(1 / 8), np.float32(60))
    assert (costs != before).any()
    assert torch.equal(volume, to_volume(costs, search))


@pytest.mark.parametrize("seed", [0, 1])
def test_paths_and_the_chosen_planes_are_exactly_those_of_the_kernel(seed):
    search = make_search()
    random = np.random.default_rng(seed)
    # Few values, so that there are ties.
    costs = random.choice(np.array([0, 20, 90, 254], np.uint8), search.bands.start[-1])
    volume = to_volume(costs, search)
    jumps = [upload(part[None]) for part in compute_jumps(search.reference)]
    (totals,) = aggregate_volumes(volume[None], JumpPenalties(*jumps), 25)
    bands = [spread_over_tiles(band, SIZE) for band in (search.bands.low, search.bands.high)]
    index, margin = select_volume_planes(totals, volume, *map(upload, bands)).numpy()
    of_kernel = aggregate(costs, search.bands, search.reference)
    truth = stereo.select_planes(of_kernel, search.bands, *SIZE)
    assert np.array_equal(index, truth[0])
    assert np.array_equal(margin, truth[1])
    assert (index % 1 != 0).mean() > 0.1


@pytest.mark.parametrize("odd", [np.nan, np.inf, -np.inf, 3e38, -1e19])
def test_no_number_of_a_transform_leads_out_of_an_image(odd):
    search = make_search()
    image, transform = search.sources[0]
    for place in np.ndindex(3, 4):
        strange = transform.copy()
        strange[place] = odd
        sources = [(image, strange)]
        costs = match(PlaneSearch(image, sources, search.planes, search.bands, search.given))
        assert (costs <= OUTSIDE).all()


def test_a_reconstruction_on_tensors_is_that_of_the_kernels(monkeypatch):
    views = [view_of(Room(), camera_at(x, size=72)) for x in (-0.2, 0.2)]
    # So that a half-size sweep guides this one.
    monkeypatch.setattr("gscompleter.reconstructors.plane_sweep.sweep.MIN_GUIDED_SIDE", 72)
    expected = PlaneSweep().estimate_depths(views)
    searches = []

    def make_device(name: str) -> TensorDepth:
        searches.append(name)
        return TensorDepth(name)

    monkeypatch.setitem(depth_devices.DEPTH_DEVICES, "cpu", make_device)
    monkeypatch.setattr(depth_devices, "MIN_DEVICE_PIXELS", 0)
    for ours, truth in zip(PlaneSweep().estimate_depths(views), expected, strict=True):
        difference = ((ours.depth - truth.depth).abs() / truth.depth)[truth.valid]
        assert len(difference) > 2000
        # All pixels agree here; where a compiler rounds otherwise, a tie may fall the other way.
        assert (difference > 1e-4).float().mean() < 0.01
        assert (ours.valid != truth.valid).float().mean() < 0.01
    assert len(searches) > 4


def test_launches_grow_with_rows_and_columns_and_the_host_waits_once():
    searches = [make_search(), make_search(planes=17)]
    with fake_cuda() as counts:
        (index, _), _ = search_with_tensors(searches, "cuda")
    assert index.shape == SIZE
    assert counts.waits.total() == 1, counts.list_waits(BETWEEN_STAGES)
    # Eight for each row and column of all, and a fixed number for each source and each view.
    sources = sum(len(search.sources) for search in searches)
    assert counts.launches.total() <= 8 * sum(SIZE) + 250 * sources + 150 * len(searches)


@pytest.mark.parametrize(
    ("size", "planes", "count", "part"),
    [
        ((32, 128), 40, 1, 40_000),
        ((32, 128), 40, 1, 200_000),
        ((32, 128), 40, 3, 40_000),
        ((48, 64), 48, 1, 20_000),
    ],
)
def test_the_estimate_of_a_search_holds_what_a_device_counts(
    monkeypatch, size, planes, count, part
):
    """Compare where parts are small: of large ones not all arrays are there at once."""
    monkeypatch.setattr(tensor_stereo, "PART_BYTES", part)
    monkeypatch.setattr(matching, "GROUP_CELLS", count * size[0] * size[1] * planes)
    with fake_cuda():
        search_with_tensors([make_search(size, planes)] * count, "cuda")
        peak = max(get_device().memory.peaks.values())
    estimate = estimate_group_bytes([size] * count, planes)
    assert (0.6 if part > 100_000 else 0.85) * estimate < peak < estimate


def test_a_large_image_with_all_planes_takes_less_than_two_gibibytes():
    large = (1080, 1920)
    one = estimate_group_bytes([large], MAX_PLANES)
    assert 1.5 * 2**30 < one < 2 * 2**30
    # Large images are searched one after the other, and small ones together.
    assert estimate_group_bytes([large] * 8, MAX_PLANES) == one
    small = [estimate_group_bytes([(256, 256)] * number, MAX_PLANES) for number in (1, 2, 8, 24)]
    assert small[0] < small[1] < small[2] == small[3] < one


def test_maps_are_fitted_one_after_the_other():
    """Each takes memory of its own, and a GPU is not faster with several."""
    with fake_cuda():
        fit = partial(fit_on_device, "cuda")
        threads = [threading.Thread(target=fit_level, args=(fit, 3)) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        peak = max(get_device().memory.peaks.values())
    estimate = FIT_BYTES * SIZE[0] * SIZE[1]
    assert 0.7 * estimate < peak < estimate


def fit_level(fit: FitHeights, iterations: int) -> tuple[np.ndarray, np.ndarray]:
    """Fit heights with noise to random measurements, of which half are missing."""
    random, shape = np.random.default_rng(0), SIZE
    data, weight, across, down = (random.random(shape, np.float32) * k for k in (60, 1, 3, 3))
    weight[random.random(shape) < 0.5] = 0
    heights, gradients = np.zeros(shape, np.float32), np.zeros((2, *shape), np.float32)
    step = np.float32(12), np.float32(0.15)
    fit(heights, gradients, data, weight, across, down, *step, iterations)
    return heights, gradients


@pytest.mark.parametrize("iterations", [3, 300])
def test_surfaces_are_those_of_the_kernel(iterations):
    found = fit_level(partial(fit_on_device, "cpu"), iterations)
    for ours, truth in zip(found, fit_level(tgv.fit, iterations), strict=True):
        assert np.abs(truth).max() > 0.01
        assert np.abs(ours - truth).max() < 1e-4 * np.abs(truth).max()


def test_an_iteration_of_surfaces_has_a_fixed_number_of_launches():
    found = {}
    for iterations in (1, 11):
        with fake_cuda() as counts:
            fit_level(partial(fit_on_device, "cuda"), iterations)
        assert counts.waits.total() == 1, counts.list_waits(BETWEEN_STAGES)
        found[iterations] = counts.launches.total()
    assert found[11] - found[1] == 10 * LAUNCHES_PER_ITERATION
    assert found[1] < 2 * LAUNCHES_PER_ITERATION


def test_only_large_levels_of_surfaces_go_to_a_gpu(monkeypatch):
    """The finest of five is large; what follows is from the same numbers."""
    heights = make_search().given.clip(0)
    image = make_image(4).image
    weight = np.ones_like(heights)
    expected = fit_surfaces(heights, weight, image, 20)
    monkeypatch.setattr(depth_devices, "MIN_DEVICE_PIXELS", heights.size)
    sizes = []

    def choose_fit(num_pixels: int) -> FitHeights:
        chosen = TensorDepth("cpu").choose_fit(num_pixels)
        sizes.append((num_pixels, chosen is tgv.fit))
        return chosen

    found = fit_surfaces(heights, weight, image, 20, choose_fit)
    assert [is_kernel for _, is_kernel in sizes] == [True] * 4 + [False]
    assert sizes[-1][0] == heights.size
    assert np.abs(found - expected).max() < 1e-4 * expected.max()
    assert np.abs(expected - heights).max() > 1


def test_the_device_of_networks_is_that_of_the_sweep():
    assert load_reconstructor("plane-sweep", device="cuda:1").device == "cuda:1"
    assert PlaneSweep().device == "cpu"
    with pytest.raises(InputError, match="no device 'tpu'"):
        load_reconstructor("plane-sweep", device="tpu")
