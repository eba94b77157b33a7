"""A page for the browsers of this machine, and for nobody else."""

from __future__ import annotations

from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

from gscompleter.errors import InputError
from gscompleter.viewer.page import Page

ADDRESS = "127.0.0.1"
"""The interface that is listened on."""
NAMES = (ADDRESS, "localhost")
"""What a browser of this machine calls it. Another name in a request is that of a site which has
pointed its own name here to read what we serve."""
TYPES = {".html": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8"}
"""Media types by the endings of names."""


def serving(page: Page, port: int = 0) -> ThreadingHTTPServer:
    """A server of the page and its parts, which `serve_forever` starts.

    Args:
        page: What it serves; nothing is read from the disk.
        port: Where it listens; 0 for any that is free.

    Raises:
        InputError: where the port is taken.
    """
    files = {"/": page.html, **{f"/{name}": part for name, part in page.parts.items()}}
    try:
        return ThreadingHTTPServer((ADDRESS, port), handler_of(files))
    except OSError as error:
        raise InputError(
            f"Port {port} of {ADDRESS} cannot be listened on ({error.strerror}); name another one.",
            "port",
        ) from error


def handler_of(files: Mapping[str, bytes]) -> type[BaseHTTPRequestHandler]:
    """What answers requests for `files`, which are called by their paths."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.answer(with_body=True)

        def do_HEAD(self) -> None:
            self.answer(with_body=False)

        def answer(self, with_body: bool) -> None:
            path = unquote(urlsplit(self.path).path)
            if host_of(self.headers.get("Host", "")) not in NAMES:
                self.send_error(421, "This server answers to 127.0.0.1 and localhost only")
            elif path not in files:
                self.send_error(404)
            else:
                self.send(path, files[path], with_body)

        def send(self, path: str, content: bytes, with_body: bool) -> None:
            self.send_response(200)
            self.send_header("Content-Type", TYPES[".js" if path.endswith(".js") else ".html"])
            self.send_header("Content-Length", str(len(content)))
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Cross-Origin-Resource-Policy", "same-origin")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            if with_body:
                self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:
            """Requests are nobody's business."""

    return Handler


def host_of(header: str) -> str:
    """The name in a Host header, without its port."""
    return header.rsplit(":", 1)[0].lower()
