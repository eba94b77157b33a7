"""What both servers of the page share: answers of bytes, and silence about browsers that leave."""

from __future__ import annotations

import os
import sys
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

HTML = "text/html; charset=utf-8"


class PageHandler(BaseHTTPRequestHandler):
    """Answers requests for a page that no other page may read."""

    def send_content(self, content: bytes, kind: str, status: int = 200) -> None:
        """Send the answer to a request; `kind` is its media type."""
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


class PageServer(ThreadingHTTPServer):
    """A server of pages, whose threads end with the process."""

    # Windows would let two servers share a port, and elsewhere a port is free again at once.
    allow_reuse_address = os.name == "posix"

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore a browser that leaves while it is answered; report any other error."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]
