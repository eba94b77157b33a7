"""Resolve the address that serves the live page, and check who asks for it."""

from __future__ import annotations

import errno
import ipaddress
import os
import re
import socket
from dataclasses import dataclass
from urllib.parse import urlsplit

from gscompleter.system.errors import InputError, quote_value

LOCAL_HOST = re.compile(r"(127(\.\d{1,3}){3}|\[::1\]|localhost)(:\d+)?", re.IGNORECASE)
"""Names of this machine in a request; any other may be a DNS rebinding attack by a website."""
IPV6_HOST = re.compile(r"\[([^]]+)\](:\d+)?")
"""An IPv6 address in a request, in brackets, with or without a port."""


@dataclass(frozen=True)
class Address:
    """An address of this machine, as the system knows it."""

    family: socket.AddressFamily
    host: str
    """Number of the address, which is the same for all its spellings, without the zone of an IPv6
    address: `getaddrinfo` leaves that out."""

    @property
    def is_local(self) -> bool:
        """Return True if only programs of this machine can reach it."""
        number = ipaddress.ip_address(self.host)
        # An IPv4 address may be written as IPv6, "::ffff:127.0.0.1".
        return (getattr(number, "ipv4_mapped", None) or number).is_loopback

    def make_url(self, port: int) -> str:
        """Return the address of the page at a port."""
        host = f"[{self.host}]" if self.family == socket.AF_INET6 else self.host
        return f"http://{host}:{port}/"

    def knows_host(self, host: str) -> bool:
        """Return True if a request for `host`, a name with or without a port, may be meant for it.

        An address that other machines can reach has names that are not known here.
        """
        if not self.is_local or LOCAL_HOST.fullmatch(host) is not None:
            return True
        # What is left is an IPv4 address in IPv6, which browsers spell "::ffff:7f00:1".
        written = IPV6_HOST.fullmatch(host)
        try:
            number = ipaddress.ip_address("" if written is None else written[1])
        except ValueError:  # no address at all
            return False
        return number == ipaddress.ip_address(self.host)

    def knows_origin(self, host: str, origin: str | None) -> bool:
        """Return True if a request for `host` comes from the page itself, or from a program.

        Any page in a browser may send requests here; only the header `Origin` shows its source.
        Programs send none, for which None stands.
        """
        if origin is None:
            return True
        try:
            return urlsplit(origin).netloc.lower() == host.lower() != ""
        except ValueError:  # no address at all
            return False


def resolve_host(host: str) -> Address:
    """Find the address that a host name stands for, or any spelling of an address.

    InputError is raised if there is none; whether it is of this machine, `check_bindable` tells.
    """
    try:
        family, *_, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "no name of a host"
        raise InputError(
            f"'{quote_value(host)}' is no address of this machine ({reason}); name another one, "
            "such as 127.0.0.1.",
            "host",
        ) from error
    return Address(family, str(place[0]))


def check_bindable(address: Address, host: str, port: int) -> None:
    """Raise an InputError if a server cannot listen at an address, which `host` stands for."""
    try:
        socket.create_server((address.host, port), family=address.family).close()
    except OSError as error:
        raise explain_bind_error(error, host, port) from error


def explain_bind_error(error: OSError, host: str, port: int) -> InputError:
    """Make the sentence why a server cannot listen."""
    if error.errno in (errno.EADDRINUSE, errno.EACCES):
        return InputError(
            f"{quote_value(host)} cannot use port {port} ({describe_error(error)}); choose "
            "another port.",
            "port",
        )
    return InputError(
        f"{quote_value(host)} is no address of this machine ({describe_error(error)}); name "
        "another one, such as 127.0.0.1.",
        "host",
    )


def describe_error(error: OSError) -> str:
    """Return the system's words for an error, without those that Python adds to some."""
    return str(error) if error.errno is None else os.strerror(error.errno)
