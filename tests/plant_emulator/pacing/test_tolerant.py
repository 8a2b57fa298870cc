"""The tolerant profile before a fake PX4: one that speaks, is silent and answers as PX4's simulator link was seen to do."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from bridge.links.link import Link, open_link
from bridge.links.memory import memory_pair
from bridge.links.tcp import TcpIn
from bridge.process import StopFlag
from plant_emulator.options import EmulatorOptions
from plant_emulator.pacing import tolerant
from plant_emulator.plant.truth import load_truth
from plant_emulator.process import fly, run_emulator, warm_up
from protocol.errors import LinkClosedError, PeerLostError, PeerMissingError, UsageError
from protocol.logs.tlog import read_tlog
from protocol.scenario import Scenario
from protocol.wire import mapping
from protocol.wire.codec import layout
from tests.loop import scenario_of
from tests.plant_emulator.pacing.test_lockstep import Faulty, lose_each

HOVER = (0.0, 0.0, -0.0056 * 9.81 / 0.12, 0.0, 0.0, 0.0)


class FakePx4:
    """PX4 as its module `simulator_mavlink` is seen from the outside, made of pymavlink alone.

    silent: HIL_SENSORs that it does not answer at first. every_us: time between answers, as PX4 has it from 500 Hz on.
    arms_us, mute_us: when it arms (mode 129), and falls silent for good.
    """

    def __init__(
        self, link: Link, *, silent: int = 20, every_us: int = 4000, arms_us: int = 0, mute_us: int = 1 << 62
    ) -> None:
        self._link = link
        self._silent, self._every_us, self._arms_us, self._mute_us = silent, every_us, arms_us, mute_us
        self._mavlink = common.MAVLink(None, 1, 1)
        self._answered_us = -1 << 62
        self.heard: list[Any] = []
        self.refused: list[int] = []
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> FakePx4:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._link.close()
        self._thread.join()

    def _send(self, message: Any) -> None:
        self._link.send(message.pack(self._mavlink))

    def _run(self) -> None:
        nan = float("nan")
        self._mavlink.seq = 77  # it has been running for a while
        try:
            self._send(common.MAVLink_command_long_message(0, 0, 511, 0, 115, 5000, nan, nan, nan, nan, nan))
            self._send(common.MAVLink_heartbeat_message(2, 12, 0, 0, 0, 3))
            while True:
                for message in common.MAVLink(None).parse_buffer(self._link.recv(0.1) or b"") or []:
                    self.heard.append(message)
                    if message.get_type() == "HIL_SENSOR":
                        self._take(message)
        except LinkClosedError:
            return

    def _take(self, sensor: Any) -> None:
        self._silent -= 1
        t_us = sensor.time_usec
        if sensor.fields_updated != 0x1FFF or sensor.id != 0:
            self.refused.append(t_us)  # without all groups PX4 denies arming; bits of another id print errors
        if self._silent >= 0 or t_us >= self._mute_us or 0 <= t_us - self._answered_us < self._every_us:
            return
        self._answered_us = t_us
        armed = t_us >= self._arms_us
        controls = [*(HOVER if armed else (0.0,) * 6), *[0.0] * 10]
        self._send(common.MAVLink_hil_actuator_controls_message(t_us, controls, 129 if armed else 1, 1))


def fly_px4(scenario: Scenario, near: Link, out: Path | None = None, *, wait_s: float = 10.0) -> dict[str, Any]:
    warm_up(scenario)
    options = EmulatorOptions(link="-", out=out, wait_s=wait_s, profile="tolerant")
    return fly(scenario, near, options, lambda _event: None, StopFlag())


def flapper(rate_hz: float, duration_s: float, **changes: Any) -> Scenario:
    return scenario_of("flapper", rate_hz=rate_hz, duration_s=duration_s, **changes)


def test_at_250_hz_it_is_sent_to_freely_and_then_answers_each_tick(tmp_path: Path) -> None:
    near, far = memory_pair()
    with near, FakePx4(far, arms_us=600_000) as px4:
        summary = fly_px4(flapper(250.0, 1.0), near, tmp_path)
    counters = summary["counters"]
    assert summary["ticks"] == 250
    # Twenty went out freely: silence at first is no loss. A machine may stall now and then, not at each tick.
    assert 20 <= counters["unanswered"] - counters["resent"] <= 30
    assert counters["resent"] < 100
    assert 150 <= counters["held"] <= 160  # until it armed
    assert counters["sequence_gaps"] == counters["refused_commands"] == 0
    assert px4.refused == []
    times = [one.time_usec for one in px4.heard if one.get_type() == "HIL_SENSOR"]
    assert sorted(set(times)) == list(range(0, 1_000_000, 4000))
    fixes = [one for one in px4.heard if one.get_type() == "HIL_GPS"]
    assert len(fixes) == 10
    assert {(one.fix_type, one.eph, one.satellites_visible) for one in fixes} == {(3, 30, 12)}
    (answer,) = [one for one in px4.heard if one.get_type() == "COMMAND_ACK"]
    assert (answer.command, answer.result) == (511, 0)
    assert sum(one.get_type() == "HIL_STATE_QUATERNION" for one in px4.heard) >= 200  # 200 Hz, as it asked
    truth = load_truth(tmp_path / "ground_truth.npy")
    assert np.array_equal(truth["q"][:151], np.tile(truth["q"][0], (151, 1)))
    assert not np.array_equal(truth["q"][-1], truth["q"][0])
    kept = [f.message_id for _, f in read_tlog(tmp_path / "run.tlog")]
    assert kept.count(layout("HIL_STATE_QUATERNION").message_id) == 200
    assert kept.count(mapping.COMMAND.message_id) == 250 - counters["unanswered"] + counters["late_answers"]


@pytest.mark.parametrize(("rate_hz", "unanswered"), [(500.0, 1 / 2), (1000.0, 3 / 4)])
def test_above_250_hz_it_answers_every_4_ms_and_the_run_goes_on(
    rate_hz: float, unanswered: float, tmp_path: Path
) -> None:
    near, far = memory_pair()
    with near, FakePx4(far, silent=8):
        summary = fly_px4(flapper(rate_hz, 0.1), near, tmp_path)
    counters = summary["counters"]
    ticks = summary["ticks"]
    assert ticks == 0.1 * rate_hz
    assert 0.9 * unanswered * ticks <= counters["unanswered"] < ticks
    assert counters["stale"] == 0
    answered = [f for _, f in read_tlog(tmp_path / "run.tlog") if f.message_id == mapping.COMMAND.message_id]
    assert len(answered) == ticks - counters["unanswered"] + counters["late_answers"]


def test_a_link_that_loses_ticks_and_answers_stalls_nobody() -> None:
    near, far = memory_pair()
    with near, FakePx4(Faulty(far, lose_each(9)), silent=0):
        counters = fly_px4(flapper(250.0, 0.4), Faulty(near, lose_each(7)))["counters"]
    assert 5 < counters["unanswered"] < 95
    assert counters["late_answers"] > 0  # the tick sent once more was answered, while the next one was out


def test_one_that_falls_silent_is_flown_safely_for_a_while_and_then_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tolerant, "HEARTBEAT_TIMEOUT_NS", 300_000_000)
    near, far = memory_pair()
    with near, FakePx4(far, silent=0, mute_us=100_000), pytest.raises(PeerLostError, match="no HIL_ACTUATOR_CONTROLS"):
        fly_px4(flapper(250.0, 5.0), near, tmp_path)
    truth = load_truth(tmp_path / "ground_truth.npy")
    assert 50 <= len(truth) <= 60  # 25 answered, 30 waited for, 10 ms each
    assert truth["tau"][30][2] < -0.05  # the command stands ...
    assert np.array_equal(truth["tau"][-1], np.zeros(6))  # ... until it is 50 ms old


def test_one_that_never_answers_is_waited_for_with_a_bound() -> None:
    near, far = memory_pair()
    with near, FakePx4(far, silent=10**9), pytest.raises(PeerLostError, match="see whether it still runs"):
        fly_px4(flapper(250.0, 60.0), near, wait_s=0.4)


def test_none_at_all_is_said() -> None:
    near, _far = memory_pair()
    with near, pytest.raises(PeerMissingError, match=r"tcpin://127\.0\.0\.1:4560"):
        fly_px4(flapper(250.0, 1.0), near, wait_s=0.2)


def test_over_tcp_as_px4_comes() -> None:
    with open_link("tcpin://127.0.0.1:0") as near:
        assert isinstance(near, TcpIn)
        with FakePx4(open_link(f"tcpout://127.0.0.1:{near.port}")) as px4:
            summary = fly_px4(flapper(250.0, 0.2), near)
    assert summary["ticks"] == 50
    assert px4.refused == []


def test_it_is_of_lockstep_only() -> None:
    options = EmulatorOptions(link="mem://none", clock="realtime", profile="tolerant")
    with pytest.raises(UsageError, match="of lockstep"):
        run_emulator(flapper(250.0, 1.0), options, lambda _event: None, StopFlag())
