"""Estimates of the memory of a completion, compared with that of this machine."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path

from gscompleter.system.errors import InputError, quote_value

PROGRAM_BYTES = 550 * 10**6
"""Bytes of the program itself, for images of any size."""
# Measured on two photographs: 0.67 GB at 256 x 256, 1.51 GB at 512 x 768. A wider depth range, with
# more planes, still fits.
BYTES_PER_PIXEL = 2_500
"""Bytes per target pixel, for the costs of the anchor and of the target padded by a quarter."""
# Measured on forty photographs at 360 x 640 that are all context: 4.74 GB, where this gives 4.9 GB.
BYTES_PER_VIEW_PIXEL = 400
"""Further bytes per pixel of each image: the image, its Gaussians and its renders."""

MAX_FROZEN_BYTES = 2 * 2**30
"""Bytes of splats that the frozen views of an input splat may hold together."""
FREEZING_BYTES = 60
"""Bytes per Gaussian while a view is frozen."""
BYTES_PER_SPLAT = 52
"""Bytes per Gaussian in a frozen view."""
BYTES_PER_PHOTO_PIXEL = 400
"""Bytes per pixel of each photograph of an input splat, for the fit to it."""

# Counted on a device that is none, and not on a GPU: what compiled kernels allocate for themselves
# is missing.
GPU_BYTES_PER_GAUSSIAN = 260
"""Bytes on a GPU per Gaussian of degree 0, apart from what each view holds of it."""
GPU_BYTES_PER_SPLAT = 112
"""Bytes per Gaussian in a view that is frozen there, while opacities are fitted to it all over."""
GPU_COPIES = 2
"""Copies of the harmonics beyond degree 0 at once, each with the scene."""
GPU_BYTES_PER_PIXEL = 70
"""Bytes per pixel of each image there."""
GPU_BYTES_OF_SCENE = 73
"""Bytes of a Gaussian of degree 0 there, as a file had it."""
GPU_BYTES_OF_VIEW = 20
"""Bytes of a Gaussian in a frozen view there, from which nothing is drawn at the moment."""
GPU_BYTES_OF_RENDER = 40
"""Bytes per pixel of a photograph there, and of a render of it."""

# Of containers, for cgroup versions 2 and 1.
_LIMIT_FILES = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


def check_memory(pixels: int, images: int) -> None:
    """Raise InputError if `images` of up to `pixels` pixels need more memory than there is."""
    number = f"{images:,} images of up to {quote_value(f'{pixels:,}')} pixels"
    remedy = "choose a smaller resolution, or fewer views"
    check_bytes(estimate_bytes(pixels, images), number, remedy, "resolution")


def estimate_bytes(pixels: int, images: int) -> int:
    """Estimate the peak memory of a completion. Arguments as in `check_memory`."""
    return PROGRAM_BYTES + pixels * (BYTES_PER_PIXEL + images * BYTES_PER_VIEW_PIXEL)


def check_image_memory(pixels: int, images: int) -> None:
    """Raise InputError if images of `pixels` pixels in all need more memory than there is.

    This is a lower bound for models of any kind: the images, their Gaussians and their renders.
    """
    check_bytes(
        PROGRAM_BYTES + pixels * BYTES_PER_VIEW_PIXEL,
        f"{images:,} photographs and targets of {quote_value(f'{pixels:,}')} pixels together",
        "choose a smaller resolution, or fewer views",
    )


def check_bytes(needed: int, number: str, remedy: str, argument: str | None = None) -> None:
    """Raise InputError if `needed` bytes, for what `number` says, exceed the memory."""
    available = read_memory_bytes()
    if available is not None and needed > available:
        raise InputError(
            f"{number} need about {format_whole_gigabytes(needed)} of memory, and there are "
            f"{format_whole_gigabytes(available)}; {remedy}.",
            argument,
        )


def estimate_scene_bytes(
    count: int, numbers: int, photographs: Sequence[int], num_filed: int = 0
) -> int:
    """Estimate the additional peak memory for `count` Gaussians of an input splat.

    Each has `numbers` float32 values, of which `num_filed` lie in a file once the splat was read;
    `photographs` are the pixels of each, at working resolution.
    """
    # A scene is held once. Measured on 4 M and 10 M Gaussians of degree 3 with 40 photographs: 3.8
    # and 5.7 GB for `complete`, where this gives 4.8 and 6.7 GB with the program.
    number = len(photographs)
    rendered = min(count, count_fitting_gaussians(number))
    views = number * rendered * BYTES_PER_SPLAT
    observed = 2 * 4 * number * rendered  # areas and agreement of every Gaussian
    fitted = BYTES_PER_PHOTO_PIXEL * sum(photographs)
    stages = count * (4 * (numbers - num_filed) + FREEZING_BYTES) + views + observed + fitted
    return max(4 * count * numbers, stages)


def estimate_gpu_bytes(
    count: int, harmonics: int, shown: Sequence[int], pixels: int, embedded: int = 0
) -> int:
    """Estimate the peak memory of a GPU for `count` Gaussians with so many harmonics of a channel.

    `shown` is the number that each photograph shows, and `pixels` are those of all together.
    `embedded` bytes are those of the embedded Ψ or Φ, taken before stages that add and recolour,
    beside the frozen scene. What will be added is not known before.
    """
    further = 4 * 3 * (harmonics - 1)
    scene = count * (GPU_BYTES_PER_GAUSSIAN + GPU_COPIES * further)
    stages = scene + GPU_BYTES_PER_SPLAT * sum(shown) + GPU_BYTES_PER_PIXEL * pixels
    frozen = count * (GPU_BYTES_OF_SCENE + further)
    frozen += GPU_BYTES_OF_VIEW * sum(shown) + GPU_BYTES_OF_RENDER * pixels
    return max(stages, frozen + embedded)


def check_gpu_bytes(needed: int, available: int, number: str) -> None:
    """Raise InputError if `needed` bytes, for what `number` says, exceed those free on the GPU."""
    if needed > available:
        raise InputError(
            f"{number} need about {format_whole_gigabytes(needed)} on the GPU, and "
            f"{format_whole_gigabytes(available)} are free there; draw on the CPU, choose a "
            "smaller resolution, or give fewer photographs.",
            "renderer-device",
        )


def count_fitting_gaussians(number: int) -> int:
    """Compute how many Gaussians `number` frozen views can hold within `MAX_FROZEN_BYTES`."""
    return MAX_FROZEN_BYTES // (number * BYTES_PER_SPLAT)


def read_memory_bytes() -> int | None:
    """Return the memory of this machine or its container limit, or None if unknown."""
    limits = []
    for file in _LIMIT_FILES:
        if os.path.isfile(file):
            word = Path(file).read_text("ascii").strip()
            if word.isdecimal():  # cgroup 2 has "max" for no limit
                limits.append(int(word))
    with contextlib.suppress(AttributeError, OSError, ValueError):  # not on Windows
        limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    return min(limits, default=None)


def format_whole_gigabytes(number: int) -> str:
    """Format a number of bytes in whole GB, rounded up."""
    return quote_value(f"{-(-number // 10**9):,} GB")
