"""Gains, scales and gears as parameters: names, values, what may be set when; the protocol as pymavlink speaks it."""

from __future__ import annotations

import math
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from bridge.parameter_server import BURST, ParameterServer
from controller.laws.law import make_law
from controller.laws.registry import LAWS, declared_gains
from controller.laws.ude import UdeGains
from controller.parameters import Parameters, changed, markdown_table, parameters_of, value_of
from protocol.errors import ScenarioError, UsageError
from protocol.messages import VEHICLE
from protocol.scenario import Scenario, replace_gains
from protocol.wire.codec import FrameReader, FrameWriter
from protocol.wire.parameter_mapping import Kind, Refusal, decode_value
from tests.loop import scenario_of

FLAPPER = scenario_of("flapper")
PLAY = {"model": "play", "h": [1.0] * 6, "B": [0.001] * 6}


def new(scenario: Scenario = FLAPPER) -> Parameters:
    law = make_law(scenario.law, scenario)
    return Parameters(scenario, lambda other: law.adopt(make_law(law.name, other)))


class Peer:
    """A ground station, of pymavlink alone, before a server."""

    def __init__(self, *, armed: bool = False) -> None:
        self.parameters = new()
        self.told: list[int] = []
        self.armed = armed
        self.server = ParameterServer(self.parameters, VEHICLE, lambda: self.armed, self.told.append)
        self._mavlink = common.MAVLink(None, 255, 190)
        self._reader = FrameReader(is_datagram=True)
        self._writer = FrameWriter(1, 1)

    def ask(self, message: Any) -> bool:
        (frame,) = self._reader.read(message.pack(self._mavlink))
        return self.server.handle(frame)

    def hear(self) -> list[Any]:
        data = b"".join(self._writer.seal(*saying) for saying in self.server.due())
        return common.MAVLink(None).parse_buffer(data) or []

    def set(self, name: bytes, value: float, kind: int = Kind.REAL32) -> list[Any]:
        assert self.ask(common.MAVLink_param_set_message(1, 1, name, value, kind))
        return self.hear()


def test_names_are_unique_and_fit() -> None:
    for scenario in (FLAPPER, scenario_of("flapper", hysteresis=PLAY)):
        names = [parameter.name for parameter in parameters_of(scenario)]
        assert len(set(names)) == len(names)
        assert max(map(len, names)) <= 16
        assert all(name.isascii() and name.isupper() for name in names)
        assert any(name.startswith("HYS_") for name in names)


def test_values_are_the_scenarios() -> None:
    values = {parameter.name: value_of(FLAPPER, parameter) for parameter in parameters_of(FLAPPER)}
    assert values["LAW_K_X"] == 20.0
    assert values["LAW_LAMBDA_PITCH"] == 2.0
    assert values["LAW_T_YAW"] == 0.05
    assert values["LAW_ORDER"] == 2.0
    assert values["LAW_ROTATE"] == 1.0
    assert values["ACT_SCALE_Z"] == 0.12
    assert values["ACT_LOWER_Z"] == -0.12
    assert values["HYS_CHI_ROLL"] == FLAPPER.hysteresis.chi[3]  # type: ignore[union-attr]
    assert "HYS_B_X" not in values


@pytest.mark.parametrize("law", LAWS)
def test_a_log_knows_the_law_by_its_number(law: str) -> None:
    scenario = scenario_of("flapper", law=law)
    (index,) = [parameter for parameter in parameters_of(scenario) if parameter.name == "LAW_INDEX"]
    assert value_of(scenario, index) == LAWS[law].number


def test_indices_are_those_of_the_logs_there_are() -> None:
    """Written down from the version before laws had tables of gains of their own."""
    laws = ("K", "LAMBDA", "B", "T", "N", "KP", "KD", "UHAT0", "ROTATE", "ORDER", "INDEX", "RATE_HZ")
    prefixes = [f"LAW_{name}" for name in laws]
    prefixes += ["ACT_SCALE", "ACT_LOWER", "ACT_UPPER", "HYS_H", "HYS_KAPPA", "HYS_CHI"]
    names = [parameter.name for parameter in parameters_of(FLAPPER)]
    stems = [name if name in prefixes else name.rpartition("_")[0] for name in names]
    assert list(dict.fromkeys(stems)) == prefixes
    assert len(names) == 4 + 6 * (len(prefixes) - 4)


