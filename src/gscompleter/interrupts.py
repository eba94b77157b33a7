"""Being told to stop: by Ctrl-C, by `kill`, by a scheduler, by a terminal that is closed."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


def treat_stops_alike() -> None:
    """Let SIGTERM and SIGHUP raise KeyboardInterrupt, as Ctrl-C does, so that all is cleaned up.

    A signal that somebody ignores (`nohup`) or handles already is left as it is. Python allows
    this in the main thread alone.
    """
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)


@contextmanager
def stops_deferred(state: str = "") -> Iterator[None]:
    """Let what raises KeyboardInterrupt wait until the end of the block.

    For a few steps that belong together, such as publishing results and removing what they
    replace. Outside of the main thread nothing is interrupted, and nothing is changed.

    Args:
        state: What the interrupt then says of the results, where it is not what is usual.

    Raises:
        KeyboardInterrupt: at the end, if there was a reason meanwhile.
    """
    came: list[int] = []

    def remember(number: int, _: FrameType | None) -> None:
        came.append(number)

    handled = []
    if threading.current_thread() is threading.main_thread():
        handled = [n for n in signal.Signals if signal.getsignal(n) is signal.default_int_handler]
    for number in handled:
        signal.signal(number, remember)
    try:
        yield
    finally:
        for number in handled:
            signal.signal(number, signal.default_int_handler)
    if came:
        raise KeyboardInterrupt(*([state] if state else []))
