"""The server of the live page: the page, its messages, what changed, and requests.

| request | answer |
|---|---|
| `GET /` | the page of the viewer, with the scene as it was given |
| `GET /events` | messages as server-sent events, without end |
| `GET /difference` | what is hidden of each chunk of Gaussians now (`difference.py`) |
| `GET /chunks/NAME` | Gaussians that a step brought, as .spz |
| `POST /do` | 202, or 409 while another request runs, or 400 and a sentence |
"""

from __future__ import annotations

import json
import socket
from socketserver import TCPServer
from threading import Thread

from gscompleter.apps.live.addresses import Address, check_bindable, explain_bind_error
from gscompleter.apps.live.channel import Channel
from gscompleter.apps.live.page import LivePage
from gscompleter.apps.live.request import BusyError
from gscompleter.apps.viewer.http import HTML, PageHandler, PageServer
from gscompleter.system.errors import InputError

JSON = "application/json"
EVENTS = "text/event-stream"
BYTES = "application/octet-stream"
MAX_REQUEST = 64_000_000
"""Most bytes of a request: a mask of the largest image fits."""
CHUNKS = "/chunks/"


class LiveServer(PageServer):
    """Serves a page in threads of its own."""

    def __init__(self, address: Address, host: str, port: int, page: LivePage) -> None:
        """Listen at an address, which `host` stands for, and begin to serve."""
        self.address = address
        self.page = page
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
        """Address of the page."""
        return self.address.make_url(self.server_port)

    def close(self) -> None:
        """End the server."""
        self.shutdown()
        self.server_close()


class LiveHandler(PageHandler):
    """Answers one request."""

    server: LiveServer

    def do_GET(self) -> None:
        """Answer with the page, a difference, a chunk, or messages."""
        page = self.server.page
        if not self._is_allowed():
            return
        if self.path == "/":
            self.send_content(page.content, HTML)
        elif self.path == "/difference":
            self.send_content(page.difference, JSON)
        elif self.path == "/events":
            self._send_events(page.channel)
        else:
            name = self.path.removeprefix(CHUNKS) if self.path.startswith(CHUNKS) else ""
            chunk = page.get_chunk(name)
            if chunk is None:
                self.send_error(404)
            else:
                self.send_content(chunk, BYTES)

    def do_POST(self) -> None:
        """Accept a request of the page."""
        if not self._is_allowed():
            return
        length = self.headers.get("Content-Length", "")
        if self.path != "/do":
            self.send_error(404)
        # A form of another site cannot have this type.
        elif self.headers.get_content_type() != JSON:
            self.send_error(415, "A request is JSON")
        elif not length.isdigit():
            self.send_error(411)
        elif int(length) > MAX_REQUEST:
            self.send_error(413)
        else:
            self._submit(self.rfile.read(int(length)))

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
        self.send_content(json.dumps(answer).encode(), JSON, status)

    def _is_allowed(self) -> bool:
        """Refuse requests of other sites."""
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
        self.send_header("Cache-Control", "no-store")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.end_headers()
        # Small messages are sent at once.
        self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
        for event in channel.listen():
            self.wfile.write(event)
            self.wfile.flush()
