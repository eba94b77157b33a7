"""Interrupts: Ctrl-C, `kill`, a scheduler, or a closed terminal."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


def handle_stop_signals() -> None:
    """Let SIGTERM and SIGHUP raise KeyboardInterrupt, so that everything is cleaned up.

    Signals that are ignored (`nohup`) or handled already stay so. This works in the main thread
    only.
    """
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)


@contextmanager
def defer_interrupts(state: str) -> Iterator[None]:
    """Defer KeyboardInterrupt, with the message `state`, to the end of a block."""
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
        raise KeyboardInterrupt(state)
