"""Link: one end of a byte link, with the same interface for every transport; and how a URI is opened as a link.

    udpin://127.0.0.1:14560         waits for a peer          bridge/links/udp.py
    udpout://127.0.0.1:14560        sends to one
    tcpin://127.0.0.1:4560          waits for a client        bridge/links/tcp.py
    tcpout://127.0.0.1:4560         connects to a server
    serial:///dev/ttyUSB0:921600    a serial line             bridge/links/serial_port.py
    mem://loop                      inside this process       bridge/links/memory.py

To add a transport: one file, one row in LINKS (and a medium in `parse_link_uri` where its URI has another form), and a
test class that inherits `tests.contracts.link_contract.LinkContract`.
"""

from __future__ import annotations

import abc
import enum
import importlib
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Final, Protocol, Self, cast

from protocol.errors import LinkClosedError, LinkError, LinkUriError

NOBODY: Final = "nobody yet"
"""Value of `Link.peer` before there is a peer."""

SHORTEST_WAIT_S: Final = 1e-6
"""A timeout below this (negative ones too) counts as 0."""


@dataclass(slots=True)
class LinkStats:
    """Counters of a link since it was opened; bytes are payload bytes, without the transport's headers."""

    received: int = 0
    """Datagrams or, on a stream, chunks handed to the caller."""
    received_bytes: int = 0
    sent: int = 0
    """Sends that the system accepted completely."""
    sent_bytes: int = 0
    unknown_peer: int = 0
    """Datagrams dropped because their sender is not the peer."""
    no_peer: int = 0
    """Sends dropped because there is no peer yet."""
    send_failed: int = 0
    """Sends dropped because the system refused them: full buffer, too large, no listener at the address."""
    refused: int = 0
    """Receives that reported no listener at the peer's port (ECONNREFUSED)."""

    def as_dict(self) -> dict[str, int]:
        """Return the counters by name, for a summary."""
        return asdict(self)


class Link(abc.ABC):
    """One end of a byte link.

    A datagram link (`is_datagram`) preserves message boundaries: one `recv` returns the data of one `send`, or nothing. A
    stream link returns chunks with arbitrary boundaries. Every wait is bounded. One thread receives and one (the same or
    another) sends; any thread may call `close`, and a `recv` in progress then ends by its timeout at the latest.
    """

    spin_s: float = 0.0
    """Time to poll in `recv` before sleeping: lower latency for a busy core. UDP only; other links ignore it."""

    received_ns: int = 0
    """When the kernel received the data that `recv` returned last, on `MonotonicClock`; 0 where that is not known."""

    def __init__(self, uri: str) -> None:
        """Set up the common state; error messages name the link by `uri`."""
        self.uri = uri
        self.stats = LinkStats()
        self._closed = False

    @property
    def is_datagram(self) -> bool:
        """Whether the link preserves message boundaries."""
        return scheme_of(self.uri).is_datagram

    @abc.abstractmethod
    def recv(self, timeout_s: float) -> bytes | None:
        """Return the next datagram or chunk, or None after `timeout_s` without data (0 polls).

        Raises:
            LinkClosedError: this end was closed, or a stream's other end was and all its data has been returned.
            LinkError: the system reports that the link broke.
        """

    @abc.abstractmethod
    def send(self, data: bytes | bytearray | memoryview) -> None:
        """Send `data` as one datagram, or append it to the stream.

        A datagram that cannot be sent at once is dropped and counted. A stream waits a bounded time for buffer space.

        Raises:
            LinkClosedError: this end was closed, or a stream's other end was.
            LinkError: a stream's other end did not read fast enough.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Release the port or device; calling it again does nothing."""

    @property
    @abc.abstractmethod
    def peer(self) -> str:
        """A name for the other end, for messages: "127.0.0.1:43210", or NOBODY."""

    def stamp_receives(self) -> bool:
        """Set `received_ns` from now on; False where the transport or the system cannot.

        Linux enables its stamps shortly after the request: until then the stamp is the time of the fetch.
        """
        return False

    def dropped_by_system(self) -> int:
        """Datagrams that the system dropped since the link was opened, because they were not received in time.

        0 where nothing can be dropped so (a stream), or the system does not say.
        """
        return 0

    def counters(self) -> dict[str, int]:
        """Counters of the link, by name."""
        return self.stats.as_dict()

    def release_peer(self) -> None:  # noqa: B027  (most links have nothing to release)
        """Forget the peer, so that another one can take its place; does nothing where the peer is fixed."""

    def __enter__(self) -> Self:
        """Return the link itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the link."""
        self.close()

    def _broken(self, cause: BaseException) -> LinkError:
        """The error to raise for `cause`, an error while using the link; also after another thread closed the link."""
        if self._closed:
            return LinkClosedError(f"{self.uri} is closed on this end")
        return LinkError(f"{self.uri} broke: {cause}")


