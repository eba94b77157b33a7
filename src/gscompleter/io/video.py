"""Films as people send them: H.264 in an mp4, written by the ffmpeg that imageio-ffmpeg brings."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from gscompleter.errors import InputError, quoted

QUALITY = 18
"""The constant rate factor of x264: 0 loses nothing, and at 18 hardly anybody sees a difference."""
SAME_BYTES = (
    *("-threads", "1", "-filter_threads", "1"),
    *("-fflags", "+bitexact", "-flags:v", "+bitexact", "-map_metadata", "-1"),
)
"""What lets ffmpeg write the same bytes whenever and wherever it runs."""
COLOURS = (
    "-vf",
    "scale=out_color_matrix=bt709:out_range=tv:flags=accurate_rnd+bitexact+bicubic,"
    "setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709",
)
"""Colours as players take those of films to be, and said in the file."""
FOR_PLAYERS = ("-pix_fmt", "yuv420p", "-movflags", "+faststart")
"""What all players know, and the index first, so that a film begins before all of it is there."""


def check_writer() -> None:
    """Make sure, before anything is computed, that a film can be written.

    Raises:
        InputError: where imageio-ffmpeg is missing, or has no ffmpeg for this machine.
    """
    if find_spec("imageio_ffmpeg") is None:
        raise InputError(
            "A film is written through imageio-ffmpeg, which is not installed; run "
            "`pip install gscompleter[film]`.",
            "video",
        )
    ffmpeg()


def ffmpeg() -> str:
    """The program.

    Raises:
        InputError: where imageio-ffmpeg has none for this machine.
    """
    from imageio_ffmpeg import get_ffmpeg_exe

    try:
        return get_ffmpeg_exe()
    except RuntimeError as error:
        raise InputError(
            "imageio-ffmpeg has no ffmpeg for this machine; install one, and name it in "
            "IMAGEIO_FFMPEG_EXE.",
            "video",
        ) from error


def write_video(path: Path, frames: Iterable[UInt8[np.ndarray, "h w 3"]], rate: int) -> None:
    """Write frames of one size, both sides even, into an .mp4 in a folder that nobody reads yet.

    Args:
        path: The file.
        frames: One after the other; they may be drawn while they are written.
        rate: Frames per second.

    Raises:
        InputError: where ffmpeg fails, with what it says.
    """
    iterator = iter(frames)
    first = next(iterator)
    program = command(path, first.shape[1], first.shape[0], rate)
    process = subprocess.Popen(program, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        send(process, first)
        for frame in iterator:
            send(process, frame)
        _, said = process.communicate()
    finally:  # it is done, or somebody stops us
        process.kill()
        process.wait()
    if process.returncode != 0:
        raise InputError(f"ffmpeg could not write {quoted(path)}: {quoted(said.decode(), 200)}")


def send(process: subprocess.Popen[bytes], frame: UInt8[np.ndarray, "h w 3"]) -> None:
    """Give a frame to ffmpeg. Where it has ended, its exit code says so afterwards."""
    assert process.stdin is not None
    with suppress(BrokenPipeError):
        process.stdin.write(np.ascontiguousarray(frame).data)


def command(path: Path, width: int, height: int, rate: int) -> list[str]:
    """What ffmpeg is told: frames come through its standard input, eight bits a channel."""
    return [
        *(ffmpeg(), "-v", "error", "-y", "-nostdin"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(rate)),
        *("-i", "pipe:0", "-an", "-c:v", "libx264", "-preset", "medium", "-crf", str(QUALITY)),
        *(*COLOURS, *FOR_PLAYERS, *SAME_BYTES, str(path)),
    ]
