"""A ground station's link: heard without waiting, never in the way, and recorded."""

from __future__ import annotations

from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common

from bridge.links.link import open_link
from bridge.links.memory import memory_pair
from bridge.links.tcp import TcpIn
from bridge.process import StopFlag
from bridge.station import Station, open_station
from bridge.timing.clock import VirtualClock
from protocol.errors import LinkUriError
from protocol.logs.tlog import TlogWriter, read_tlog
from protocol.wire import mapping
from protocol.wire.codec import FrameReader, FrameWriter

WHO = (1, 191)


def heartbeat() -> bytes:
    return mapping.encode_emulator_heartbeat()


def names(data: bytes | None) -> list[str]:
    return [message.get_type() for message in common.MAVLink(None).parse_buffer(data or b"") or []]


def test_a_heartbeat_a_second_of_the_wall_clock() -> None:
    near, far = memory_pair()
    clock = VirtualClock()
    station = Station(near, WHO, clock, heartbeat)
    heard = []
    for _ in range(25):
        assert station.poll() == []
        heard += names(far.recv(0.0))
        clock.advance_ns(100_000_000)
    assert heard == ["HEARTBEAT"] * 3


def test_what_is_said_both_ways_is_recorded_under_the_time_given(tmp_path: Path) -> None:
    near, far = memory_pair()
    log = TlogWriter(tmp_path / "station.tlog")
    station = Station(near, WHO, VirtualClock(), heartbeat, log)
    far.send(FrameWriter(255, 190).seal(mapping.HEARTBEAT, heartbeat()))
    station.t_us = 1_234
    (frame,) = station.poll()
    assert (frame.system, frame.component) == (255, 190)
    station.t_us = 5_678
    station.say(mapping.COMMAND_ACK, mapping.COMMAND_ACK.pack_fields(command=511))
    log.close()
    kept = [(t_us, frame.system, frame.message_id) for t_us, frame in read_tlog(tmp_path / "station.tlog")]
    assert kept == [(1_234, 1, 0), (1_234, 255, 0), (5_678, 1, 77)]


def test_a_station_that_leaves_is_no_matter_and_another_may_come() -> None:
    with open_link("tcpin://127.0.0.1:0") as near:
        assert isinstance(near, TcpIn)
        station = Station(near, WHO, VirtualClock(), heartbeat)
        for _ in range(2):
            with open_link(f"tcpout://127.0.0.1:{near.port}") as far:
                far.send(FrameWriter(255, 190).seal(mapping.HEARTBEAT, heartbeat()))
                while not station.poll():
                    near._wait(0.1, readable=(near._listener.fileno(),))
                station.say(mapping.COMMAND_ACK, b"\1")
                reader = FrameReader(is_datagram=False)
                assert [f.message_id for f in reader.read(far.recv(5.0) or b"")][-1:] == [77]
            for _ in range(50):
                station.poll()
                station.say(mapping.COMMAND_ACK, b"\1")


def test_no_link_is_no_station_and_a_wrong_one_is_said() -> None:
    with open_station(None, WHO, heartbeat, None, 1.0, StopFlag()) as station:
        assert station is None
    with pytest.raises(LinkUriError), open_station("nowhere", WHO, heartbeat, None, 1.0, StopFlag()):
        pass


def test_the_folder_of_the_record_is_made(tmp_path: Path) -> None:
    record = tmp_path / "new" / "station.tlog"
    with open_station("udpin://127.0.0.1:0", WHO, heartbeat, record, 1.0, StopFlag()) as station:
        assert station is not None
        station.poll()
    assert [frame.message_id for _, frame in read_tlog(record)] == [0]


def test_the_counters_are_the_links_and_the_readers() -> None:
    near, far = memory_pair()
    station = Station(near, WHO, VirtualClock(), heartbeat)
    far.send(b"rubbish")
    station.poll()
    counters = station.counters()
    assert counters["station_garbage_bytes"] == 7
    assert counters["station_sent"] == 1
