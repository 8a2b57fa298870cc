"""Ground truth on request, on the loop's link and a station's, in both clock modes; and no law is the wiser for it."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge.links.link import open_link
from bridge.links.memory import memory_pair
from bridge.shared_options import ClockMode
from plant_emulator.options import MotorLink
from plant_emulator.plant.truth import load_truth
from protocol.logs.tlog import read_tlog
from protocol.wire import mapping
from protocol.wire.codec import layout
from tests.loop import fly_both, scenario_of
from tests.plant_emulator.pacing.test_lockstep import Faulty
from tests.station import Watcher, request

SHORT = scenario_of("flapper", duration_s=0.4)
STATE, ODOMETRY = layout("HIL_STATE_QUATERNION"), layout("ODOMETRY")
_names = itertools.count()


def frames_of(log: Path, message: Any) -> list[dict[str, Any]]:
    return [message.unpack_fields(f.payload) for _, f in read_tlog(log) if f.message_id == message.message_id]


def test_truth_from_the_start_is_in_the_log_and_equals_the_ground_truth(tmp_path: Path) -> None:
    near, far = memory_pair()
    with near, far:
        ends = fly_both(SHORT, near, far, tmp_path, truth_hz=50.0)
    assert isinstance(ends.emulator, dict), ends
    truth = load_truth(tmp_path / "ground_truth.npy")
    states, poses = frames_of(tmp_path / "run.tlog", STATE), frames_of(tmp_path / "run.tlog", ODOMETRY)
    assert (
        [one["time_usec"] for one in states] == [one["time_usec"] for one in poses] == list(range(0, 400_000, 20_000))
    )
    rows = truth[::5]
    assert np.array_equal(truth["t_ns"][::5] // 1000, [one["time_usec"] for one in poses])
    for axis, name in enumerate(("x", "y", "z")):
        assert np.array_equal(
            rows["q"][:, axis].astype(np.float32), np.array([one[name] for one in poses], dtype=np.float32)
        )
    north = [one["vx"] for one in states]
    assert north == [round(100.0 * v) for v in rows["q_dot"][:, 0]]
    assert max(map(abs, north)) > 10


def test_the_controller_is_none_the_wiser_and_the_log_is_the_same_each_time(tmp_path: Path) -> None:
    for name, truth_hz in (("without", None), ("with", 250.0), ("again", 250.0)):
        near, far = memory_pair()
        with near, far:
            fly_both(SHORT, near, far, tmp_path / name, truth_hz=truth_hz)
    command = mapping.COMMAND
    sent = [frames_of(tmp_path / name / "run.tlog", command) for name in ("without", "with")]
    assert sent[0] == sent[1]
    assert len(sent[0]) == SHORT.ticks
    assert len(frames_of(tmp_path / "with" / "run.tlog", ODOMETRY)) == SHORT.ticks
    logs = [(tmp_path / name / "run.tlog").read_bytes() for name in ("with", "again")]
    assert logs[0] == logs[1]


@pytest.mark.parametrize("clock", ["lockstep", "realtime"])
def test_a_peer_on_the_loops_link_asks_and_is_answered_there(clock: ClockMode, tmp_path: Path) -> None:
    near, far = memory_pair()
    # The controller's end carries a station's words too, as a router in between would.
    asks = {
        20: request(511, 115, 20_000.0),
        40: request(512, 331),
        41: request(511, 30, 5000.0),
        60: request(511, 115, -1),
    }
    with near, far:
        with_station = Faulty(far, lambda count, data: [data, asks[count]] if count in asks else [data])
        ends = fly_both(SHORT, near, with_station, tmp_path, clock=clock)
    assert isinstance(ends.emulator, dict), ends
    counters = ends.emulator["counters"]
    assert (counters["requests"], counters["requests_refused"]) == (4, 1)
    answers = frames_of(tmp_path / "run.tlog", mapping.COMMAND_ACK)
    assert [(one["command"], one["result"]) for one in answers] == [(511, 0), (512, 0), (511, 2), (511, 0)]
    times = [one["time_usec"] for one in frames_of(tmp_path / "run.tlog", STATE)]
    assert 6 <= len(times) <= 10  # some 40 ticks of 4 ms, one in five
    assert len(frames_of(tmp_path / "run.tlog", ODOMETRY)) == 1
    if clock == "lockstep":
        assert len(set(np.diff(times[1:]))) == 1
        assert counters["foreign"] == 0
        assert len(frames_of(tmp_path / "run.tlog", mapping.COMMAND_LONG)) == 4  # what was asked is in the record too


def test_a_ground_station_asks_on_its_own_link_and_the_loops_link_carries_none_of_it(tmp_path: Path) -> None:
    scenario = scenario_of("flapper", duration_s=1.0)
    near, far = memory_pair()
    uri = f"mem://station{next(_names)}"
    with near, far, open_link(uri) as link, Watcher(link, request(511, 331, 20_000.0)) as watcher:
        late = Faulty(
            far, lambda _count, data: [data] if watcher.has_heard("COMMAND_ACK") else []
        )  # the plant is held until then
        ends = fly_both(scenario, near, late, tmp_path, station=uri)
    assert isinstance(ends.emulator, dict), ends
    assert ends.emulator["counters"]["requests"] == 1
    assert watcher.times("ODOMETRY") == list(range(0, 1_000_000, 20_000))
    assert frames_of(tmp_path / "run.tlog", ODOMETRY) == []
    kept = frames_of(tmp_path / "station_emulator.tlog", ODOMETRY)
    assert [one["time_usec"] for one in kept] == watcher.times("ODOMETRY")
    assert len(frames_of(tmp_path / "station_emulator.tlog", mapping.COMMAND_LONG)) == 1
    (answer,) = [one for one in watcher.heard if one.get_type() == "COMMAND_ACK"]
    assert (answer.command, answer.result) == (511, 0)
    assert ends.emulator["counters"]["sequence_gaps"] == 0


def test_drives_on_a_bus_say_how_fast_they_turn(tmp_path: Path) -> None:
    near, far = memory_pair()
    uri = f"mem://station{next(_names)}"
    motors = MotorLink(can=f"virtual:rpm{next(_names)}")
    with near, far, open_link(uri) as link, Watcher(link) as watcher:
        ends = fly_both(SHORT, near, far, tmp_path, station=uri, motors=motors)
    assert isinstance(ends.emulator, dict), ends
    heard = [one for one in watcher.heard if one.get_type() == "RAW_RPM"]
    assert [one.index for one in heard] == list(range(6)) * 4  # 10 Hz for 0.4 s
    assert any(one.frequency != 0.0 for one in heard[6:])
