"""Completions that do not fit into memory are refused in a sentence, before any work."""

import pytest

from gscompleter import InputError
from gscompleter.reconstructors.plane_sweep.device_memory import estimate_sweep_bytes
from gscompleter.system.memory import (
    check_bytes,
    check_gpu_bytes,
    check_memory,
    estimate_bytes,
    estimate_gpu_bytes,
    estimate_scene_bytes,
    read_memory_bytes,
)


@pytest.fixture
def sixteen_gigabytes(monkeypatch) -> None:
    monkeypatch.setattr("gscompleter.system.memory.read_memory_bytes", lambda: 16 * 10**9)


@pytest.mark.parametrize(
    "pixels", [10**12, 8000 * 8000, 16 * 10**6, 10**18, 10**400], ids=lambda n: f"{len(str(n))}"
)
def test_what_does_not_fit_is_refused_with_both_numbers(pixels, sixteen_gigabytes):
    with pytest.raises(InputError, match=r"need about .* GB .* there are 16 GB") as error:
        check_memory(pixels, 3)
    assert len(str(error.value)) < 400


@pytest.mark.parametrize(("pixels", "images"), [(256 * 256, 3), (512 * 768, 9), (10**6, 12)])
def test_what_fits_is_not_refused(pixels, images, sixteen_gigabytes):
    check_memory(pixels, images)


def test_the_estimate_holds_what_was_measured_and_not_twice_as_much():
    """Peak resident memory of `complete` on two photographs and one target."""
    for pixels, measured in ((256 * 256, 669 * 10**6), (512 * 768, 1514 * 10**6)):
        assert 0.95 * measured < estimate_bytes(pixels, 3) < 2 * measured


def test_the_estimate_holds_what_forty_photographs_took():
    assert 0.95 * 4.74e9 < estimate_bytes(360 * 640, 41) < 2 * 4.74e9


WITNESSES = [256 * 384] * 2 + [213 * 320] * 28


@pytest.mark.parametrize(("count", "measured"), [(1, 1.94), (4, 3.00), (10, 4.70)])
def test_the_estimate_of_a_scene_holds_what_was_measured(count, measured):
    """Peak resident memory in GB of `complete` with so many million Gaussians and `WITNESSES`."""
    needed = estimate_bytes(256 * 384, 3) + estimate_scene_bytes(count * 10**6, 18, WITNESSES)
    assert 0.95 * measured * 10**9 < needed < 2 * measured * 10**9


def test_the_estimate_of_a_scene_with_harmonics_holds_what_was_measured():
    """The same of `remove` with four million of degree 3, and 40 photographs."""
    needed = estimate_bytes(144 * 256, 4) + estimate_scene_bytes(4 * 10**6, 62, [144 * 256] * 40)
    assert 0.95 * 3.92e9 < needed < 2 * 3.92e9


def test_the_estimate_leaves_out_what_lies_in_a_file():
    """Peak resident memory in GB of `complete`, eight photographs; 48 of 64 numbers are filed."""
    sizes = [144 * 256] * 8
    held, filed = (estimate_scene_bytes(4 * 10**6, 64, sizes, num_filed=n) for n in (0, 48))
    assert held - filed == 4 * 48 * 4 * 10**6
    needed = estimate_bytes(144 * 256, 9) + filed
    assert 2.24e9 < needed < 1.6 * 2.24e9
    # While it is read, a splat is held as a whole.
    assert estimate_scene_bytes(10**7, 64, [1], num_filed=48) == 64 * 4 * 10**7


def test_memory_grows_less_than_with_each_photograph_of_a_large_scene():
    one, many = (estimate_scene_bytes(10**7, 18, WITNESSES[:n]) for n in (8, 30))
    assert many - one < 22 * 10**7 * 16 + 22 * 10**8


def test_bytes_that_do_not_fit_are_refused_with_both_numbers(sixteen_gigabytes):
    check_bytes(16 * 10**9, "The Gaussians", "crop the scene")
    with pytest.raises(
        InputError,
        match="^The Gaussians need about 17 GB of memory, and there are 16 GB; crop the scene",
    ):
        check_bytes(16 * 10**9 + 1, "The Gaussians", "crop the scene")


def test_ten_million_gaussians_fit_where_a_hundred_do_not():
    few, many = (estimate_scene_bytes(10**power, 18, WITNESSES) for power in (7, 8))
    assert estimate_bytes(256 * 384, 3) + few < 16 * 10**9 < many


def test_a_container_may_hold_less_than_the_machine(tmp_path, monkeypatch):
    (tmp_path / "memory.max").write_text("123456789\n")
    monkeypatch.setattr("gscompleter.system.memory._LIMIT_FILES", (str(tmp_path / "memory.max"),))
    assert read_memory_bytes() == 123456789
    (tmp_path / "memory.max").write_text("max\n")
    whole = read_memory_bytes()
    assert whole is not None
    assert whole > 10**9


# Gaussians at the end, harmonics, photographs of 32 x 32 pixels that show all of them: bytes.
ON_A_GPU = [
    (5497, 1, 2, 2_782_423),
    (5527, 1, 6, 5_464_078),
    # With blocks of 128 and 256 Gaussians in place of 4,096 and 2**18, whose normal equations and
    # harmonics take as much for a scene of any size.
    (5497, 16, 2, 4_239_553),
]


@pytest.mark.parametrize(("count", "harmonics", "photographs", "counted"), ON_A_GPU)
def test_the_estimate_for_a_gpu_is_close_to_what_a_device_counted(
    count, harmonics, photographs, counted
):
    pixels = photographs * 32 * 32
    estimate = estimate_gpu_bytes(count, harmonics, [count] * photographs, pixels)
    assert 0.95 * counted < estimate < 1.15 * counted


def test_the_estimate_for_a_gpu_holds_plane_sweep_where_it_is_most():
    """Photographs are matched before anything is added, beside what is frozen then."""
    size, number = (1080, 1920), 8
    matching = estimate_sweep_bytes([size] * number)
    pixels = number * size[0] * size[1]
    small, large = (
        [
            estimate_gpu_bytes(count, 16, [count // 2] * number, pixels, taken)
            for taken in (0, matching)
        ]
        for count in (10**5, 10**7)
    )
    assert 2**30 < matching < small[1] < matching + small[0]
    assert large[0] == large[1]
    # The discs of all photographs take more than the search of one after the other.
    assert estimate_sweep_bytes([size]) == estimate_sweep_bytes([size] * 2) < matching


def test_what_a_gpu_cannot_hold_is_refused_with_both_numbers():
    needed = estimate_gpu_bytes(10**7, 16, [5 * 10**6] * 8, 8 * 1920 * 1080)
    check_gpu_bytes(needed, 24 * 10**9, "They")
    with pytest.raises(InputError, match=r"They need about .* GB on the GPU, and 11 GB are free"):
        check_gpu_bytes(needed, 11 * 10**9, "They")
