"""Whether a completion fits into the memory of this machine, before it is begun."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path

from gscompleter.errors import InputError, quoted

PROGRAM_BYTES = 550 * 10**6
"""What the program holds whatever the size of the images."""
BYTES_PER_PIXEL = 2_500
"""What a completion holds for each pixel of the target, as it was asked for: costs of planes of the
target widened by a quarter on every side, and of the anchor. Measured on two photographs: 0.67 GB
at 256 x 256, 1.51 GB at 512 x 768; a wider range of depth, and so more planes, is left room for."""
BYTES_PER_PIXEL_OF_A_VIEW = 250
"""What it holds for each pixel of each image besides: the image, its Gaussians, its renders.
Measured on eight photographs instead of two, at 256 x 256 and 480 x 480."""

MAX_KEPT = 2 * 2**30
"""Bytes of splats that frozen views of a scene that was brought may hold together; it is drawn with
as few Gaussians as that takes."""
COPIES = 4
"""How often a scene is held: in the order that it is drawn in and in that of its file, each with
and without what was added."""
FREEZING_BYTES = 60
"""What each Gaussian takes while a view is frozen."""
BYTES_PER_SPLAT = 52
"""What each Gaussian takes in a frozen view."""
BYTES_PER_PIXEL_OF_A_WITNESS = 400
"""What is fitted to a photograph of such a scene, for each of its pixels."""

_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
"""Where Linux tells what a container may hold, in its newer and its older way."""


def check_memory(pixels: int, images: int) -> None:
    """Refuse a completion that needs more memory than there is.

    Args:
        pixels: Of the largest image, at the resolution that is worked at.
        images: Context views and targets together.

    Raises:
        InputError: with both numbers.
    """
    number = f"{quoted(f'{images:,}')} images of up to {quoted(f'{pixels:,}')} pixels"
    remedy = "choose a smaller resolution, or fewer views"
    _refuse_beyond_memory(needed_bytes(pixels, images), number, remedy, "resolution")


def needed_bytes(pixels: int, images: int) -> int:
    """About how much memory a completion holds at most. Arguments as in `check_memory`."""
    return PROGRAM_BYTES + pixels * (BYTES_PER_PIXEL + images * BYTES_PER_PIXEL_OF_A_VIEW)


def check_scene_memory(count: int, photographs: int, needed: int) -> None:
    """Refuse the completion of a scene that was brought where it needs more memory than there is.

    Args:
        count: Its Gaussians.
        photographs: How many there are of it.
        needed: What the completion holds at most, in bytes.

    Raises:
        InputError: with both numbers.
    """
    number = f"The {quoted(f'{count:,}')} Gaussians of the scene and {photographs} photographs"
    remedy = "bring a part of the scene, or a folder with fewer photographs"
    _refuse_beyond_memory(needed, number, remedy)


def _refuse_beyond_memory(
    needed: int, number: str, remedy: str, argument: str | None = None
) -> None:
    there = memory_bytes()
    if there is not None and needed > there:
        raise InputError(
            f"{number} need about {gigabytes(needed)} of memory, and there are "
            f"{gigabytes(there)}; {remedy}.",
            argument,
        )


def scene_bytes(count: int, numbers: int, photographs: Sequence[int]) -> int:
    """About how much memory a scene that was brought takes besides, at most.

    Measured with 30 photographs: 1.9 GB in all for a million Gaussians, 3.0 for 4 and 4.7 for 10
    million; with 40, of 2 million with harmonics of degree 3: 5.8.

    Args:
        count: Its Gaussians.
        numbers: What each of them is made of, in float32.
        photographs: Pixels of each of all of them, as small as they are looked at.
    """
    number = len(photographs)
    drawn = min(count, most_that_fit(number))
    views = number * drawn * BYTES_PER_SPLAT
    told = 2 * 4 * number * drawn  # how much of each the photographs show, and how they agree
    fitted = BYTES_PER_PIXEL_OF_A_WITNESS * sum(photographs)
    return count * (COPIES * 4 * numbers + FREEZING_BYTES) + views + told + fitted


def most_that_fit(number: int) -> int:
    """Gaussians of which that many views hold `MAX_KEPT` at most."""
    return MAX_KEPT // (number * BYTES_PER_SPLAT)


def images_that_fit(pixels: int) -> int | None:
    """How many images of so many pixels, context views and targets together, there is memory for;
    None where nobody tells. What other programs hold is not asked: the same command has to choose
    the same photographs."""
    there = memory_bytes()
    if there is None:
        return None
    left = there - needed_bytes(pixels, 0)
    return max(0, left // (pixels * BYTES_PER_PIXEL_OF_A_VIEW))


def memory_bytes() -> int | None:
    """The memory of this machine, or as much of it as we may hold; None where nobody tells."""
    found = [limit for limit in map(_limit, _LIMITS) if limit is not None]
    with contextlib.suppress(AttributeError, OSError, ValueError):
        found.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    return min(found, default=None)


def _limit(path: str) -> int | None:
    try:
        word = Path(path).read_text().strip()
    except OSError:
        return None
    return int(word) if word.isdecimal() else None  # the newer way says "max"


def gigabytes(number: int) -> str:
    """A number of bytes in whole GB, rounded up, for a user."""
    return quoted(f"{-(-number // 10**9):,} GB")
