"""The short way through a tick against the long one: the same frames, rows and counters; and only for plain answers."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from bridge.endpoint import Endpoint
from bridge.links.memory import memory_pair
from plant_emulator.emulator import Emulator
from plant_emulator.plant.truth import TruthWriter, load_truth
from protocol.errors import DivergenceError
from protocol.messages import VEHICLE, ActuatorCommand
from protocol.scenario import Scenario
from protocol.wire.codec import FrameWriter
from protocol.wire.tick_frames import CommandWriter
from tests.loop import scenario_of

FLAPPER = scenario_of("flapper", seed=3)
PERIOD_NS = FLAPPER.period_ns
DELAY_NS = 5_000_000


class End(NamedTuple):
    """An emulator, the way into its reader, and its ground truth."""

    emulator: Emulator
    endpoint: Endpoint
    truth: TruthWriter


def new_end(path: Path, scenario: Scenario = FLAPPER) -> End:
    near, _ = memory_pair()
    endpoint = Endpoint(near, VEHICLE[0], scenario.wire.emulator_component)
    endpoint.reader.restart_sequences([(*VEHICLE, 0)])
    truth = TruthWriter(path)
    return End(Emulator(scenario, endpoint, truth), endpoint, truth)


class Commands:
    """Answers as a controller would send them."""

    def __init__(self, scenario: Scenario = FLAPPER) -> None:
        self.writer = FrameWriter(*VEHICLE)
        self.scale = np.array(scenario.actuators.scale)
        self._frames = CommandWriter(self.writer, self.scale, lockstep=True)

    def answer(self, t_ns: int, tau: np.ndarray, *, armed: bool = True) -> bytes:
        return self._frames.frame(ActuatorCommand(t_ns, tau, armed))


def long_way(end: End, data: bytes, t_ns: int) -> list[bytes]:
    (frame,) = end.endpoint.reader.read(data)
    command = end.emulator.decode(frame.payload)
    assert command is not None
    end.emulator.act(t_ns, DELAY_NS, command)
    end.emulator.advance(t_ns + PERIOD_NS)
    return end.emulator.sense(t_ns + PERIOD_NS)


def test_the_short_way_makes_the_same_frames_rows_and_counters_as_the_long_one(tmp_path: Path) -> None:
    quick, slow = new_end(tmp_path / "quick.npy"), new_end(tmp_path / "slow.npy")
    random, commands = np.random.default_rng(1), Commands()
    assert quick.emulator.sense(0) == slow.emulator.sense(0)
    quick_ticks = 0
    for tick in range(200):
        t_ns = tick * PERIOD_NS
        tau = np.array(FLAPPER.initial.command) + random.normal(size=6) * 0.3 * commands.scale
        data = commands.answer(t_ns, np.clip(tau, -commands.scale, commands.scale))
        following = quick.emulator.go_on(data, t_ns, t_ns + PERIOD_NS, DELAY_NS)
        if following is None:
            assert long_way(quick, data, t_ns) == long_way(slow, data, t_ns)
            continue
        quick_ticks += 1
        quick.emulator.settle(t_ns, t_ns)
        datagram, middle = following
        assert [datagram[:middle], datagram[middle:]] == long_way(slow, data, t_ns)
        assert quick.emulator.plant.t_ns == slow.emulator.plant.t_ns
    assert quick_ticks == 200 - 8  # but where a heartbeat or HIL_GPS is due too: 10 Hz over 0.8 s
    assert quick.emulator.all_counters() == slow.emulator.all_counters()
    assert quick.emulator.all_counters()["clamped"] > 0
    quick.truth.close()
    slow.truth.close()
    assert len(load_truth(quick.truth.path)) == 200
    assert quick.truth.path.read_bytes() == slow.truth.path.read_bytes()


@pytest.mark.parametrize(
    "spoiled", ["disarmed", "another time", "another number", "damaged", "two frames", "not a number"]
)
def test_any_other_datagram_changes_nothing(tmp_path: Path, spoiled: str) -> None:
    end, commands = new_end(tmp_path / "truth.npy"), Commands()
    end.emulator.sense(0)
    if spoiled == "another number":
        commands.writer.sequence = 7
    tau = np.full(6, np.nan) if spoiled == "not a number" else np.zeros(6)
    data = commands.answer(PERIOD_NS if spoiled == "another time" else 0, tau, armed=spoiled != "disarmed")
    if spoiled == "damaged":
        data = data[:20] + bytes([data[20] ^ 1]) + data[21:]
    elif spoiled == "two frames":
        data += commands.answer(0, tau)
    state, counters = end.emulator.plant.state.packed.copy(), end.emulator.all_counters()
    assert end.emulator.go_on(data, 0, PERIOD_NS, 0) is None
    assert end.emulator.plant.state.packed.tobytes() == state.tobytes()
    assert end.emulator.plant.t_ns == 0
    assert end.emulator.all_counters() == counters
    end.truth.close()
    assert len(load_truth(end.truth.path)) == 0


def test_where_the_plant_diverges_its_last_row_is_recorded(tmp_path: Path) -> None:
    end = new_end(tmp_path / "truth.npy")
    end.emulator.sense(0)
    end.emulator.plant.state.motion[4] = 1.39
    end.emulator.plant.state.motion[10] = 50.0
    with pytest.raises(DivergenceError, match="pitch"):
        end.emulator.go_on(Commands().answer(0, np.zeros(6)), 0, PERIOD_NS, 0)
    end.truth.close()
    (row,) = load_truth(end.truth.path)
    assert row["t_ns"] == 0
    assert row["q"][4] == 1.39
