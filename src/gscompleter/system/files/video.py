"""Videos, read and written by the ffmpeg of imageio-ffmpeg."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import UInt8

from gscompleter.system.errors import (
    FullDiskError,
    InputError,
    quote_value,
    refuse_pointer,
)
from gscompleter.system.files.writing import FULL_DISK_ERRORS
from gscompleter.system.threads import get_thread_count

X264_RATE_FACTOR = 18
"""Constant rate factor of x264: 0 is lossless, 18 is visually lossless."""
OUTPUT_OPTIONS = (
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
"""Options of ffmpeg for a video that it writes."""
INPUT_OPTIONS = ("-protocol_whitelist", "file", "-format_whitelist", "mov,matroska")
"""Options of ffmpeg for a video of the user: these containers, no further files or addresses."""
SQUARE_PIXELS = "scale='round(iw*clip(sar,1/4,4))':ih"
"""Filter of ffmpeg that scales the width as players do, where pixels of the file are not square.

`sar` is the width of a pixel over its height; no camera has one beyond these bounds.
"""
CUT_OFF = "ended prematurely"
"""Message of ffmpeg about a truncated Matroska file, which is no error to it."""


def find_ffmpeg() -> str:
    """Find the path of ffmpeg; raise InputError if there is none for this machine."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise InputError(
            "Videos need imageio-ffmpeg, which is not installed or has no ffmpeg for this machine; "
            "run `pip install gscompleter[film]`."
        ) from error


def read_video(path: Path, filters: str, is_grey: bool) -> Iterator[UInt8[np.ndarray, "h w *c"]]:
    """Decode a video frame by frame, in grey or colours, after `filters` of ffmpeg.

    Frames are upright and of square pixels, as players show them.
    """
    refuse_pointer(path)
    command = [
        *(find_ffmpeg(), "-v", "error", "-nostdin", "-xerror", *INPUT_OPTIONS),
        *("-threads", str(get_thread_count()), "-i", f"file:{path}", "-an", "-sn", "-dn"),
        # Every frame once, whatever its time; the header of a PNM has its size.
        *("-fps_mode", "passthrough", "-vf", f"{SQUARE_PIXELS},{filters}"),
        *("-sws_flags", "accurate_rnd+bitexact"),
        *("-f", "image2pipe", "-c:v", "pgm" if is_grey else "ppm"),
        *("-pix_fmt", "gray" if is_grey else "rgb24", "pipe:1"),
    ]
    with (
        tempfile.TemporaryFile() as log,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log) as process,
    ):
        assert process.stdout is not None
        try:
            yield from _read_images(process.stdout)
            process.wait()
        finally:  # also where the reader stops
            process.kill()
        log.seek(0)
        messages = log.read().decode(errors="replace").strip()
        if process.returncode != 0 or CUT_OFF in messages:
            raise InputError(
                f"{quote_value(path, 80)} is no video that can be read to its end "
                f"({_choose_reason(messages)}); copy it again, or export it as H.264 in .mp4."
            )


def _read_images(stream: IO[bytes]) -> Iterator[UInt8[np.ndarray, "h w *c"]]:
    """Read 8-bit PNM images until the stream ends; one that is cut off is left out."""
    # Each image has three lines of header: the kind, both sides, and the largest value.
    while kind := stream.readline():
        sides = stream.readline()
        largest = stream.readline()
        if not largest.endswith(b"\n"):
            return  # ffmpeg failed, which its exit code tells
        width, height = map(int, sides.split())
        shape = (height, width) if kind == b"P5\n" else (height, width, 3)
        pixels = stream.read(math.prod(shape))
        if len(pixels) == math.prod(shape):  # else ffmpeg failed
            yield np.frombuffer(pixels, np.uint8).reshape(shape)


def _choose_reason(messages: str) -> str:
    """Choose the first line that ffmpeg said, without the name of its part that said so."""
    # As in `[out#0/mp4 @ 0x55ab9d184700] Error opening output`; the place in memory tells nothing.
    line = re.sub(r"\[[^]]* @ \w*\] ", "", messages).partition("\n")[0]
    return quote_value(line.rstrip("."), 80)


def write_video(path: Path, frames: Iterable[UInt8[np.ndarray, "h w 3"]], rate: int) -> None:
    """Write one or more frames of one size, both sides even, as an mp4 of `rate` frames a second.

    Raises InputError if ffmpeg cannot write the file, which is FullDiskError on a full disk.
    """
    iterator = iter(frames)
    first = next(iterator)
    size = f"{first.shape[1]}x{first.shape[0]}"
    command = [
        *(find_ffmpeg(), "-v", "error", "-y", "-nostdin"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(rate)),
        *("-i", "pipe:0", "-an"),
        *("-c:v", "libx264", "-preset", "medium", "-crf", str(X264_RATE_FACTOR)),
        # A path that begins with a dash, or holds a colon, is no option or address.
        *(*OUTPUT_OPTIONS, f"file:{path}"),
    ]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdin is not None
    try:
        for frame in chain([first], iterator):
            try:
                process.stdin.write(np.ascontiguousarray(frame).data)
            except OSError:  # ffmpeg has ended, and its exit code tells why
                break
        _, messages = process.communicate()
    finally:  # also on an interrupt
        process.kill()
        process.wait()
    if process.returncode != 0:
        raise make_video_error(path, messages.decode(errors="replace").strip(), process.returncode)


def make_video_error(path: Path, messages: str, code: int) -> InputError:
    """Make the error about a video that ffmpeg did not write, from its messages and exit code."""
    # A limit of the system on the size of a file ends ffmpeg by a signal, without a message.
    is_too_large = code == -getattr(signal, "SIGXFSZ", math.nan)  # which Windows does not have
    is_full = any(os.strerror(number) in messages for number in FULL_DISK_ERRORS)
    reason = _choose_reason(messages) or f"it ended with code {code}"
    sentence = f"ffmpeg could not write {quote_value(path)} ({reason})"
    if is_full or is_too_large:
        return FullDiskError(f"{sentence}; free some space, or choose another place.")
    return InputError(f"{sentence}; choose another place.")
