"""The tap: asked for, renewed, stopped; and `dronecan`'s own mavcan driver sees the drives through it."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator
from typing import Any

import dronecan
import pytest
from dronecan.driver.mavcan import MAVCAN
from pymavlink.dialects.v20 import common

from bridge.links.link import Link, counterpart, open_link, parse_link_uri
from bridge.links.memory import memory_pair
from bridge.links.udp import UdpIn
from bridge.motor_bus.can_bus import CanBus
from bridge.motor_bus.can_tap import CanTap
from bridge.timing.clock import MonotonicClock, VirtualClock
from plant_emulator.drives.motor_process import MotorThread
from protocol.can_frame import CanFrame
from protocol.errors import LinkError
from protocol.wire.codec import FrameReader, FrameWriter, layout
from tests.contracts.link_contract import PATIENCE_S
from tests.plant_emulator.drives.test_motor import with_motor

FRAMES = [
    CanFrame(0x123, b"\x01\x02"),
    CanFrame(0x1ABCDEF0, bytes(range(8)), extended=True),
    CanFrame(0x7FF, remote=True),
    CanFrame(0x55, b""),
]
COMMAND_LONG, CAN_FRAME, COMMAND_ACK = layout("COMMAND_LONG"), layout("CAN_FRAME"), layout("COMMAND_ACK")
_names = itertools.count()


class Station:
    """A MAVLink station at the other end of the tap's link, made of the dialect alone."""

    def __init__(self) -> None:
        near, self.link = memory_pair()
        self.near: Link = near
        self.clock = VirtualClock()
        self.tap = CanTap(near, 191, self.clock)
        self._writer, self._reader = FrameWriter(250, 1), FrameReader(is_datagram=True, follow_sequence=False)

    def forward(self, bus: float, command: int = common.MAV_CMD_CAN_FORWARD) -> None:
        self.link.send(self._writer.seal(COMMAND_LONG, COMMAND_LONG.pack_fields(command=command, param1=bus)))

    def send(self, **fields: Any) -> None:
        self.link.send(self._writer.seal(CAN_FRAME, CAN_FRAME.pack_fields(**fields)))

    def hear(self, message: Any) -> list[dict[str, Any]]:
        heard = []
        while data := self.link.recv(0.0):
            heard += [f.payload for f in self._reader.read(data) if f.message_id == message.message_id]
        return [message.unpack_fields(payload) for payload in heard]


@pytest.fixture
def station() -> Iterator[Station]:
    one = Station()
    yield one
    one.link.close()
    one.near.close()


def test_nothing_is_shown_unless_it_is_asked_for(station: Station) -> None:
    station.tap.watch(0, FRAMES[0])
    assert station.hear(CAN_FRAME) == []
    station.send(id=1, len=0)
    assert station.tap.poll() == []
    assert station.tap.counters["tap_refused"] == 1


def test_frames_are_shown_as_the_message_set_says(station: Station) -> None:
    station.forward(1)
    station.tap.poll()
    (acknowledged,) = station.hear(COMMAND_ACK)
    assert (acknowledged["command"], acknowledged["result"]) == (32000, common.MAV_RESULT_ACCEPTED)
    for frame in FRAMES:
        station.tap.watch(0, frame)
    shown = station.hear(CAN_FRAME)
    assert [one["id"] for one in shown] == [0x123, 0x1ABCDEF0 | 1 << 31, 0x7FF | 1 << 30, 0x55]
    assert [bytes(one["data"][: one["len"]]) for one in shown] == [frame.data for frame in FRAMES]
    assert all(one["bus"] == 0 for one in shown)


def test_it_stops_five_seconds_after_the_last_renewal(station: Station) -> None:
    station.forward(1)
    station.tap.poll()
    station.clock.advance_ns(4_900_000_000)
    station.forward(1)
    station.tap.poll()
    station.clock.advance_ns(4_999_000_000)
    assert station.tap.forwarding
    station.clock.advance_ns(1_000_000)
    assert not station.tap.forwarding
    station.tap.watch(0, FRAMES[0])
    assert station.hear(CAN_FRAME) == []


def test_zero_ends_it_at_once(station: Station) -> None:
    station.forward(1)
    station.forward(0)
    station.tap.poll()
    assert not station.tap.forwarding


