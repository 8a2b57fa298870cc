"""A CAN bus by URI, over python-can: frames in, frames out, everything counted, reopened when it goes away.

    udp_multicast:239.74.163.2             between processes of this machine; :PORT and ?hop_limit=N may follow
    virtual:name                           inside this process
    socketcan:can0                         the kernel's (its bit rate is set there)
    slcan:/dev/ttyACM0                     a serial adapter

Multicast never leaves the host unless ?hop_limit= says so. On it every sender hears itself: what comes back just as it was
sent is dropped. Only classical frames are spoken.
"""

from __future__ import annotations

import re
from collections import deque
from typing import Any, Final, NamedTuple

import can

from bridge.timing.clock import Clock, MonotonicClock
from protocol.can_frame import CanFrame
from protocol.errors import CanBusLostError, LinkClosedError, LinkError, LinkUriError

DEFAULT_PORT: Final = 43113
REOPEN_PERIOD_NS: Final = 500_000_000
LOST_AFTER_NS: Final = 10_000_000_000
"""An interface that could not be reopened for this long is given up."""

_BUS_OFF = 0x40  # CAN_ERR_BUSOFF in the identifier of an error frame (linux/can/error.h)
_ECHOES = 256
_MOST_LOOKS = 1000
"""In one receive whose time is up, for something that is for the caller."""
_EXAMPLES: Final = {
    "udp_multicast": "udp_multicast:239.74.163.2",
    "virtual": "virtual:motors",
    "socketcan": "socketcan:can0",
    "slcan": "slcan:/dev/ttyACM0",
}


class CanUri(NamedTuple):
    """A bus URI in its parts, as python-can takes them."""

    text: str
    interface: str
    channel: str
    port: int = DEFAULT_PORT
    hop_limit: int = 0


def parse_can_uri(text: str) -> CanUri:
    """Take a bus URI apart without opening anything. Raises LinkUriError, which shows one that is right."""
    interface, _, rest = text.partition(":")
    if interface not in _EXAMPLES:
        raise LinkUriError(f"{text!r} names no CAN bus: write for example {', '.join(_EXAMPLES.values())}")
    example = _EXAMPLES[interface]
    if interface != "udp_multicast":
        if not rest or any(character.isspace() for character in rest):
            raise LinkUriError(f"{text!r} names no CAN bus: the channel is missing; write for example {example}")
        return CanUri(text, interface, rest)
    parts = re.fullmatch(
        r"(?P<group>[0-9.]+|\[[0-9a-fA-F:]+\])(:(?P<port>\d{1,5}))?(\?hop_limit=(?P<hops>\d{1,3}))?", rest
    )
    if parts is None or int(parts["port"] or 1) not in range(1, 65536) or int(parts["hops"] or 0) > 255:
        raise LinkUriError(
            f"{text!r} names no CAN bus: it must be a multicast group, then a port and a hop limit if need be; "
            f"write for example {example} or {example}:{DEFAULT_PORT}?hop_limit=1"
        )
    return CanUri(
        text, interface, parts["group"].strip("[]"), int(parts["port"] or DEFAULT_PORT), int(parts["hops"] or 0)
    )


