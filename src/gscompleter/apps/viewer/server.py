"""Serves a page to browsers of this machine only."""

from __future__ import annotations

from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from gscompleter.errors import InputError

ADDRESS = "127.0.0.1"
"""Network interface of the server."""
HOST_NAMES = (ADDRESS, "localhost")
"""Accepted host names; any other one may be a DNS rebinding attack by a website."""


def make_page_server(page: bytes, port: int = 0) -> ThreadingHTTPServer:
    """Make a server for the page on `port` (0 for any), to be started by `serve_forever`.

    Raises:
        InputError: The port is taken.
    """

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.headers.get("Host", "").rsplit(":", 1)[0].lower() not in HOST_NAMES:
                self.send_error(421, "This server answers to 127.0.0.1 and localhost only")
            elif self.path != "/":
                self.send_error(404)
            else:
                self.send_page()

        def send_page(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(page)))
            self.send_header("Cross-Origin-Resource-Policy", "same-origin")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(page)

        def log_message(self, format: str, *args: object) -> None:
            """Log nothing."""

    try:
        return ThreadingHTTPServer((ADDRESS, port), Handler)
    except OSError as error:
        raise InputError(
            f"Port {port} of {ADDRESS} is not available ({error.strerror}); name another one.",
            "port",
        ) from error