def test_the_stations_frames_are_for_the_bus_and_do_not_come_back(station: Station) -> None:
    station.forward(1)
    station.send(id=0x1ABCDEF0 | 1 << 31, len=3, data=[1, 2, 3], bus=0)
    taken = station.tap.poll()
    assert taken == [CanFrame(0x1ABCDEF0, b"\x01\x02\x03", extended=True)]
    station.hear(CAN_FRAME)
    station.tap.watch(0, taken[0])
    assert station.hear(CAN_FRAME) == []
    station.tap.watch(0, taken[0])  # said again by somebody else
    assert len(station.hear(CAN_FRAME)) == 1


@pytest.mark.parametrize("bad", [{"bus": 1}, {"len": 9}, {"id": 0x800}])
def test_what_is_no_frame_for_this_bus_is_refused(station: Station, bad: dict[str, int]) -> None:
    station.forward(1)
    station.send(**({"id": 1, "len": 1} | bad))
    assert station.tap.poll() == []
    assert station.tap.counters["tap_refused"] == 1


@pytest.mark.parametrize(("bus", "command"), [(2, 32000), (float("nan"), 32000), (1, 400)])
def test_other_requests_are_refused(station: Station, bus: float, command: int) -> None:
    station.forward(bus, command)
    station.tap.poll()
    assert not station.tap.forwarding
    assert station.tap.counters["tap_refused"] == 1


def test_a_station_that_left_is_no_matter(station: Station) -> None:
    station.forward(1)
    station.tap.poll()
    station.link.close()
    station.tap.watch(0, FRAMES[0])
    assert station.tap.poll() == []


@pytest.mark.parametrize("scheme", ["udp", "tcp"])
def test_when_a_station_has_left_another_may_come(scheme: str) -> None:
    """One that starts again has another port: it must not have to wait for the end of the run."""
    clock = VirtualClock()
    request = FrameWriter(250, 1).seal(COMMAND_LONG, COMMAND_LONG.pack_fields(command=32000, param1=1.0))
    with open_link(f"{scheme}in://127.0.0.1:0") as link:
        tap = CanTap(link, 191, clock)
        for _ in range(2):
            with open_link(counterpart(link.uri)) as station:
                station.send(request)
                while not tap.forwarding:
                    tap.poll()
                assert station.recv(PATIENCE_S), "the acknowledgement"
            clock.advance_ns(6_000_000_000)
            tap.poll()
        assert tap.counters["tap_requests"] == 2


def test_a_station_that_takes_nothing_does_not_end_the_flight(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_data: bytes) -> None:
        raise LinkError("tcpin://: took 0 of 40 bytes in 1 s")

    station.forward(1)
    station.tap.poll()
    monkeypatch.setattr(station.near, "send", refuse)
    station.tap.watch(0, FRAMES[0])
    assert not station.tap.forwarding


def test_dronecans_mavcan_driver_sees_the_drives_through_it() -> None:
    """Its own process asks over UDP; a node of the library behind it hears six ESCs and is told who they are."""
    scenario = with_motor(protocol="dronecan")
    uri = f"virtual:tap{next(_names)}"
    clock = MonotonicClock()
    with (
        UdpIn(parse_link_uri("udpin://127.0.0.1:0")) as link,
        CanBus(uri, 1_000_000) as bus,
        MotorThread(scenario, "dronecan", uri),
    ):
        tap = CanTap(link, 191, clock)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the library starts a process of its own by fork
            driver = MAVCAN(f"udpout:127.0.0.1:{link.port}")
        try:
            node = dronecan.node.Node(driver, node_id=100, catch_handler_exceptions=False)
            seen: set[int] = set()
            escs: set[int] = set()
            names: list[str] = []
            node.add_handler(dronecan.uavcan.protocol.NodeStatus, lambda e: seen.add(e.transfer.source_node_id))
            node.add_handler(dronecan.uavcan.equipment.esc.Status, lambda e: escs.add(e.message.esc_index))
            node.request(
                dronecan.uavcan.protocol.GetNodeInfo.Request(), 22,
                lambda e: names.append(str(e.response.name)) if e else None, timeout=30.0,
            )  # fmt: skip
            give_up_ns = clock.now_ns() + 30_000_000_000
            while clock.now_ns() < give_up_ns and not (
                len(seen & set(range(21, 27))) == 6 and len(escs) == 6 and names
            ):
                frame = bus.recv(0.001)
                while frame is not None:
                    tap.watch(0, frame)
                    frame = bus.recv(0.0)
                for theirs in tap.poll():
                    bus.send(theirs)
                node.spin(0)
        finally:
            driver.close()
    assert seen >= set(range(21, 27))
    assert escs == {0, 1, 2, 3, 4, 5}
    assert names == ["fwav-hil.drive.y"]
