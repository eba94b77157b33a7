"""Bounds of requests, answers, and silence about who leaves: for servers of `view` and `live`."""

from __future__ import annotations

import os
import socket
import sys
import time
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import BoundedSemaphore
from typing import Any

HTML = "text/html; charset=utf-8"
TEXT = "text/plain; charset=utf-8"
HEADERS = {
    # No other page may read an answer, show the page in a frame, or learn its address.
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
"""Headers of every answer."""
REQUEST_SECONDS = 20.0
"""Time in which a request has to arrive as a whole."""
ANSWER_SECONDS = 60.0
"""Time in which each `ANSWER_PIECE` of an answer has to be taken."""
ANSWER_PIECE = 2**20
"""Bytes of an answer that are sent at once."""
MAX_CLIENTS = 64
"""Most connections that are served at once; every page that is open keeps one."""


class PageHandler(BaseHTTPRequestHandler):
    """Answers requests for a page that no other page may read."""

    server: PageServer
    # Of a single read or write; the server limits the time of a whole request.
    timeout = ANSWER_SECONDS

    def setup(self) -> None:
        """Begin to wait for the request, the only one of its connection (HTTP/1.0)."""
        super().setup()
        self.server.awaited[self.connection] = time.monotonic()

    def parse_request(self) -> bool:
        """Parse the request line and the headers, which are all that most requests have."""
        is_parsed = super().parse_request()
        if is_parsed and self.command != "POST":
            self.server.awaited.pop(self.connection, None)
        return is_parsed

    def read_body(self, length: int) -> bytes | None:
        """Read the body of a request, which ends it; None if the browser left meanwhile."""
        body = self.rfile.read(length)
        self.server.awaited.pop(self.connection, None)
        return body if len(body) == length else None

    def finish(self) -> None:
        """Forget the connection."""
        self.server.awaited.pop(self.connection, None)
        super().finish()

    def send_content(self, content: bytes, kind: str, status: int = 200) -> None:
        """Send the answer to a request; `kind` is its media type."""
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        # The time limit of the connection is that of one write.
        for start in range(0, len(content), ANSWER_PIECE):
            self.wfile.write(content[start : start + ANSWER_PIECE])

    def end_headers(self) -> None:
        """End the headers of any answer, errors included, with those of all."""
        for name, value in HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


class PageServer(ThreadingHTTPServer):
    """A server of pages, whose threads end with the process.

    It serves `MAX_CLIENTS` connections at once, closes further ones, and those whose request has
    not arrived in time.
    """

    # Windows would let two servers share a port, and elsewhere a port is free again at once.
    allow_reuse_address = os.name == "posix"

    def __init__(self, *arguments: Any) -> None:
        """Listen; the arguments are those of any server."""
        self.awaited: dict[socket.socket, float] = {}
        """Connections whose request has not arrived, with the time of their beginning."""
        self._places = BoundedSemaphore(MAX_CLIENTS)
        super().__init__(*arguments)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread of its own, or close it if there are too many."""
        if not self._places.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # no thread can be started
            self._places.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def service_actions(self) -> None:
        """Close what has waited for too long; called after each request and twice a second."""
        now = time.monotonic()
        for connection, begun in list(self.awaited.items()):
            if now - begun > REQUEST_SECONDS:
                with suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore a browser that leaves while it is answered; report any other error."""
        if not isinstance(sys.exc_info()[1], (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)  # type: ignore[arg-type]
