"""Serves a page to browsers of this machine only."""

from __future__ import annotations

from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

from gscompleter.apps.viewer.page import Page
from gscompleter.errors import InputError

ADDRESS = "127.0.0.1"
"""Network interface of the server."""
HOST_NAMES = (ADDRESS, "localhost")
"""Accepted host names; any other one may be a DNS rebinding attack by a website."""


def make_page_server(page: Page, port: int = 0) -> ThreadingHTTPServer:
    """Make a server for the page on `port` (0 for any), to be started by `serve_forever`.

    Raises:
        InputError: The port is taken.
    """
    files = {"/": page.html, **{f"/{name}": part for name, part in page.parts.items()}}
    try:
        return ThreadingHTTPServer((ADDRESS, port), make_handler(files))
    except OSError as error:
        raise InputError(
            f"Port {port} of {ADDRESS} is not available ({error.strerror}); name another one.",
            "port",
        ) from error


def make_handler(files: Mapping[str, bytes]) -> type[BaseHTTPRequestHandler]:
    """Make a request handler for `files`, which are keyed by URL path."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = unquote(urlsplit(self.path).path)
            if self.headers.get("Host", "").rsplit(":", 1)[0].lower() not in HOST_NAMES:
                self.send_error(421, "This server answers to 127.0.0.1 and localhost only")
            elif path not in files:
                self.send_error(404)
            else:
                self.send(files[path], "javascript" if path.endswith(".js") else "html")

        def do_HEAD(self) -> None:
            self.do_GET()

        def send(self, content: bytes, kind: str) -> None:
            self.send_response(200)
            self.send_header("Content-Type", f"text/{kind}; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Cross-Origin-Resource-Policy", "same-origin")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:
            """Log nothing."""

    return Handler
