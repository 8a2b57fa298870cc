"""The bus by URI: two ends on each interface there is, and an interface that fails."""

from __future__ import annotations

import itertools
import socket
from collections import deque
from collections.abc import Iterator
from typing import Any

import can
import pytest

from bridge.motor_bus.can_bus import CanBus, CanUri, parse_can_uri
from bridge.timing.clock import VirtualClock
from protocol.can_frame import CanFrame
from protocol.errors import CanBusLostError, LinkClosedError, LinkError, LinkUriError
from tests.multicast import skip_without_multicast

PATIENCE_S = 10.0
FRAMES = [
    CanFrame(0x123, b"\x01\x02"),
    CanFrame(0x7FF),
    CanFrame(0x1ABCDEF0, bytes(8), extended=True),
    CanFrame(0x2A1, remote=True),
]
_names = itertools.count()


def free_group() -> str:
    """A multicast URI with a port that nobody on this machine uses; the test is skipped where there is no multicast."""
    skip_without_multicast()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return f"udp_multicast:239.74.163.2:{probe.getsockname()[1]}"


@pytest.fixture(params=["virtual", "udp_multicast"])
def uri(request: pytest.FixtureRequest) -> str:
    return free_group() if request.param == "udp_multicast" else f"virtual:test{next(_names)}"


@pytest.fixture
def pair(uri: str) -> Iterator[tuple[CanBus, CanBus]]:
    with CanBus(uri, 1_000_000) as near, CanBus(uri, 1_000_000) as far:
        yield near, far


def test_frames_of_every_kind_arrive_in_order_both_ways(pair: tuple[CanBus, CanBus]) -> None:
    for sender, receiver in (pair, pair[::-1]):
        for frame in FRAMES:
            sender.send(frame)
        assert [receiver.recv(PATIENCE_S) for _ in FRAMES] == FRAMES
        assert receiver.recv(0.0) is None
    for bus in pair:
        assert (bus.counters["can_sent"], bus.counters["can_received"]) == (len(FRAMES), len(FRAMES))


def test_nobody_hears_itself(pair: tuple[CanBus, CanBus]) -> None:
    near, far = pair
    for frame in FRAMES * 10:
        near.send(frame)
    far.send(CanFrame(0x77))
    assert near.recv(PATIENCE_S) == CanFrame(0x77)
    assert near.recv(0.02) is None


def test_python_cans_own_bus_hears_and_is_heard(uri: str) -> None:
    parts = parse_can_uri(uri)
    arguments: dict[str, Any] = {"port": parts.port, "hop_limit": 0} if parts.interface == "udp_multicast" else {}
    with (
        CanBus(uri, 1_000_000) as ours,
        can.Bus(interface=parts.interface, channel=parts.channel, **arguments) as theirs,
    ):
        ours.send(FRAMES[2])
        message: Any = theirs.recv(PATIENCE_S)
        assert (message.arbitration_id, bytes(message.data), message.is_extended_id) == (0x1ABCDEF0, bytes(8), True)
        theirs.send(can.Message(arbitration_id=5, data=bytes(12), is_fd=True, is_extended_id=False))
        theirs.send(can.Message(arbitration_id=6, data=b"x", is_extended_id=False))
        assert ours.recv(PATIENCE_S) == CanFrame(6, b"x")
        assert ours.counters["can_fd_frames"] == 1


def test_bytes_of_a_stranger_on_the_port_are_counted() -> None:
    uri = free_group()
    with CanBus(uri, 1_000_000) as bus, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        stranger.sendto(b"not a frame", ("239.74.163.2", parse_can_uri(uri).port))
        with CanBus(uri, 1_000_000) as other:
            other.send(FRAMES[0])
            assert bus.recv(PATIENCE_S) == FRAMES[0]
        assert bus.counters["can_bad_frames"] == 1


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("udp_multicast:239.74.163.2", ("udp_multicast", "239.74.163.2", 43113, 0)),
        ("udp_multicast:239.0.0.9:5000?hop_limit=2", ("udp_multicast", "239.0.0.9", 5000, 2)),
        ("udp_multicast:[ff15:7079:7468::1]:5000", ("udp_multicast", "ff15:7079:7468::1", 5000, 0)),
        ("virtual:motors", ("virtual", "motors", 43113, 0)),
        ("socketcan:can0", ("socketcan", "can0", 43113, 0)),
        ("slcan:/dev/ttyACM0@115200", ("slcan", "/dev/ttyACM0@115200", 43113, 0)),
    ],
)
def test_uris_are_read(text: str, parts: tuple[str, str, int, int]) -> None:
    assert parse_can_uri(text) == CanUri(text, *parts)


