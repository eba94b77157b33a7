"""A server for the browsers of this machine, and for no pages but its own."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from functools import partial
from io import StringIO

import viser
from websockets.asyncio import server as websockets

from gscompleter.errors import InputError

LOCAL = ("127.0.0.1", "localhost")
"""What this machine calls itself."""
OWN_PAGES = re.compile(r"http://(127\.0\.0\.1|localhost)(:\d+)?")
"""Where pages come from that were served on this machine."""


def serving(host: str, port: int) -> viser.ViserServer:
    """A server at an address; it runs in threads of its own.

    Raises:
        InputError: where the address cannot be had.
    """
    try:
        socket.create_server((host, port)).close()
    except OSError as error:
        raise InputError(
            f"Nothing can be served at {host}, port {port}: {error.strerror}; choose another port.",
            "port",
        ) from error
    with redirect_stdout(StringIO()), only_own_pages(host):  # viser prints a box of its own
        return viser.ViserServer(host, port, verbose=False)


@contextmanager
def only_own_pages(host: str) -> Iterator[None]:
    """Servers that viser starts inside, for this machine alone, refuse pages from elsewhere.

    Any page that is open in a browser may connect to this machine, and only its `Origin` tells.
    websockets checks that where it is asked to; viser, which starts it, has no option for it.
    Programs name no origin.
    """
    plain = websockets.serve
    if host in LOCAL:
        websockets.serve = partial(plain, origins=[OWN_PAGES, None])  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        websockets.serve = plain  # type: ignore[misc]
