"""The controller as a ground station sees it: parameters listed, set before arming, refused after; and the log tells of it."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from bridge.endpoint import Endpoint
from bridge.links.link import open_link
from bridge.links.memory import memory_pair
from bridge.shared_options import ClockMode
from bridge.station import Station
from bridge.timing.clock import VirtualClock
from controller.laws.law import make_law
from controller.parameters import Parameters, parameters_of
from controller.session import HilSession
from controller.station.ground_station import GroundStation
from fwav_hil.replay.into_controller import replay_in_process
from fwav_hil.replay.recorded_run import recorded_run
from plant_emulator.plant.truth import load_truth
from protocol.logs.tlog import read_tlog
from protocol.scenario import replace_gains
from protocol.wire import parameter_mapping
from tests.loop import Ends, fly_both, scenario_of
from tests.plant_emulator.pacing.test_lockstep import Faulty
from tests.station import Watcher, message, request

ROOMY = scenario_of("flapper", duration_s=2.0)
SET = common.MAVLink_param_set_message
_names = itertools.count()


def fly_watched(out: Path, *asks: bytes, before: str, arm: bool = True) -> tuple[Ends, Watcher]:
    """A flight whose first tick waits until the station has heard a message called `before`."""
    near, far = memory_pair()
    uri = f"mem://vehicle{next(_names)}"
    with near, far, open_link(uri) as link, Watcher(link, *asks) as watcher:
        late = Faulty(far, lambda _count, data: [data] if watcher.has_heard(before) else [])
        ends = fly_both(ROOMY, near, late, out, controller_station=uri, arm=arm)
    assert isinstance(ends.emulator, dict), ends
    assert isinstance(ends.controller, dict), ends
    return ends, watcher


def values(log: Path) -> list[tuple[int, str, float | None]]:
    frames = [(t, f) for t, f in read_tlog(log) if f.message_id == parameter_mapping.VALUE.message_id]
    return [(t_us, *parameter_mapping.decode_value(frame.payload)) for t_us, frame in frames]


def test_a_log_explains_itself(tmp_path: Path) -> None:
    near, far = memory_pair()
    with near, far:
        fly_both(ROOMY, near, far, tmp_path)
    said = values(tmp_path / "run.tlog")
    assert [name for _, name, _ in said] == [parameter.name for parameter in parameters_of(ROOMY)]
    assert [t_us for t_us, _, _ in said] == [20_000 * number for number in range(len(said))]
    assert {name: value for _, name, value in said}["LAW_K_ROLL"] == 40.0


def test_a_station_lists_sets_and_asks_who_this_is(tmp_path: Path) -> None:
    version = request(520, 1.0, target=1)
    listing = message(common.MAVLink_param_request_list_message(1, 1))
    gain = message(SET(1, 1, b"LAW_K_X", 22.5, parameter_mapping.Kind.REAL32))
    unknown = message(SET(1, 1, b"NO_SUCH", 1.0, parameter_mapping.Kind.REAL32))
    ends, watcher = fly_watched(tmp_path, version, listing, gain, unknown, before="PARAM_ERROR")
    (who,) = [one for one in watcher.heard if one.get_type() == "AUTOPILOT_VERSION"]
    assert who.capabilities == 8192 | 16 | 2  # MAVLink 2, integers bytewise, floats: what there is, and no more
    beats = [one for one in watcher.heard if one.get_type() == "HEARTBEAT"]
    assert beats[0].type == common.MAV_TYPE_FLAPPING_WING
    listed = {one.param_id: one for one in watcher.heard if one.get_type() == "PARAM_VALUE"}
    assert len(listed) == next(iter(listed.values())).param_count == len(parameters_of(ROOMY))
    assert listed["LAW_K_X"].param_value == 22.5
    counters = ends.controller["counters"]  # type: ignore[index]
    assert (counters["parameters_set"], counters["parameters_refused"]) == (1, 1)
    # The change is in the record with the first answer, before that name's own turn ...
    first, *rest = values(tmp_path / "run.tlog")
    assert first == (0, "LAW_K_X", 22.5)
    assert len(rest) == len(parameters_of(ROOMY))
    # ... and a replay follows it: every byte of every command.
    difference = replay_in_process(recorded_run(tmp_path, None, None))
    assert difference.is_zero
    assert len(difference.t_ns) == ROOMY.ticks
    kept = {frame.message_id for _, frame in read_tlog(tmp_path / "station_controller.tlog")}
    assert kept >= {0, 20 + 1, 22, 23, 148}


def test_the_gain_set_is_the_gain_flown(tmp_path: Path) -> None:
    gain = message(SET(1, 1, b"LAW_K_X", 15.0, parameter_mapping.Kind.REAL32))
    fly_watched(tmp_path / "set", gain, before="PARAM_VALUE")
    near, far = memory_pair()
    with near, far:
        asked = replace_gains(ROOMY, "ude", K=[15.0, *ROOMY.gains["ude"]["K"][1:]])
        fly_both(asked, near, far, tmp_path / "made")
    flown, made = (load_truth(tmp_path / name / "ground_truth.npy") for name in ("set", "made"))
    assert np.array_equal(flown["command"], made["command"])


def test_nothing_is_set_while_armed() -> None:
    near, far = memory_pair()
    law = make_law("ude", ROOMY)
    parameters = Parameters(ROOMY, lambda other: law.adopt(make_law("ude", other)))
    vehicle = HilSession(Endpoint(memory_pair()[0], 1, 1), ROOMY.digest(), (1, 191), arm=False, parameters=parameters)
    station = GroundStation(Station(near, (1, 1), VirtualClock(), lambda: b"\1"), vehicle, parameters)
    for armed, answer in ((True, "PARAM_ERROR"), (False, "PARAM_VALUE")):
        vehicle.armed = armed
        far.send(message(SET(1, 1, b"LAW_K_X", 22.5, parameter_mapping.Kind.REAL32)))
        station.poll(0)
        heard: list[Any] = []
        while data := far.recv(0.0):
            heard += common.MAVLink(None).parse_buffer(data) or []
        assert heard[-2 if armed else -1].get_type() == answer
        assert (parameters.scenario is ROOMY) == armed


@pytest.mark.parametrize("clock", ["lockstep", "realtime"])
def test_a_station_arms_a_controller_that_waits_for_it(clock: ClockMode, tmp_path: Path) -> None:
    near, far = memory_pair()
    uri = f"mem://vehicle{next(_names)}"
    short = scenario_of("flapper", duration_s=0.4)
    arm = request(400, 1.0, target=1)
    with near, far, open_link(uri) as link, Watcher(link, *[arm] * 200, pause_s=0.05) as watcher:
        ends = fly_both(short, near, far, tmp_path, controller_station=uri, arm=False, clock=clock)
    assert isinstance(ends.emulator, dict), ends
    assert ends.emulator["counters"]["disarmed"] == 0
    acknowledged = [one.result for one in watcher.heard if one.get_type() == "COMMAND_ACK"]
    assert 0 in acknowledged
    assert acknowledged == sorted(acknowledged, reverse=True)  # denied until the emulator has shown the same scenario