@dataclass(frozen=True, slots=True)
class LinkUri:
    """The parts of a link URI; a part that the scheme does not have is empty or 0."""

    text: str
    """The URI as given."""
    scheme: str
    host: str = ""
    """IPv6 addresses without brackets."""
    port: int = 0
    """0 (only on a link that waits for its peer): the system chooses a port."""
    path: str = ""
    """The serial device."""
    baud: int = 0
    """Bits per second of the serial line."""
    name: str = ""
    """The name of the link inside the process."""


class _Opener(Protocol):
    def __call__(self, uri: LinkUri, *, connect_timeout_s: float) -> Link: ...


class Medium(enum.Enum):
    """What carries a link."""

    NETWORK = "network"
    SERIAL = "serial line"
    MEMORY = "this process"


@dataclass(frozen=True, slots=True)
class Scheme:
    """Properties of all links of one scheme.

    opener        "module:callable", which takes a LinkUri and connect_timeout_s; imported when a link is first opened
    capacity      bytes per second one way; an assumed value where the URI does not give it
    is_datagram   see `Link`
    counterpart   scheme of the other end's URI, which is otherwise the same
    waits         whether this end waits for its peer, and so needs no address of it
    header_bytes  overhead of each datagram or segment
    port          port that error messages propose
    """

    opener: str
    medium: Medium
    capacity: Callable[[LinkUri], float]
    is_datagram: bool
    counterpart: str
    waits: bool = False
    header_bytes: int = 0
    port: int = 0


BITS_PER_BYTE = 10
"""On a serial line: start bit, eight data bits, stop bit."""
ETHERNET_BYTES_PER_S = 12.5e6
"""Assumed for a network: 100 Mbit/s."""
MEMORY_BYTES_PER_S = 1e9
"""Assumed for this machine's own memory."""
_LOOPBACK = ("127.", "localhost", "::1")
_ETHERNET_FRAME = 38  # preamble 8, addresses and type 14, check 4, gap 12


def _of_network(uri: LinkUri) -> float:
    return MEMORY_BYTES_PER_S if uri.host.startswith(_LOOPBACK) else ETHERNET_BYTES_PER_S


def _udp(opener: str, counterpart: str, *, waits: bool) -> Scheme:
    headers = _ETHERNET_FRAME + 20 + 8
    return Scheme(opener, Medium.NETWORK, _of_network, True, counterpart, waits, headers, port=14560)


def _tcp(opener: str, counterpart: str, *, waits: bool) -> Scheme:
    headers = _ETHERNET_FRAME + 20 + 32
    return Scheme(opener, Medium.NETWORK, _of_network, False, counterpart, waits, headers, port=4560)


LINKS: Final[Mapping[str, Scheme]] = MappingProxyType(
    {
        "udpin": _udp("bridge.links.udp:UdpIn", "udpout", waits=True),
        "udpout": _udp("bridge.links.udp:UdpOut", "udpin", waits=False),
        "tcpin": _tcp("bridge.links.tcp:TcpIn", "tcpout", waits=True),
        "tcpout": _tcp("bridge.links.tcp:TcpOut", "tcpin", waits=False),
        "serial": Scheme(
            "bridge.links.serial_port:SerialLink",
            Medium.SERIAL,
            lambda uri: uri.baud / BITS_PER_BYTE,
            is_datagram=False,
            counterpart="serial",
        ),
        "mem": Scheme(
            "bridge.links.memory:open_memory",
            Medium.MEMORY,
            lambda _: MEMORY_BYTES_PER_S,
            is_datagram=True,
            counterpart="mem",
        ),
    }
)

