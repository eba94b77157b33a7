"""The server of the live page: the page, its messages, what changed, and requests.

Whoever sends a request has to know the token in the address that the program prints: a website
whose name leads here, others in the network, and other users of this machine do not. The page takes
the token from its address and sends it with each request. A cookie would go to all servers of this
machine, as browsers do not keep ports apart.

| request | answer |
|---|---|
| `GET /` | the page of the viewer, with the scene as it was given |
| `GET /?open=CODE` | the way to the page with its token, once (`LiveServer.opening_url`) |
| `GET /events` | messages as server-sent events, without end |
| `GET /difference` | what is hidden of each chunk of Gaussians now (`difference.py`) |
| `GET /chunks/NAME` | Gaussians that a step brought, as .spz |
| `POST /do` | 202, or 409 while another request runs, or 400 and a sentence |
| any without the token | 403 and a sentence |
"""

from __future__ import annotations

import json
import secrets
import socket
from socketserver import TCPServer
from threading import Thread
from urllib.parse import parse_qs

from gscompleter.apps.live.addresses import Address, check_bindable, explain_bind_error
from gscompleter.apps.live.channel import Channel
from gscompleter.apps.live.page import LivePage
from gscompleter.apps.live.request import BusyError
from gscompleter.apps.viewer.http import HTML, TEXT, PageHandler, PageServer
from gscompleter.system.errors import InputError

JSON_TYPE = "application/json"
EVENTS = "text/event-stream"
BYTES_TYPE = "application/octet-stream"
MAX_REQUEST = 16_000_000
"""Most bytes of a request. Its mask is a PNG of few colours: a hundredth of that is usual."""
MAX_LENGTH_DIGITS = 12
"""Most digits of a length; Python refuses to read thousands."""
CHUNKS = "/chunks/"
TOKEN_BYTES = 16
"""Random bytes of a token, which nobody can guess."""
NO_TOKEN = b"Open the whole address that the program printed: its token is missing or wrong.\n"


class LiveServer(PageServer):
    """Serves a page in threads of its own."""

    def __init__(self, address: Address, host: str, port: int, page: LivePage) -> None:
        """Listen at an address, which `host` stands for, and begin to serve."""
        self.address = address
        self.page = page
        self.token = secrets.token_urlsafe(TOKEN_BYTES)
        self._code = secrets.token_urlsafe(TOKEN_BYTES)
        self.address_family = address.family
        check_bindable(address, host, port)
        try:
            super().__init__((address.host, port), LiveHandler)
        except OSError as error:
            raise explain_bind_error(error, host, port) from error
        Thread(target=self.serve_forever, daemon=True).start()

    def server_bind(self) -> None:
        """Bind without a search for the name of the host, which may take seconds."""
        TCPServer.server_bind(self)
        self.server_name = self.address.host
        self.server_port = self.server_address[1]

    @property
    def url(self) -> str:
        """Address of the page, with its token."""
        return f"{self.address.make_url(self.server_port)}?token={self.token}"

    @property
    def opening_url(self) -> str:
        """Address that leads to the page once, for a command line, which all users can read."""
        return f"{self.address.make_url(self.server_port)}?open={self._code}"

    def has_token(self, query: str) -> bool:
        """Check whether a query has the token, in a time that tells nothing about it."""
        return secrets.compare_digest(_get_value(query, "token"), self.token.encode())

    def take_code(self, query: str) -> bool:
        """Check whether a query has the code of `opening_url`, which then opens nothing more."""
        is_right = secrets.compare_digest(_get_value(query, "open"), self._code.encode())
        if is_right:
            self._code = secrets.token_urlsafe(TOKEN_BYTES)
        return is_right

    def close(self) -> None:
        """End the server."""
        self.shutdown()
        self.server_close()


def _get_value(query: str, name: str) -> bytes:
    """Return the last value of a name in the query of an address; empty without one."""
    return parse_qs(query).get(name, [""])[-1].encode()


class LiveHandler(PageHandler):
    """Answers one request."""

    server: LiveServer

    def do_GET(self) -> None:
        """Answer with the page, a difference, a chunk, or messages."""
        page = self.server.page
        path, _, query = self.path.partition("?")
        if not self._is_from_page():
            return
        if path == "/" and self.server.take_code(query):
            self.send_response(303)
            self.send_header("Location", f"/?token={self.server.token}")
            self.end_headers()
        elif not self.server.has_token(query):
            self.send_content(NO_TOKEN, TEXT, 403)
        elif path == "/":
            self.send_content(page.content, HTML)
        elif path == "/difference":
            self.send_content(page.difference, JSON_TYPE)
        elif path == "/events":
            self._send_events(page.channel)
        else:
            name = path.removeprefix(CHUNKS) if path.startswith(CHUNKS) else ""
            chunk = page.get_chunk(name)
            if chunk is None:
                self.send_error(404)
            else:
                self.send_content(chunk, BYTES_TYPE)

    def do_POST(self) -> None:
        """Accept a request of the page."""
        path, _, query = self.path.partition("?")
        if not self._is_from_page():
            return
        length = self.headers.get("Content-Length", "")
        # Digits of other scripts are digits for Python, too.
        is_length = length.isascii() and length.isdecimal()
        if not self.server.has_token(query):
            self.send_content(NO_TOKEN, TEXT, 403)
        elif path != "/do":
            self.send_error(404)
        # A form of another site cannot have this type.
        elif self.headers.get_content_type() != JSON_TYPE:
            self.send_error(415, "A request is JSON")
        elif not length:
            self.send_error(411)
        elif not is_length:
            self.send_error(400, "The length is no number")
        elif len(length) > MAX_LENGTH_DIGITS or int(length) > MAX_REQUEST:
            self.send_error(413)
        else:
            body = self.read_body(int(length))
            if body is not None:
                self._submit(body)

    def _submit(self, body: bytes) -> None:
        answer: dict[str, str] = {}
        status = 202
        try:
            self.server.page.submit(body)
        except InputError as error:
            answer["text"] = str(error)
            status = 400
        except BusyError as error:
            answer["text"] = str(error)
            status = 409
        self.send_content(json.dumps(answer).encode(), JSON_TYPE, status)

    def _is_from_page(self) -> bool:
        """Refuse requests of other sites, in whose browsers the page may be open, too."""
        address = self.server.address
        host = self.headers.get("Host", "")
        if not address.knows_host(host):
            self.send_error(421, "This server answers to the names of this machine only")
            return False
        if not address.knows_origin(host, self.headers.get("Origin")):
            self.send_error(403, "This server answers to its own page only")
            return False
        return True

    def _send_events(self, channel: Channel) -> None:
        self.send_response(200)
        self.send_header("Content-Type", EVENTS)
        self.end_headers()
        # Small messages are sent at once.
        self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
        for event in channel.listen():
            self.wfile.write(event)
            self.wfile.flush()
