"""H.264 videos in mp4, written by the ffmpeg of imageio-ffmpeg."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from contextlib import suppress
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from gscompleter.errors import InputError, quote_value

QUALITY = 18
"""Constant rate factor of x264: 0 is lossless, 18 is visually lossless."""
OPTIONS = (
    # The colour space that players assume, stored in the file.
    "-vf",
    "scale=out_color_matrix=bt709:out_range=tv:flags=accurate_rnd+bitexact+bicubic,"
    "setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709",
    # A pixel format that all players know, and an index at the start.
    *("-pix_fmt", "yuv420p", "-movflags", "+faststart"),
    # The same bytes on every run and machine.
    *("-threads", "1", "-filter_threads", "1"),
    *("-fflags", "+bitexact", "-flags:v", "+bitexact", "-map_metadata", "-1"),
)
"""Options of ffmpeg for the output."""


def find_ffmpeg() -> str:
    """Find the path of ffmpeg; raise InputError if there is none for this machine."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise InputError(
            "A film is written through imageio-ffmpeg, which is not installed or has no ffmpeg for "
            "this machine; run `pip install gscompleter[film]`.",
            "video",
        ) from error


def write_video(path: Path, frames: Iterable[UInt8[np.ndarray, "h w 3"]], rate: int) -> None:
    """Write frames of one size, both sides even, as an mp4 with `rate` frames per second."""
    iterator = iter(frames)
    first = next(iterator)
    size = f"{first.shape[1]}x{first.shape[0]}"
    command = [
        *(find_ffmpeg(), "-v", "error", "-y", "-nostdin"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(rate)),
        *("-i", "pipe:0", "-an", "-c:v", "libx264", "-preset", "medium", "-crf", str(QUALITY)),
        *(*OPTIONS, str(path)),
    ]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdin is not None
    try:
        for frame in chain([first], iterator):
            with suppress(OSError):  # if ffmpeg has ended, its exit code tells
                process.stdin.write(np.ascontiguousarray(frame).data)
        _, messages = process.communicate()
    finally:  # also on an interrupt
        process.kill()
        process.wait()
    if process.returncode != 0:
        raise InputError(
            f"ffmpeg could not write {quote_value(path)}: {quote_value(messages.decode(), 200)}"
        )
