"""A CAN bus by URI, over python-can: sends and receives frames with counters, and reopens a lost interface.

    udp_multicast:239.74.163.2             between processes of this machine; :PORT and ?hop_limit=N may follow
    virtual:name                           inside this process
    socketcan:can0                         the kernel's (its bit rate is set there)
    slcan:/dev/ttyACM0                     a serial adapter

Multicast leaves the host only with ?hop_limit=. On multicast each sender also receives its own frames: these echoes are
dropped. Only classical frames are supported.
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
"""An interface that could not be reopened for this long is an error."""

_BUS_OFF = 0x40  # CAN_ERR_BUSOFF in the identifier of an error frame (linux/can/error.h)
_ECHOES = 256
_MOST_LOOKS = 1000
"""Frames that one receive looks at after its timeout, searching for one to return."""
_EXAMPLES: Final = {
    "udp_multicast": "udp_multicast:239.74.163.2",
    "virtual": "virtual:motors",
    "socketcan": "socketcan:can0",
    "slcan": "slcan:/dev/ttyACM0",
}


class CanUri(NamedTuple):
    """The parts of a bus URI, as python-can takes them."""

    text: str
    interface: str
    channel: str
    port: int = DEFAULT_PORT
    hop_limit: int = 0


def parse_can_uri(text: str) -> CanUri:
    """Parse a bus URI without opening anything. Raises LinkUriError, which shows a valid one."""
    interface, _, rest = text.partition(":")
    if interface not in _EXAMPLES:
        raise LinkUriError(f"{text!r} is not a CAN bus URI: write for example {', '.join(_EXAMPLES.values())}")
    example = _EXAMPLES[interface]
    if interface != "udp_multicast":
        if not rest or any(character.isspace() for character in rest):
            raise LinkUriError(f"{text!r} is not a CAN bus URI: the channel is missing; write for example {example}")
        return CanUri(text, interface, rest)
    parts = re.fullmatch(
        r"(?P<group>[0-9.]+|\[[0-9a-fA-F:]+\])(:(?P<port>\d{1,5}))?(\?hop_limit=(?P<hops>\d{1,3}))?", rest
    )
    if parts is None or int(parts["port"] or 1) not in range(1, 65536) or int(parts["hops"] or 0) > 255:
        raise LinkUriError(
            f"{text!r} is not a CAN bus URI: it must be a multicast group, with an optional port and hop limit; "
            f"write for example {example} or {example}:{DEFAULT_PORT}?hop_limit=1"
        )
    return CanUri(
        text, interface, parts["group"].strip("[]"), int(parts["port"] or DEFAULT_PORT), int(parts["hops"] or 0)
    )


class CanBus:
    """One node on a bus, for use by one thread.

    counters   can_sent, can_received        frames
               can_send_failed               frames dropped because the interface refused them or is lost
               can_bad_frames                received data that is not a CAN frame, such as foreign multicast datagrams
               can_fd_frames                 frames of CAN FD, which is not supported
               can_error_frames              reported by the interface
               can_bus_off, can_lost         times the interface went bus-off, or was lost
               can_reopened                  times it was reopened
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
                f"cannot open the CAN bus {uri}: {_reason(error)}; check that it exists, or choose another"
            ) from None

    @property
    def trouble(self) -> str:
        """Why the interface is lost now; empty where it works."""
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
        """Send a frame; dropped and counted while the interface is lost. Raises LinkClosedError, CanBusLostError."""
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
            if not isinstance(error, can.CanTimeoutError):  # a full queue is temporary
                self._lose(error, "can_lost")
            return
        self.counters["can_sent"] += 1
        if self._echoes is not None:
            self._echoes.append(frame)

    def recv(self, timeout_s: float) -> CanFrame | None:
        """The next frame of another node, None after timeout_s without one. Raises LinkClosedError, CanBusLostError."""
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
        """The next frame to return to the caller; None at the deadline, or where the interface reported an error."""
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
                self.counters["can_bad_frames"] += 1  # a datagram that python-can did not send
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
        """Whether a frame is the echo of one that we sent; earlier ones, whose echoes were lost, are forgotten."""
        echoes = self._echoes
        if not echoes or frame not in echoes:
            return False
        while echoes.popleft() != frame:
            pass
        return True

    def _away(self) -> bool:
        """Whether the interface is lost; tries to reopen it every REOPEN_PERIOD_NS."""
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
                    f"the CAN bus {self.uri.text} was lost and could not be reopened within "
                    f"{LOST_AFTER_NS // 1_000_000_000} s: {self._why}; check the interface and its cable"
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
            return  # it is lost already

    def close(self) -> None:
        """Release the interface; calling it again does nothing."""
        if not self._closed:
            self._closed = True
            if self._lost_ns is None:
                self._shut()

    def __enter__(self) -> CanBus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _reason(error: BaseException) -> str:
    """The system's error message, in one line."""
    cause = error.__cause__ or error
    text = getattr(cause, "strerror", None) or str(cause)
    return " ".join(text.split())