def test_a_table_that_neither_the_scenario_has_nor_its_law_needs_gives_no_parameters() -> None:
    gains = {"ude": FLAPPER.gains["ude"], "filters": FLAPPER.gains["filters"]}
    names = {parameter.name for parameter in parameters_of(scenario_of("flapper", gains=gains))}
    assert names == {one.name for one in parameters_of(FLAPPER) if not one.name.startswith(("LAW_KP_", "LAW_KD_"))}


def test_the_documented_table_is_the_one_of_the_code() -> None:
    """With the gains of the project's own scenarios; another law's are said by `python -m controller.parameters`."""
    page = (Path(__file__).parents[2] / "docs" / "station.md").read_text(encoding="utf-8")
    assert "\n".join(markdown_table(declared_gains(FLAPPER))) in page
    numbers = dict(re.findall(r"(\d+) `(\w+)`", page.partition("LAW_INDEX of")[2].partition("\n\n")[0]))
    assert numbers == {str(LAWS[name].number): name for name in numbers.values()}
    assert len(numbers) >= 6


def test_a_changed_gain_changes_just_that() -> None:
    (gain,) = [one for one in parameters_of(FLAPPER) if one.name == "LAW_K_Y"]
    other = changed(FLAPPER, gain, 25.0)
    assert other.read_gains("ude", UdeGains).K == (20.0, 25.0, 20.0, 40.0, 40.0, 40.0)
    assert changed(other, gain, 20.0) == FLAPPER
    for wrong in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ScenarioError):
            changed(FLAPPER, gain, wrong)


def test_a_law_adopts_gains_in_place_and_then_steps_as_one_made_with_them() -> None:
    law, other = make_law("ude", FLAPPER), make_law("ude", replace_gains(FLAPPER, "ude", K=[30.0] * 6))
    state, theirs = law.start(), other.start()
    law.step(state, 0, np.full(6, 0.2))
    law.adopt(other)
    law.restart(state)
    for tick in range(5):
        q = np.full(6, 0.2 + 0.01 * tick)
        assert np.array_equal(law.step(state, tick * law.period_ns, q), other.step(theirs, tick * law.period_ns, q))
    with pytest.raises(UsageError, match="cannot replace the running law"):
        law.adopt(make_law("ude", replace_gains(FLAPPER, "filters", order=3)))


def test_a_list_is_all_of_them_in_order_in_bursts() -> None:
    peer = Peer()
    assert peer.ask(common.MAVLink_param_request_list_message(1, 1))
    heard = []
    while burst := peer.hear():
        assert len(burst) <= BURST
        heard += burst
    table = peer.parameters.table
    assert [one.param_id for one in heard] == [one.name for one in table]
    assert [one.param_index for one in heard] == list(range(len(table)))
    assert {one.param_count for one in heard} == {len(table)}
    floats = {one.param_id: one.param_value for one in heard if one.param_type == Kind.REAL32}
    assert floats["LAW_K_ROLL"] == 40.0
    assert floats["LAW_B_X"] == np.float32(FLAPPER.control.b[0])


def test_integers_travel_bytewise() -> None:
    peer = Peer()
    assert peer.ask(common.MAVLink_param_request_read_message(1, 1, b"LAW_ORDER", -1))
    (value,) = peer.hear()
    assert value.param_type == common.MAV_PARAM_TYPE_INT32
    assert struct.unpack("<i", struct.pack("<f", value.param_value)) == (2,)
    (zero,) = struct.unpack("<f", bytes((0, 0, 0, 0)))
    (answer,) = peer.set(b"LAW_ROTATE", zero, Kind.INT32)
    assert peer.parameters.scenario.control.rotate_force is False
    assert (answer.param_id, answer.param_value) == ("LAW_ROTATE", 0.0)
    (one,) = struct.unpack("<f", bytes((1, 0, 0, 0)))
    peer.set(b"LAW_ROTATE", one, Kind.INT32)
    assert peer.parameters.scenario == FLAPPER


def test_one_is_read_by_name_or_index() -> None:
    peer = Peer()
    for message in (
        common.MAVLink_param_request_read_message(1, 1, b"LAW_LAMBDA_PITCH", -1),  # 16 characters: no zero behind them
        common.MAVLink_param_request_read_message(1, 0, b"", 10),
    ):
        assert peer.ask(message)
        (value,) = peer.hear()
        assert (value.param_id, value.param_index, value.param_value) == ("LAW_LAMBDA_PITCH", 10, 2.0)