class CanBus:
    """One participant of a bus. One thread uses it.

    counters   can_sent, can_received        frames
               can_send_failed               frames dropped because the interface refused them or is away
               can_bad_frames                what came and was no frame: bytes of somebody else on the multicast port
               can_fd_frames                 frames of CAN FD, which is not spoken here
               can_error_frames              reported by the interface
               can_bus_off, can_lost         times the interface went bus-off, or away
               can_reopened                  times it came back
    """

    def __init__(self, uri: str, bitrate: int, clock: Clock | None = None) -> None:
        """Open the bus. Raises LinkUriError, LinkError."""
        self.uri = parse_can_uri(uri)
        self._bitrate = bitrate
        self._clock = clock or MonotonicClock()
        self._echoes: deque[CanFrame] | None = deque(maxlen=_ECHOES) if self.uri.interface == "udp_multicast" else None
        self._lost_ns: int | None = None
        self._reopen_ns = 0
        self._closed = False
        self._why = ""
        names = (
            "sent",
            "received",
            "send_failed",
            "bad_frames",
            "fd_frames",
            "error_frames",
            "bus_off",
            "lost",
            "reopened",
        )
        self.counters = dict.fromkeys((f"can_{name}" for name in names), 0)
        try:
            self._bus: Any = self._open()
        except (can.CanError, OSError, ImportError, ValueError) as error:
            raise LinkError(
                f"cannot open the CAN bus {uri}: {_reason(error)}; see that it exists, or choose another"
            ) from None

    @property
    def trouble(self) -> str:
        """Why the interface is away just now; empty where it is not."""
        return "" if self._lost_ns is None else self._why

    def _open(self) -> Any:
        uri = self.uri
        arguments: dict[str, Any] = {"interface": uri.interface, "channel": uri.channel}
        if uri.interface == "udp_multicast":
            arguments |= {"port": uri.port, "hop_limit": uri.hop_limit}
        elif uri.interface == "slcan":
            arguments["bitrate"] = self._bitrate
        return can.Bus(**arguments, ignore_config=True)

    def send(self, frame: CanFrame) -> None:
        """Put a frame on the bus; dropped and counted while the interface is away. Raises LinkClosedError, CanBusLostError."""
        if self._away():
            self.counters["can_send_failed"] += 1
            return
        message = can.Message(
            arbitration_id=frame.can_id, data=frame.data, is_extended_id=frame.extended, is_remote_frame=frame.remote
        )
        try:
            self._bus.send(message)
        except (can.CanError, OSError) as error:
            self.counters["can_send_failed"] += 1
            if not isinstance(error, can.CanTimeoutError):  # a full queue empties again
                self._lose(error, "can_lost")
            return
        self.counters["can_sent"] += 1
        if self._echoes is not None:
            self._echoes.append(frame)

    def recv(self, timeout_s: float) -> CanFrame | None:
        """The next frame of somebody else, None where none came within timeout_s. Raises LinkClosedError, CanBusLostError."""
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while True:
            if self._away():
                self._clock.sleep_until_ns(min(deadline_ns, self._reopen_ns))
            else:
                frame = self._receive(deadline_ns)
                if frame is not None:
                    return frame
            if self._clock.now_ns() >= deadline_ns:
                return None

    def _receive(self, deadline_ns: int) -> CanFrame | None:
        """The next frame that is for the caller; None where none came in time, or the interface had something to report."""
        looks = 0
        while True:
            remaining_ns = max(0, deadline_ns - self._clock.now_ns())
            looks += 1
            if looks > _MOST_LOOKS and not remaining_ns:
                return None
            try:
                message = self._bus.recv(remaining_ns * 1e-9)
            except (can.CanError, OSError) as error:
                cause = error.__cause__
                if cause is None or isinstance(cause, OSError):
                    self._lose(error, "can_lost")
                    return None
                self.counters["can_bad_frames"] += 1  # a datagram that is none of python-can's
                continue
            if message is None:
                return None
            if message.is_error_frame:
                self.counters["can_error_frames"] += 1
                if message.arbitration_id & _BUS_OFF:
                    self._lose(LinkError("the controller went bus-off"), "can_bus_off")
                return None
            if message.is_fd:
                self.counters["can_fd_frames"] += 1
                continue
            data = b"" if message.is_remote_frame else bytes(message.data)
            frame = CanFrame(message.arbitration_id, data, message.is_extended_id, message.is_remote_frame)
            if self._echoes and self._is_echo(frame):
                continue
            self.counters["can_received"] += 1
            return frame

    def _is_echo(self, frame: CanFrame) -> bool:
        """Whether a frame is one of ours come back; the ones before it, which then were lost, are forgotten."""
        echoes = self._echoes
        if not echoes or frame not in echoes:
            return False
        while echoes.popleft() != frame:
            pass
        return True

    def _away(self) -> bool:
        """Whether the interface is away; tries now and then to open it again."""
        if self._closed:
            raise LinkClosedError(f"{self.uri.text} is closed on this end")
        if self._lost_ns is None:
            return False
        now_ns = self._clock.now_ns()
        if now_ns < self._reopen_ns:
            return True
        try:
            self._bus = self._open()
        except (can.CanError, OSError) as error:
            self._why = _reason(error)
            if now_ns - self._lost_ns > LOST_AFTER_NS:
                raise CanBusLostError(
                    f"the CAN bus {self.uri.text} was lost and did not come back within "
                    f"{LOST_AFTER_NS // 1_000_000_000} s: {self._why}; see the interface and its cable"
                ) from None
            self._reopen_ns = now_ns + REOPEN_PERIOD_NS
            return True
        self._lost_ns = None
        self.counters["can_reopened"] += 1
        return False

    def _lose(self, error: Exception, counter: str) -> None:
        self.counters[counter] += 1
        self._why = _reason(error)
        self._lost_ns = self._clock.now_ns()
        self._reopen_ns = self._lost_ns + REOPEN_PERIOD_NS
        self._shut()

    def _shut(self) -> None:
        try:
            self._bus.shutdown()
        except (can.CanError, OSError):
            return  # it is gone; what it held goes with it

    def close(self) -> None:
        """Let go of the interface; calling it again does nothing."""
        if not self._closed:
            self._closed = True
            if self._lost_ns is None:
                self._shut()

    def __enter__(self) -> CanBus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _reason(error: BaseException) -> str:
    """What the system said, in one line."""
    cause = error.__cause__ or error
    text = getattr(cause, "strerror", None) or str(cause)
    return " ".join(text.split())
