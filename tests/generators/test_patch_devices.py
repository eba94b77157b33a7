"""Patches on tensors, as a GPU computes them, against the compiled loops of the CPU."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from fake_cuda import BETWEEN_STAGES, fake_cuda, get_device
from gscompleter import InputError, load_generator
from gscompleter.apps.inputs.memory import check_gpu, estimate_filling_bytes
from gscompleter.apps.inputs.task import CompletionTask
from gscompleter.apps.requests.models import ModelRequest
from gscompleter.generators import patch_devices
from gscompleter.generators.patch_devices import (
    CpuPatches,
    TensorPatches,
    estimate_patch_bytes,
    get_patch_device,
)
from gscompleter.generators.patch_rounds import (
    PatchRounds,
    RunRounds,
    compute_likelihood,
    compute_likelihood_there,
    run_with_kernels,
    run_with_tensors,
)
from gscompleter.generators.warp_inpaint import Sources, WarpInpaint, fill_by_patches
from gscompleter.numerics import tensor_patchmatch
from gscompleter.numerics.kernels import patchmatch
from gscompleter.numerics.kernels.patchmatch import PATCHMATCH_RADIUS, PATCHMATCH_SIDE
from gscompleter.numerics.tensor_patchmatch import (
    HASH_STEP,
    LAUNCHES_PER_ROUND,
    begin_random,
    draw_matches,
    hash_states,
    improve_matches,
    upload_problem,
    vote_pixels,
)
from gscompleter.types import GeneratorInput, Render, View
from known_room import TARGET, known_room
from scenes import Room, camera_at, gaussians_of, view_of

COSTS = patchmatch.Costs(*map(np.float32, (0.1, 0.3, 0.02, 0.002, 60.0)))
SIZE = 37, 52
"""Rows and columns of the image."""
SOURCE_SIZE = 41, 45
"""Rows and columns of the sources, lower and narrower than places that the image proposes."""
LARGE_SEED = 2**62 + 12345


def make_rounds(
    seed: int = 0,
    size: tuple[int, int] = SIZE,
    source_size: tuple[int, int] = SOURCE_SIZE,
    sources: int = 3,
    spacing: int = 1,
) -> PatchRounds:
    """Make rounds of noise, with patches everywhere and a fifth of the centres unusable."""
    random = np.random.default_rng(seed)
    rows, columns = np.indices(size)
    centres = (rows + columns) % spacing == 0
    if spacing == 1:
        centres &= random.random(size) < 0.8
    queries = np.argwhere(centres)
    query_at = np.full(size, -1)
    query_at[centres] = np.arange(len(queries))
    usable = random.random((sources, *source_size)) < 0.8
    inner = slice(PATCHMATCH_RADIUS, -PATCHMATCH_RADIUS)
    is_inside = np.zeros_like(usable)
    is_inside[:, inner, inner] = True
    usable &= is_inside
    weight = random.random(size, np.float32)
    padded = np.pad(weight, PATCHMATCH_RADIUS)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (PATCHMATCH_SIDE,) * 2)
    problem = patchmatch.PatchProblem(
        image=patchmatch.pad_border(random.random((*size, 3), np.float32)),
        weight=patchmatch.pad_border(np.repeat(weight[..., None], 3, axis=-1)),
        total=windows.sum(axis=(2, 3))[centres],
        queries=queries,
        query_at=query_at,
        expected_log_depth=random.random(len(queries), np.float32),
        sources=patchmatch.pad_column(random.random((sources, *source_size, 3), np.float32)),
        usable_mask=usable,
        log_depth=random.random((sources, *source_size), np.float32),
    )
    places = np.argwhere(usable)
    return PatchRounds(
        problem=problem,
        costs=COSTS,
        known=random.random(size) < 0.3,
        center_weight=weight[centres],
        matches=places[random.integers(len(places), size=len(queries))],
        is_refined=True,
        reach=8,
        num_rounds=2,
        seed=seed,
    )


def upload(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array))


def assert_near(found: Tensor, truth: np.ndarray, share: float = 1e-6) -> None:
    """Check that no element differs by more than a share of the largest one."""
    assert found.shape == truth.shape
    assert np.abs(found.numpy() - truth).max() <= share * np.abs(truth).max()


# ------------------------------------------------------------------- random numbers


def test_the_hash_is_that_of_the_kernel():
    random = np.random.default_rng(0)
    values = random.integers(0, 2**64, 10_000, np.uint64, endpoint=False)
    values[:4] = [0, 1, 2**63, 2**64 - 1]
    expected = patchmatch._hash.py_func(values)
    found = hash_states(torch.from_numpy(values.view(np.int64)))
    assert np.array_equal(found.numpy().view(np.uint64), expected)
    assert (expected > 2**63).mean() == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("seed", [0, 1, 7919 * 3, LARGE_SEED])
def test_states_begin_and_places_are_drawn_as_in_the_kernel(seed):
    rounds = make_rounds(sources=5)
    queries = rounds.problem.queries
    state = begin_random(upload(queries.T), seed)
    around, reach = upload(rounds.matches.T), 13
    problem = upload_problem(rounds.problem, "cpu")
    drawn = draw_matches(problem, state, around, reach, draws_source=True)
    kept = draw_matches(problem, state, around, reach, draws_source=False)
    assert torch.equal(kept[0], around[0])
    assert torch.equal(kept[1:], drawn[1:])
    for number, (y, x) in enumerate(queries.tolist()):
        # Of numbers without an end, which Python has.
        expected = int(patchmatch._hash(np.uint64((seed * HASH_STEP + y * 65537 + x) % 2**64)))
        assert int(state[number]) % 2**64 == expected
        _, sy, sx = rounds.matches[number]
        place = [
            (expected >> 48) % 5,
            sy + (expected & 0xFFFFFF) % (2 * reach + 1) - reach,
            sx + ((expected >> 24) & 0xFFFFFF) % (2 * reach + 1) - reach,
        ]
        assert drawn[:, number].tolist() == place


# ------------------------------------------------------------------- search and vote


@pytest.mark.parametrize(
    ("seed", "reach", "sources"), [(0, 8, 3), (1, 45, 3), (2, 1, 2), (3, 0, 1), (LARGE_SEED, 20, 6)]
)
def test_matches_costs_and_shifts_are_those_of_the_kernel(seed, reach, sources):
    rounds = make_rounds(seed % 97, sources=sources)
    problem = upload_problem(rounds.problem, "cpu")
    image = upload(rounds.problem.image)
    field = rounds.matches.copy()
    for number in range(3):
        before = upload(field.T)
        cost, shift = patchmatch.search(rounds.problem, COSTS, field, reach, seed + number)
        matches, found, bias = improve_matches(problem, COSTS, image, before, reach, seed + number)
        # All, where the processor multiplies and adds at once; elsewhere two costs may be as near.
        is_same = (matches.numpy() == field.T).all(axis=0)
        assert is_same.mean() > 0.99
        assert_near(found[is_same], cost[is_same])
        assert_near(bias[is_same], shift[is_same])
        assert (matches != before).any(dim=0).float().mean() > (0.01 if reach else 0.001)
    assert np.abs(shift).max() == COSTS.max_bias


def test_of_equal_patches_the_same_one_is_taken():
    """Sources are equal, and none is nearer: what is proposed first stays."""
    rounds = make_rounds()
    one = rounds.problem.sources[:1]
    flat = (np.round(one * 2) / 2).repeat(3, axis=0)
    problem = rounds.problem._replace(
        sources=flat,
        image=np.round(rounds.problem.image * 2) / 2,
        weight=np.ones_like(rounds.problem.weight),
        log_depth=np.zeros_like(rounds.problem.log_depth),
        expected_log_depth=np.full_like(rounds.problem.expected_log_depth, 0.5),
        usable_mask=rounds.problem.usable_mask[:1].repeat(3, axis=0),
    )
    costs = COSTS._replace(distance_penalty=np.float32(0))
    places = np.argwhere(problem.usable_mask)
    field = places[np.random.default_rng(0).integers(len(places), size=len(rounds.matches))]
    before = upload(field.T)
    patchmatch.search(problem, costs, field, 30, 5)
    image = upload(problem.image)
    matches, *_ = improve_matches(upload_problem(problem, "cpu"), costs, image, before, 30, 5)
    assert (matches.numpy() == field.T).all(axis=0).mean() > 0.99
    assert (field[:, 0] > 0).mean() > 0.5


def test_pixels_are_voted_for_as_by_the_kernel():
    rounds = make_rounds()
    problem = rounds.problem
    # A corner that no patch lies over.
    query_at = problem.query_at.copy()
    query_at[-9:, :12] = -1
    problem = problem._replace(query_at=query_at)
    random = np.random.default_rng(1)
    votes = random.random(len(rounds.matches), np.float32)
    shift = random.uniform(-0.1, 0.1, (len(votes), 3)).astype(np.float32)
    colors, totals = patchmatch.vote(query_at, votes, problem.sources, rounds.matches, shift)
    pixels = np.argwhere(random.random(SIZE) < 0.7)
    found, weight = vote_pixels(
        upload_problem(problem, "cpu"),
        upload(pixels.T),
        upload(votes),
        upload(rounds.matches.T),
        upload(shift),
    )
    rows, columns = pixels.T
    assert_near(found, colors[rows, columns])
    assert_near(weight, totals[rows, columns])
    is_bare = weight == 0
    assert 0 < is_bare.sum() < 100
    assert not found[is_bare].any()


@pytest.mark.parametrize("part", [1, 60_000, 900_000])
def test_parts_of_any_size_give_the_same(monkeypatch, part):
    """One patch or pixel at a time, some, and all but a few."""
    rounds = make_rounds(size=(15, 20)) if part == 1 else make_rounds()
    whole = run_with_tensors(rounds, "cpu")
    monkeypatch.setattr(tensor_patchmatch, "PATCHES_BYTES", part)
    for ours, truth in zip(run_with_tensors(rounds, "cpu"), whole, strict=True):
        assert np.array_equal(ours, truth)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 1001])
def test_likelihoods_are_those_of_the_cpu(count):
    cost = np.random.default_rng(count).random(count, np.float32)
    cost[::7] = 0
    assert_near(compute_likelihood_there(upload(cost)), compute_likelihood(cost))
    none = np.zeros(count, np.float32)
    assert_near(compute_likelihood_there(upload(none)), compute_likelihood(none))


@pytest.mark.parametrize("is_refined", [True, False])
def test_rounds_fill_what_those_of_the_kernels_fill(is_refined):
    rounds = replace(make_rounds(4), is_refined=is_refined, reach=8 if is_refined else 52)
    before = rounds.problem.image.copy(), rounds.matches.copy()
    image, matches = run_with_tensors(rounds, "cpu")
    expected, field = run_with_kernels(rounds)
    is_same = (matches == field).all(axis=1)
    assert is_same.mean() > 0.99
    # A vote differs by its rounding, unless it is for another match.
    difference = np.abs(image - expected).max(axis=-1)
    assert (difference > 1e-5).mean() < 0.02
    inner = patchmatch.pad_border(np.ones((*SIZE, 3))) > 0
    first = before[0][inner].reshape(*SIZE, 3)
    assert np.array_equal(image[rounds.known], first[rounds.known])
    assert np.abs(image - first)[~rounds.known].max() > 0.1
    # Neither writes into what it is given.
    assert np.array_equal(rounds.problem.image, before[0])
    assert np.array_equal(rounds.matches, before[1])


# ------------------------------------------------------------------- all levels


def make_hollow(size: tuple[int, int] = (166, 190)) -> tuple[Tensor, Tensor, Tensor, Sources]:
    """Make an image of smooth noise with two holes, its log-depth, and sources of other sizes."""
    generator = torch.Generator().manual_seed(0)

    def make_image(h: int, w: int) -> Tensor:
        noise = torch.rand(1, 3, h, w, generator=generator)
        smooth = torch.nn.functional.avg_pool2d(noise, 5, stride=1, padding=2)[0]
        return (3 * (smooth - 0.5) + 0.5).clamp(0, 1).permute(1, 2, 0).contiguous()

    def make_depth(h: int, w: int) -> Tensor:
        return 1 + torch.rand(h, w, generator=generator)

    h, w = size
    sizes = [(h + 9, w - 7), (h - 11, w + 5)]
    known = torch.ones(size, dtype=torch.bool)
    known[h // 3 : h // 2, w // 4 : w // 2] = False
    known[: h // 5, -w // 5 :] = False
    image, depth = make_image(h, w), make_depth(h, w)
    sources = Sources.stack_images(
        [*(make_image(*other) for other in sizes), image],
        [*(torch.rand(other, generator=generator) > 0.002 for other in sizes), known],
        [*(make_depth(*other) for other in sizes), depth],
    )
    tone = torch.where(known[..., None], image, image.mean(dim=(0, 1)))
    return tone, known, depth.log(), sources


def test_a_hole_is_filled_with_tensors_as_with_the_kernels(monkeypatch):
    """Over two levels, the finer one of which begins with what the coarser one found."""
    hollow = make_hollow()
    expected = fill_by_patches(*hollow, seed=3)
    numbers = []

    def make_device(name: str) -> TensorPatches:
        numbers.append(name)
        return TensorPatches(name)

    monkeypatch.setitem(patch_devices.PATCH_DEVICES, "cpu", make_device)
    monkeypatch.setattr(patch_devices, "MIN_DEVICE_PATCHES", 0)
    found = fill_by_patches(*hollow, seed=3)
    assert numbers == ["cpu"]
    tone, known, *_ = hollow
    assert torch.equal(found[known], tone[known])
    difference = (found - expected).abs().amax(dim=-1)[~known]
    # All pixels agree here; where a compiler rounds otherwise, a tie may fall the other way.
    assert (difference > 1e-5).float().mean() < 0.02
    assert (expected - tone)[~known].abs().mean() > 0.05


def test_only_large_levels_go_to_a_gpu(monkeypatch):
    """The finest of two has 1,600 patches to match, and the coarser one 1,100."""
    hollow = make_hollow()
    expected = fill_by_patches(*hollow, seed=3)
    monkeypatch.setattr(patch_devices, "MIN_DEVICE_PATCHES", 1300)
    chosen = []

    class Watched:
        def choose_rounds(self, num_patches: int) -> RunRounds:
            run = TensorPatches("cpu").choose_rounds(num_patches)
            chosen.append((num_patches >= 1300, run is not run_with_kernels))
            return run

    monkeypatch.setitem(patch_devices.PATCH_DEVICES, "cpu", lambda _: Watched())
    found = fill_by_patches(*hollow, seed=3)
    assert chosen == [(False, False), (True, True)]
    assert ((found - expected).abs() > 1e-5).float().mean() < 0.01


def move_render(render: Render) -> Render:
    """Move a render to the GPU."""
    return Render(*(getattr(render, part).to("cuda") for part in ("image", "depth", "alpha")))


def test_an_image_is_filled_on_the_device_that_is_chosen(monkeypatch):
    monkeypatch.setattr(patch_devices, "MIN_DEVICE_PATCHES", 0)
    context = known_room()
    expected = WarpInpaint(seed=1)(context.views[1], TARGET, context)
    with fake_cuda() as counts:
        there = GeneratorInput(
            tuple(view.to("cuda") for view in context.views),
            tuple(move_render(render) for render in context.view_renders),
            move_render(context.target_render),
        )
        image = WarpInpaint(seed=1, device="cuda")(there.views[1], TARGET.to("cuda"), there)
        # Of the one level, for its image and for its matches.
        waits = [count for (_, _, line), count in counts.waits.items() if "patch" in line]
        assert sum(waits) == 2, counts.list_waits(BETWEEN_STAGES)
        found = image.cpu()
    difference = (found - expected).abs().amax(dim=-1)
    assert (difference > 1e-4).float().mean() < 0.01


# ------------------------------------------------------------------- what a GPU is asked to do


def test_a_round_has_a_fixed_number_of_launches_and_the_host_waits_for_the_result_alone():
    launches = {}
    for size in ((20, 24), SIZE):
        for number in (1, 4):
            rounds = replace(make_rounds(size=size), num_rounds=number)
            with fake_cuda() as counts:
                run_with_tensors(rounds, "cuda")
            # For the image and for the matches.
            assert counts.waits.total() == 2, counts.list_waits(BETWEEN_STAGES)
            launches[size, number] = counts.launches.total()
    for size in ((20, 24), SIZE):
        assert launches[size, 4] - launches[size, 1] == 3 * LAUNCHES_PER_ROUND
        assert launches[size, 1] < 1.2 * LAUNCHES_PER_ROUND


@pytest.mark.parametrize(("part", "sources"), [(2**18, 9), (2**20, 1)])
def test_the_estimate_holds_what_a_device_counts(monkeypatch, part, sources):
    """Where all of the image is a hole."""
    size = 64, 80
    monkeypatch.setattr(tensor_patchmatch, "PATCHES_BYTES", part)
    monkeypatch.setattr(patch_devices, "PATCHES_BYTES", part)
    monkeypatch.setattr(patch_devices, "MIN_DEVICE_PATCHES", 0)
    rounds = make_rounds(size=size, source_size=size, sources=sources, spacing=2)
    rounds = replace(rounds, known=np.zeros(size, bool), reach=1, num_rounds=1)
    with fake_cuda():
        run_with_tensors(rounds, "cuda")
        peak = max(get_device().memory.peaks.values())
    estimate = estimate_patch_bytes([size] * (sources - 1), size)
    assert 0.75 * estimate < peak < estimate


def test_a_large_image_takes_about_as_much_as_plane_sweep():
    photographs, target = [(1080, 1920)] * 8, (1620, 2880)
    assert 2**30 < estimate_patch_bytes(photographs, target) < 1.6 * 2**30
    assert estimate_patch_bytes(photographs, (256, 255)) == 0
    cameras = [camera_at(0, size=400), camera_at(0.1, size=400)]
    padded = estimate_filling_bytes(cameras, [camera_at(0, size=300), cameras[0]], 0.25)
    assert padded == estimate_patch_bytes([(400, 400)] * 2, (600, 600)) > 0
    assert estimate_filling_bytes(cameras, cameras[:1], 0) < padded


def test_a_gpu_on_which_a_target_cannot_be_filled_is_refused(monkeypatch):
    """Of these 0.3 GB next to nothing is for the scene."""
    view = View(torch.zeros(300, 300, 3), camera_at(0, size=300))
    task = CompletionTask(
        [view], (), np.eye(4), np.zeros(3), {}, scene=gaussians_of(view_of(Room(), TARGET))
    )
    models = ModelRequest(reconstructor="mvsplat-re10k", device="cuda", network_device="cuda")
    for free, is_enough in ((2 * 10**8, False), (4 * 10**8, True)):
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda free=free: (free, free))
        check_gpu(task, replace(models, generator="oracle"), 0.0)
        check_gpu(task, replace(models, network_device="cpu"), 0.0)
        with nullcontext() if is_enough else pytest.raises(InputError, match="on the GPU"):
            check_gpu(task, models, 0.0)


# ------------------------------------------------------------------- choice


def test_the_device_of_networks_is_that_of_the_patches():
    assert load_generator("warp-inpaint", device="cuda:1").function.device == "cuda:1"
    assert load_generator("warp-inpaint", seed=5).function == WarpInpaint(5, "cpu")
    assert get_patch_device("cuda:1") == TensorPatches("cuda:1")
    assert get_patch_device("mps") == get_patch_device("cpu") == CpuPatches()
    assert CpuPatches().choose_rounds(10**9) is run_with_kernels
    with pytest.raises(InputError, match="no device 'tpu' for warp-inpaint"):
        load_generator("warp-inpaint", device="tpu")
