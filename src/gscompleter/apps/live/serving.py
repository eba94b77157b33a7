"""A viser server that accepts only pages of this machine."""

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

LOCAL_HOSTS = ("127.0.0.1", "localhost")
LOCAL_ORIGIN = re.compile(r"http://(127\.0\.0\.1|localhost)(:\d+)?")


def start_server(host: str, port: int) -> viser.ViserServer:
    """Start a server, which runs in threads of its own."""
    try:
        socket.create_server((host, port)).close()
    except OSError as error:
        raise InputError(
            f"{host} cannot use port {port} ({error.strerror}); choose another port.",
            "port",
        ) from error
    with redirect_stdout(StringIO()), refuse_foreign_origins(host):  # viser prints a box
        return viser.ViserServer(host, port, verbose=False)


@contextmanager
def refuse_foreign_origins(host: str) -> Iterator[None]:
    """Make servers started inside refuse pages of other origins if `host` is this machine.

    Any page in a browser may connect to this machine; only its `Origin` shows its source.
    websockets can check it, but viser has no option for that. Programs send no origin and may
    connect.
    """
    plain = websockets.serve
    if host in LOCAL_HOSTS:
        websockets.serve = partial(plain, origins=[LOCAL_ORIGIN, None])  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        websockets.serve = plain  # type: ignore[misc]
