"""Interrupts: Ctrl-C, `kill`, a scheduler or a closed terminal ends a process in one way.

They wait while results are renamed, so that a result is there completely or not at all.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


def handle_stop_signals() -> None:
    """Let the signals that end a process raise KeyboardInterrupt, so that it cleans up.

    Signals that are ignored (`nohup`) or handled already stay so. This works in the main thread
    only.
    """
    for name in ("SIGTERM", "SIGHUP", "SIGBREAK"):
        number = getattr(signal, name, None)  # only Windows has the last, and no SIGHUP
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)


@contextmanager
def defer_interrupts(state: str) -> Iterator[None]:
    """Defer KeyboardInterrupt to the end of a block.

    It has the message `state`; none if the block failed, whose error it then replaces.
    """
    came: list[int] = []
    handled = []
    if threading.current_thread() is threading.main_thread():
        numbers = signal.valid_signals()  # on Windows, `Signals` has others
        handled = [n for n in numbers if signal.getsignal(n) is signal.default_int_handler]
    for number in handled:
        signal.signal(number, lambda number, _: came.append(number))
    is_done = False
    try:
        yield
        is_done = True
    finally:
        for number in handled:
            signal.signal(number, signal.default_int_handler)
        # After a failure, too: who handles that would go on, though the process was told to end.
        if came:
            raise KeyboardInterrupt(*([state] if is_done else []))
