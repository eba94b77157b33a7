"""Being told to stop: by Ctrl-C, by `kill`, by a scheduler, by a terminal that is closed."""

from __future__ import annotations

import signal


def treat_stops_alike() -> None:
    """Let SIGTERM and SIGHUP raise KeyboardInterrupt, as Ctrl-C does, so that all is cleaned up.

    A signal that somebody ignores (`nohup`) or handles already is left as it is. Python allows
    this in the main thread alone.
    """
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)