_DEFAULT_HOST = "127.0.0.1"  # all interfaces only on request: anyone who reaches the port can move the vehicle
_PROPOSED_LINK = "udpin://127.0.0.1:14560"
_PROPOSED_SERIAL = "serial:///dev/ttyUSB0:921600"
_HOST_AND_PORT = re.compile(r"(?:\[(?P<ipv6>[^\[\]\s]+)\]|(?P<host>[^\[\]:/@?#\s]*))(?::(?P<port>[^:]*))?")
_LARGEST_PORT = 65535
_LARGEST_PORT_DIGITS = 5


def open_link(uri: str, *, connect_timeout_s: float = 10.0) -> Link:
    """Open this process's end of the link that `uri` names; the caller closes it.

    `connect_timeout_s` bounds the wait for a server at a `tcpout` address; no other link waits when it is opened.

    Raises:
        LinkUriError: the URI is not valid.
        LinkInUseError: the port, device or name is in use.
        LinkError: no permission, no such device, no such host.
        PeerMissingError: nothing listens at a `tcpout` address.
    """
    parsed = parse_link_uri(uri)
    module, _, name = LINKS[parsed.scheme].opener.partition(":")
    opener = cast(_Opener, getattr(importlib.import_module(module), name))
    return opener(parsed, connect_timeout_s=connect_timeout_s)


def parse_link_uri(text: str) -> LinkUri:
    """Parse a link URI without opening anything.

    Raises:
        LinkUriError: the URI is not valid; the message says why and shows a valid one.
    """
    scheme, _, rest = text.partition("://")
    medium = scheme_of(text).medium
    if medium is Medium.SERIAL:
        return _parse_serial(text, rest)
    if medium is Medium.MEMORY:
        if not re.fullmatch(r"[\w.-]+", rest):
            raise _bad(text, "the name may only contain letters, digits, '.', '_' and '-'", "mem://loop")
        return LinkUri(text, scheme, name=rest)
    return _parse_network(text, scheme, rest)


def scheme_of(text: str) -> Scheme:
    """The row of a link URI's scheme. Raises LinkUriError where there is none."""
    scheme, separator, _ = text.partition("://")
    if not separator or scheme not in LINKS:
        schemes = ", ".join(f"{known}://" for known in LINKS)
        raise _bad(text, f"it must begin with one of {schemes}", _PROPOSED_LINK)
    return LINKS[scheme]


def counterpart(text: str) -> str:
    """The URI with which the other end opens a link; on a serial line only its form, since the device name there differs.

    Raises LinkUriError.
    """
    return f"{scheme_of(text).counterpart}://{text.partition('://')[2]}"


def _parse_serial(text: str, rest: str) -> LinkUri:
    path, _, baud = rest.rpartition(":")  # the last colon: names under /dev/serial/by-path contain colons themselves
    if not path.startswith("/"):
        raise _bad(text, "it must name a device by its full path, then ':' and the baud rate", _PROPOSED_SERIAL)
    if not _is_number(baud) or int(baud) == 0:
        raise _bad(text, f"the baud rate {baud!r} is not a positive whole number", _PROPOSED_SERIAL)
    return LinkUri(text, "serial", path=path, baud=int(baud))


def _parse_network(text: str, scheme: str, rest: str) -> LinkUri:
    proposed = LINKS[scheme].port
    parts = _HOST_AND_PORT.fullmatch(rest)
    if parts is None:
        reason = "it must be a host, ':' and a port, with an IPv6 address in brackets"
        raise _bad(text, reason, f"{scheme}://{_DEFAULT_HOST}:{proposed} or {scheme}://[::1]:{proposed}")
    host = parts["ipv6"] or parts["host"] or _DEFAULT_HOST
    example = f"{scheme}://{join_address(host, proposed)}"
    port = parts["port"]
    if not port:
        raise _bad(text, "the port is missing", example)
    if not _is_number(port) or len(port) > _LARGEST_PORT_DIGITS or int(port) > _LARGEST_PORT:
        raise _bad(text, f"the port {port!r} is not a whole number up to {_LARGEST_PORT}", example)
    if int(port) == 0 and not LINKS[scheme].waits:
        raise _bad(text, "port 0 (the system chooses) is allowed only on a link that waits for its peer", example)
    return LinkUri(text, scheme, host=host, port=int(port))


def join_address(host: str, port: int) -> str:
    """Return "host:port", an IPv6 address in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit()


def _bad(text: str, reason: str, example: str) -> LinkUriError:
    return LinkUriError(f"{text!r} is not a link URI: {reason}; write for example {example}")