@pytest.mark.parametrize(("name", "index"), [(b"NO_SUCH", -1), (b"", 9999), (b"", -2), (b"LAW_LAMBDA_PITCHX", -1)])
def test_one_that_is_not_there_is_refused_and_counted(name: bytes, index: int) -> None:
    if len(name) > 16:
        name = name[:15] + b"?"
    peer = Peer()
    assert peer.ask(common.MAVLink_param_request_read_message(1, 1, name, index))
    (error,) = peer.hear()
    assert (error.get_type(), error.error, error.target_system) == ("PARAM_ERROR", Refusal.UNKNOWN, 255)
    assert peer.parameters.counters == {"parameters_set": 0, "parameters_refused": 1}


def test_a_gain_is_set_said_and_told_on() -> None:
    peer = Peer()
    (value,) = peer.set(b"LAW_K_X", 22.5)
    assert (value.get_type(), value.param_id, value.param_value) == ("PARAM_VALUE", "LAW_K_X", 22.5)
    assert peer.parameters.scenario.gains["ude"]["K"][0] == 22.5
    assert peer.told == [0]
    assert peer.parameters.counters["parameters_set"] == 1


def test_what_is_there_already_to_float32_changes_nothing() -> None:
    peer = Peer()
    peer.set(b"LAW_B_X", float(np.float32(FLAPPER.control.b[0])))
    assert peer.parameters.scenario is FLAPPER
    assert peer.told == []
    assert peer.parameters.counters == {"parameters_set": 0, "parameters_refused": 0}


@pytest.mark.parametrize(
    ("name", "value", "kind", "armed", "refusal"),
    [
        (b"LAW_K_X", 22.5, Kind.REAL32, True, Refusal.ARMED),
        (b"ACT_SCALE_X", 1.0, Kind.REAL32, False, Refusal.READ_ONLY),
        (b"HYS_H_X", 1.5, Kind.REAL32, False, Refusal.READ_ONLY),
        (b"LAW_ORDER", struct.unpack("<f", bytes((3, 0, 0, 0)))[0], Kind.INT32, False, Refusal.READ_ONLY),
        (b"LAW_K_X", 0.0, Kind.REAL32, False, Refusal.OUT_OF_RANGE),
        (b"LAW_T_X", -0.1, Kind.REAL32, False, Refusal.OUT_OF_RANGE),
        (b"LAW_K_X", math.nan, Kind.REAL32, False, Refusal.OUT_OF_RANGE),
        (b"LAW_K_X", math.inf, Kind.REAL32, False, Refusal.OUT_OF_RANGE),
        (b"LAW_K_X", 22.5, common.MAV_PARAM_TYPE_REAL64, False, Refusal.OUT_OF_RANGE),
        (b"LAW_K_X", 22.5, Kind.INT32, False, Refusal.OUT_OF_RANGE),
        (b"LAW_ROTATE", struct.unpack("<f", bytes((2, 0, 0, 0)))[0], Kind.INT32, False, Refusal.OUT_OF_RANGE),
    ],
)
def test_sets_that_would_break_something_are_refused_and_counted(
    name: bytes, value: float, kind: int, armed: bool, refusal: Refusal
) -> None:
    peer = Peer(armed=armed)
    error, held = peer.set(name, value, kind)
    assert held.param_id == error.param_id == name.decode()
    (index,) = [i for i, one in enumerate(peer.parameters.table) if one.name == name.decode()]
    before = np.float32(value_of(FLAPPER, peer.parameters.table[index]))
    if peer.parameters.table[index].kind is Kind.REAL32:
        assert held.param_value == before  # the value that stands
    assert error.error == refusal
    assert peer.parameters.scenario is FLAPPER
    assert peer.told == []
    assert peer.parameters.counters == {"parameters_set": 0, "parameters_refused": 1}


def test_frames_for_others_are_left_alone() -> None:
    peer = Peer()
    assert not peer.ask(common.MAVLink_param_request_list_message(2, 1))
    assert not peer.ask(common.MAVLink_param_set_message(1, 191, b"LAW_K_X", 1.0, Kind.REAL32))
    assert peer.hear() == []


def test_a_value_reads_back_from_a_log() -> None:
    parameters = new()
    for index, parameter in enumerate(parameters.table):
        _, payload = parameters.saying(index)
        name, value = decode_value(payload)
        assert name == parameter.name
        assert np.float32(value) == np.float32(parameters.value(index))