@pytest.mark.parametrize(
    "text",
    ["", "can0", "pcan:PCAN_USBBUS1", "virtual:", "socketcan: can0", "udp_multicast:", "udp_multicast:239.0.0.1:0",
     "udp_multicast:239.0.0.1:70000", "udp_multicast:group", "udp_multicast:239.0.0.1?hop_limit=256"],
)  # fmt: skip
def test_what_names_no_bus_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(LinkUriError, match=r"is not a CAN bus URI: .*write for example [a-z_]+:"):
        CanBus(text, 1_000_000)


@pytest.mark.parametrize("uri", ["socketcan:nosuchcan0", "slcan:/dev/nosuchtty", "udp_multicast:10.0.0.1"])
def test_an_interface_that_is_not_there_is_one_sentence(uri: str) -> None:
    with pytest.raises(LinkError, match=f"cannot open the CAN bus {uri}: .*choose another") as caught:
        CanBus(uri, 1_000_000)
    assert "\n" not in str(caught.value)


def test_use_after_close_is_an_error() -> None:
    bus = CanBus("virtual:closed", 1_000_000)
    bus.close()
    bus.close()
    with pytest.raises(LinkClosedError):
        bus.recv(0.0)
    with pytest.raises(LinkClosedError):
        bus.send(FRAMES[0])


class _Failing:
    """Stands for python-can's bus: gives what it is told to, and may fail."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.coming: deque[Any] = deque()
        self.sent: list[can.Message] = []
        self.down = False
        self.shut = 0

    def recv(self, timeout: float) -> Any:
        self._check()
        if self.coming:
            return self.coming.popleft()
        self.clock.advance_ns(round(timeout * 1e9))
        return None

    def send(self, message: can.Message) -> None:
        self._check()
        self.sent.append(message)

    def _check(self) -> None:
        if self.down:
            raise can.CanOperationError("no") from OSError(100, "Network is down")

    def shutdown(self) -> None:
        self.shut += 1


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> _Failing:
    interface = _Failing()

    def open_it(**_: Any) -> _Failing:
        interface._check()
        return interface

    monkeypatch.setattr(can, "Bus", open_it)
    return interface


def test_a_lost_interface_is_reopened(failing: _Failing) -> None:
    clock = failing.clock
    bus = CanBus("socketcan:can0", 1_000_000, clock)
    failing.down = True
    bus.send(FRAMES[0])
    assert (bus.counters["can_lost"], bus.counters["can_send_failed"], failing.shut) == (1, 1, 1)
    assert bus.recv(1.2) is None  # it waits, and tries twice
    assert clock.now_ns() == 1_200_000_000
    failing.down = False
    assert bus.recv(0.5) is None
    assert bus.counters["can_reopened"] == 1
    bus.send(FRAMES[0])
    assert len(failing.sent) == 1
    assert bus.counters["can_lost"] == 1


def test_an_interface_that_stays_away_is_a_named_error(failing: _Failing) -> None:
    bus = CanBus("socketcan:can0", 1_000_000, failing.clock)
    failing.down = True
    with pytest.raises(CanBusLostError, match=r"socketcan:can0 was lost .* Network is down"):
        for _ in range(20):
            bus.recv(1.0)


def test_bus_off_is_told_from_other_errors_and_mended(failing: _Failing) -> None:
    bus = CanBus("socketcan:can0", 1_000_000, failing.clock)
    failing.coming += [
        can.Message(arbitration_id=0x04, is_error_frame=True),
        can.Message(arbitration_id=0x40, is_error_frame=True),
    ]
    assert bus.recv(0.0) is None
    assert bus.recv(0.0) is None
    assert (bus.counters["can_error_frames"], bus.counters["can_bus_off"], bus.counters["can_lost"]) == (2, 1, 0)
    failing.coming.append(can.Message(arbitration_id=0x123, data=b"\x01\x02", is_extended_id=False))
    assert bus.recv(1.0) == FRAMES[0]
    assert bus.counters["can_reopened"] == 1


def test_what_is_not_for_us_does_not_hold_up_the_end_of_a_wait(
    failing: _Failing, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stranger that says something all the time must not keep the emulator from its resends, or from Ctrl-C."""

    def talk(timeout: float) -> can.Message:
        failing.clock.advance_ns(min(round(timeout * 1e9), 4_000_000))
        return can.Message(arbitration_id=5, is_fd=True, is_extended_id=False)

    bus = CanBus("socketcan:can0", 1_000_000, failing.clock)
    monkeypatch.setattr(failing, "recv", talk)
    assert bus.recv(0.01) is None
    assert failing.clock.now_ns() == 10_000_000


def test_a_full_send_queue_loses_the_frame_and_not_the_bus(failing: _Failing, monkeypatch: pytest.MonkeyPatch) -> None:
    bus = CanBus("socketcan:can0", 1_000_000, failing.clock)

    def full(_message: can.Message) -> None:
        raise can.CanTimeoutError("full")

    monkeypatch.setattr(failing, "send", full)
    bus.send(FRAMES[0])
    assert (bus.counters["can_send_failed"], bus.counters["can_lost"], failing.shut) == (1, 0, 0)
