"""A recorded run as both ends saw it: the ticks of the emulator, and the commands received after each."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from bridge.recording.sidecar import read_sidecar
from bridge.summary import read_json
from controller.parameters import followed
from fwav_hil.logs.choice import open_telemetry
from protocol.errors import LogError, UsageError
from protocol.logs.scan import Scan
from protocol.messages import VEHICLE
from protocol.scenario import Scenario, find_scenario, load_scenario, with_overrides
from protocol.wire import mapping
from protocol.wire.codec import Frame
from protocol.wire.parameter_mapping import VALUE, decode_value


class Tick(NamedTuple):
    """One tick: its time (ns), its stamp (us), what the emulator sent, and what the controller sent before the next one."""

    t_ns: int
    stamp_us: int
    datagram: bytes
    pose: bytes
    answers: list[tuple[int, Frame]]

    @property
    def parameters(self) -> list[tuple[str, float | None]]:
        """(name, value) of each parameter that the controller sent."""
        return [decode_value(frame.payload) for _, frame in self.answers if frame.message_id == VALUE.message_id]

    @property
    def answer(self) -> bytes:
        """All frames received after the tick, as one datagram."""
        return b"".join(frame.raw for _, frame in self.answers)


class Recorded(NamedTuple):
    """A run read from its log. commands: payload of the command that answers each sample, by the sample's time (ns)."""

    log: Path
    scenario: Scenario
    lockstep: bool
    ticks: list[Tick]
    commands: dict[int, bytes]


def recorded_run(log: Path, scenario_name: str | None, law: str | None) -> Recorded:
    """The run in a log, with the scenario of its folder or the given one, and optionally another law.

    Raises LogError, ScenarioError, and UsageError where there is no scenario.
    """
    opened, scan = open_telemetry(log)
    path = opened.path
    scenario = _scenario_of(path, scenario_name)
    clock = read_sidecar(path).get("clock") or read_json(path.parent / "emulator.json").get("clock") or "lockstep"
    ticks = _ticks(scan, (VEHICLE[0], scenario.wire.emulator_component))
    commands: dict[int, bytes] = {}
    for tick in ticks:
        for _, frame in tick.answers:
            if frame.message_id == mapping.COMMAND.message_id:
                payload = frame.payload.ljust(mapping.COMMAND.size, b"\0")
                commands.setdefault(int.from_bytes(payload[:8], "little") * 1000, payload)
    if not ticks:
        raise LogError(
            f"{path} has no sample (ATT_POS_MOCAP with its HIL_SENSOR) of {VEHICLE[0]}/{scenario.wire.emulator_component}:"
            " only logs of this project's runs can be replayed into its ends"
        )
    scenario = followed(scenario, ticks[0].parameters)  # gains that a ground station had set before the start
    return Recorded(path, with_overrides(scenario, law=law), clock == "lockstep", ticks, commands)


def _scenario_of(log: Path, name: str | None) -> Scenario:
    if name:
        return load_scenario(find_scenario(name))
    beside = log.parent / "scenario.toml"
    if not beside.exists():
        raise UsageError(
            f"there is no scenario.toml beside {log}: give the scenario that it was flown with by --scenario"
        )
    return load_scenario(beside)


def _ticks(scan: Scan, emulator: tuple[int, int]) -> list[Tick]:
    ticks: list[Tick] = []
    waiting: list[bytes] = []
    pose = b""
    frames = scan.frames
    columns = zip(
        frames["stamp_us"].tolist(), frames["message_id"].tolist(), frames["sequence"].tolist(),
        frames["system"].tolist(), frames["component"].tolist(), strict=True,
    )  # fmt: skip
    for row, (stamp_us, number, sequence, system, component) in enumerate(columns):
        raw = scan.raw(row)
        if (system, component) == emulator:
            waiting.append(raw)
            payload = scan.payload(row)
            if number == mapping.POSE.message_id:
                pose = payload
            elif number == mapping.TICK.message_id:
                t_ns = mapping.decode_tick_time_ns(payload)
                ticks.append(Tick(t_ns, stamp_us, b"".join(waiting), pose, []))
                waiting.clear()
        elif (system, component) == VEHICLE and ticks:
            ticks[-1].answers.append((stamp_us, Frame(number, sequence, system, component, scan.payload(row), raw)))
    return ticks
