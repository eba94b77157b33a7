"""Messages to all browsers that have the page open."""

from __future__ import annotations

import json
from collections.abc import Iterator
from queue import Empty, SimpleQueue
from threading import Lock
from typing import Any

HEARTBEAT_SECONDS = 15.0
"""Time after which an idle browser is written to, to notice that it has left."""
HEARTBEAT = b": still here\n\n"


class Channel:
    """Sends messages as server-sent events; a browser that comes gets the latest one first.

    A browser that reads slowly loses none, since each may be an answer to it. They are short, and
    few: the steps of a session.
    """

    def __init__(self) -> None:
        self._latest: dict[str, Any] = {}
        self._listeners: list[SimpleQueue[dict[str, Any]]] = []
        self._lock = Lock()

    @property
    def latest(self) -> dict[str, Any]:
        """The latest message; empty before the first one."""
        return self._latest

    def send(self, message: dict[str, Any]) -> None:
        """Send a message to all listeners."""
        with self._lock:
            self._latest = message
            for listener in self._listeners:
                listener.put(message)

    def listen(self) -> Iterator[bytes]:
        """Wait for messages and yield each as an event, without end."""
        queue = SimpleQueue[dict[str, Any]]()
        with self._lock:
            if self._latest:
                queue.put(self._latest)
            self._listeners.append(queue)
        try:
            while True:
                try:
                    message = queue.get(timeout=HEARTBEAT_SECONDS)
                except Empty:
                    yield HEARTBEAT
                else:
                    yield f"data: {json.dumps(message)}\n\n".encode()
        finally:
            with self._lock:
                self._listeners.remove(queue)
