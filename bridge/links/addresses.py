"""Network addresses and sockets, and error messages that name the link and the remedy."""

from __future__ import annotations

import errno
import socket
from typing import Any

from bridge.links.link import LinkUri, join_address
from protocol.errors import LinkError, LinkInUseError

Address = tuple[Any, ...]
"""(host, port), followed by flow and scope where IPv6."""


def resolve(uri: LinkUri, kind: socket.SocketKind) -> tuple[socket.AddressFamily, Address]:
    """Return the address family and the address of the URI's host; IPv4 is preferred where it has both.

    Both ends must resolve "localhost" to the same address, and most peers bind it as 127.0.0.1.

    Raises:
        LinkError: no such host.
    """
    try:
        found = socket.getaddrinfo(uri.host, uri.port, type=kind)
    except (OSError, UnicodeError) as error:  # UnicodeError: not a valid host name, for example with an empty label
        reason = f"cannot resolve host {uri.host!r} ({error})"
        raise LinkError(f"{uri.text}: {reason}: correct the name or write an IP address") from error
    family, _, _, _, address = min(found, key=lambda answer: answer[0] != socket.AF_INET)
    return family, address


def new_socket(uri: LinkUri, family: socket.AddressFamily, kind: socket.SocketKind) -> socket.socket:
    """Return a new socket.

    Raises:
        LinkError: the machine lacks this address family, or the process has too many files open.
    """
    try:
        return socket.socket(family, kind)
    except OSError as error:
        raise LinkError(f"{uri.text}: cannot make a socket for {uri.host}: {error}") from error


def cannot_bind(uri: LinkUri, error: OSError) -> LinkError:
    """The error to raise when the system refused to bind or listen at the URI's address."""
    place = f"port {uri.port} on {uri.host}"
    if error.errno == errno.EADDRINUSE:
        return LinkInUseError(f"{uri.text}: {place} is taken: stop the other process or choose another with --link")
    if error.errno in (errno.EACCES, errno.EPERM):
        return LinkError(f"{uri.text}: no permission for {place}: choose a port of 1024 or more with --link")
    if error.errno == errno.EADDRNOTAVAIL:
        return LinkError(f"{uri.text}: {uri.host} is not an address of this machine: use 127.0.0.1 or one of its own")
    return LinkError(f"{uri.text}: cannot open {place}: {error}")


def name_of(address: Address) -> str:
    """Return "host:port" of an address of either family."""
    return join_address(address[0], address[1])
