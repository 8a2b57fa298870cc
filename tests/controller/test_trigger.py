"""When the controller steps in real time: on each sample, or on a clock of its own with the newest one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bridge.links.link import Link
from bridge.links.memory import memory_pair
from bridge.process import StopFlag
from bridge.timing.clock import VirtualClock
from controller.laws.law import make_law
from controller.options import ControllerOptions, Trigger
from controller.process import Controller, warm_up
from protocol.errors import PeerLostError
from protocol.wire import mapping
from protocol.wire.codec import FrameReader, FrameWriter
from tests.loop import fly_both, scenario_of

SCENARIO = scenario_of("flapper")
PERIOD_NS = SCENARIO.period_ns


class Timed(Link):
    """A link on a virtual clock: what comes comes at its time; answers are noted with theirs."""

    is_datagram = True
    peer = "the script"

    def __init__(self, clock: VirtualClock, coming: list[tuple[int, bytes]]) -> None:
        super().__init__("mem://timed")
        self.clock = clock
        self.coming = coming
        self.sent: list[tuple[int, bytes]] = []

    def recv(self, timeout_s: float) -> bytes | None:
        until_ns = self.clock.now_ns() + max(1000, round(timeout_s * 1e9))  # a look takes a microsecond
        if self.coming and self.coming[0][0] <= until_ns:
            at_ns, data = self.coming.pop(0)
            self.clock.sleep_until_ns(at_ns)
            return data
        self.clock.sleep_until_ns(until_ns)
        return None

    def send(self, data: bytes | bytearray | memoryview) -> None:
        self.sent.append((self.clock.now_ns(), bytes(data)))

    def close(self) -> None:
        pass


def serve(
    arrivals_ns: Callable[[FrameWriter], list[tuple[int, bytes]]], *, trigger: Trigger, spin_ns: int = 0
) -> tuple[Controller, Timed]:
    """Have a controller answer samples that come at given times, until the emulator says that it ends."""
    law = make_law("ude", SCENARIO)
    warm_up(SCENARIO, law)
    clock = VirtualClock()
    writer = FrameWriter(1, SCENARIO.wire.emulator_component)
    version = writer.seal(mapping.VERSION, mapping.encode_version(SCENARIO.digest()))
    link = Timed(clock, [(0, version), *arrivals_ns(writer)])
    options = ControllerOptions(link="-", clock="realtime", trigger=trigger)
    controller = Controller(SCENARIO, law, link, options, clock, StopFlag(), spin_ns)
    controller.run()
    return controller, link


def counted(controller: Controller) -> dict[str, int]:
    counters = {**controller.counters, **controller.tick.counters}
    return {name: counters[name] for name in ("late_samples", "reused_samples", "skipped_samples")}


def sample(writer: FrameWriter, tick: int) -> bytes:
    t_ns = tick * PERIOD_NS
    return writer.seal(mapping.POSE, mapping.encode_pose(t_ns, np.full(6, 0.1))) + writer.seal(
        mapping.TICK, mapping.encode_tick(t_ns, np.zeros(13))
    )


def ending(writer: FrameWriter) -> bytes:
    return writer.seal(mapping.HEARTBEAT, mapping.encode_emulator_heartbeat(ending=True))


def echoes(link: Timed) -> list[tuple[int, int]]:
    """(wall time, tick answered) of every command that was sent."""
    reader = FrameReader(is_datagram=True)
    found = []
    for at_ns, data in link.sent:
        for frame in reader.read(data):
            if frame.message_id == mapping.COMMAND.message_id:
                found.append((at_ns, int.from_bytes(frame.payload[:8], "little") * 1000 // PERIOD_NS))
    return found


@pytest.mark.parametrize("spin_ns", [0, 100_000])
def test_on_each_sample_each_is_answered_when_it_comes(spin_ns: int) -> None:
    """At odd times, but all in time: no sample is late, none skipped, and each answer leaves as its sample comes."""
    at_ns = [10_000_000 + tick * PERIOD_NS + (tick % 3) * 200_000 for tick in range(30)]

    def arrivals(writer: FrameWriter) -> list[tuple[int, bytes]]:
        return [(at, sample(writer, tick)) for tick, at in enumerate(at_ns)] + [(at_ns[-1] + 1000, ending(writer))]

    controller, link = serve(arrivals, trigger="sample", spin_ns=spin_ns)
    assert echoes(link) == [(at, tick) for tick, at in enumerate(at_ns)]
    assert counted(controller) == {"late_samples": 0, "reused_samples": 0, "skipped_samples": 0}


def test_a_clock_of_its_own_steps_at_its_deadlines_whatever_comes() -> None:
    """Samples half a period after each deadline: each command is half a period old, and every sample is used once."""
    phase_ns = PERIOD_NS // 2

    def arrivals(writer: FrameWriter) -> list[tuple[int, bytes]]:
        coming = [((tick + 3) * PERIOD_NS + phase_ns, sample(writer, tick)) for tick in range(30)]
        return [*coming, (34 * PERIOD_NS, ending(writer))]

    controller, link = serve(arrivals, trigger="clock")
    assert echoes(link) == [((tick + 4) * PERIOD_NS, tick) for tick in range(30)]
    assert counted(controller) == {"late_samples": 0, "reused_samples": 0, "skipped_samples": 0}
    assert controller.keeper is not None
    assert controller.keeper.counters == {"late": 0, "slipped": 0}


@pytest.mark.parametrize(("percent", "reused", "skipped"), [(105, 1, 0), (95, 0, 1)])
def test_clocks_that_slip_use_a_sample_twice_or_skip_one(percent: int, reused: int, skipped: int) -> None:
    """An emulator 5 % slower or faster than the controller's clock: once in twenty periods one too few, or too many."""
    count = 20

    def arrivals(writer: FrameWriter) -> list[tuple[int, bytes]]:
        first_ns = 3 * PERIOD_NS + PERIOD_NS // 2
        coming = [(first_ns + tick * PERIOD_NS * percent // 100, sample(writer, tick)) for tick in range(count)]
        return [*coming, (coming[-1][0] + PERIOD_NS, ending(writer))]

    controller, link = serve(arrivals, trigger="clock")
    answered = [tick for _, tick in echoes(link)]
    assert counted(controller)["reused_samples"] == reused
    assert counted(controller)["skipped_samples"] == skipped
    assert len(answered) - len(set(answered)) == reused, "the command that stands is said again"
    assert len(set(answered)) == count - skipped
    assert controller.law.counts(controller.tick.state)["missed_samples"] == skipped


def test_the_newest_sample_counts_and_a_repeated_one_is_none() -> None:
    def arrivals(writer: FrameWriter) -> list[tuple[int, bytes]]:
        first, second, third = (sample(writer, tick) for tick in range(3))
        base_ns = 3 * PERIOD_NS
        return [
            (base_ns + 1000, first),
            (base_ns + PERIOD_NS + 1000, second),
            (base_ns + PERIOD_NS + 2000, third),
            (base_ns + 2 * PERIOD_NS + 1000, third),
            (base_ns + 3 * PERIOD_NS + 1000, ending(writer)),
        ]

    controller, link = serve(arrivals, trigger="clock")
    assert [tick for _, tick in echoes(link)] == [0, 2, 2]
    assert counted(controller) == {"late_samples": 0, "reused_samples": 1, "skipped_samples": 1}


@pytest.mark.parametrize("trigger", ["sample", "clock"])
def test_three_seconds_of_silence_end_it(trigger: Trigger) -> None:
    with pytest.raises(PeerLostError, match="fell silent for 3 s"):
        serve(lambda writer: [(3 * PERIOD_NS + 1000, sample(writer, 0))], trigger=trigger)


@pytest.mark.parametrize("spin_s", [None, 0.0005])
def test_both_ends_on_clocks_of_their_own_account_for_every_sample(spin_s: float | None) -> None:
    """On the machine's clock, whose delays nobody knows: what must hold whatever they are."""
    near, far = memory_pair()
    with near, far:
        ends = fly_both(
            scenario_of("flapper", duration_s=0.4), near, far, clock="realtime", trigger="clock", spin_s=spin_s
        )
    assert isinstance(ends.emulator, dict)
    assert isinstance(ends.controller, dict)
    counters: dict[str, Any] = ends.controller["counters"]
    assert ends.emulator["ticks"] == 100
    assert ends.controller["trigger"] == "clock"
    assert counters["steps"] + counters["skipped_samples"] <= 100
    assert counters["steps"] + counters["skipped_samples"] >= 98, "the last may come with the end"
    late = ends.controller["lateness_us"]
    assert sum(late["late_by"].values()) == counters["steps"] + counters["reused_samples"]
    assert late["spin"] == (0.0 if spin_s is None else 500.0)
    assert ends.emulator["lateness_us"]["spin"] == late["spin"]
    assert sum(ends.emulator["lateness_us"]["late_by"].values()) == 100
    assert ends.controller["processor_share"] > 0.0
