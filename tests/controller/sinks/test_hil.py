"""The command of each law: the bytes of the plain writer and mapping, numbered, with the law stepped once."""

from __future__ import annotations

import numpy as np
import pytest

from controller.laws.law import make_law
from controller.laws.registry import LAWS
from controller.sinks.hil import HilSink
from protocol.messages import FloatArray
from protocol.wire import mapping
from protocol.wire.codec import FrameReader, FrameWriter
from tests.frames import command_frame, vehicle_writer
from tests.loop import scenario_of

FLAPPER = scenario_of("flapper")
PERIOD_NS = FLAPPER.period_ns
BLIND_LAWS = sorted(name for name, entry in LAWS.items() if not entry.needs_velocity)


def samples(count: int, *, gaps: bool = False) -> list[tuple[int, FloatArray]]:
    """Poses about the start, some of them missing."""
    random = np.random.default_rng(2)
    periods = random.integers(1, 4 if gaps else 2, count)
    times = (np.cumsum(periods) - periods[0]) * PERIOD_NS
    return [(int(t_ns), FLAPPER.initial_motion[:6] + 0.01 * random.normal(size=6)) for t_ns in times]


@pytest.mark.parametrize("lockstep", [True, False])
@pytest.mark.parametrize("name", BLIND_LAWS)
def test_the_bytes_are_those_of_the_plain_writer_and_the_law(name: str, lockstep: bool) -> None:
    law = make_law(name, FLAPPER)
    sink, writer = HilSink(vehicle_writer(), lockstep=lockstep), vehicle_writer()
    ours, theirs = law.start(), law.start()
    for t_ns, q in samples(40, gaps=True):
        tau = law.step(theirs, t_ns, q)
        expected = command_frame(writer, t_ns, tau, law.output.scale, lockstep=lockstep)
        assert sink.answer(law, ours, t_ns, q, armed=True) == expected
    assert ours.packed.tobytes() == theirs.packed.tobytes()


def test_disarmed_the_law_steps_and_the_frame_carries_zeros() -> None:
    law = make_law("ude", FLAPPER)
    sink, state = HilSink(vehicle_writer(), lockstep=True), law.start()
    ((t_ns, q),) = samples(1)
    raw = sink.answer(law, state, t_ns, q, armed=False)
    assert raw == command_frame(vehicle_writer(), t_ns, np.zeros(6), law.output.scale, armed=False)
    (frame,) = FrameReader(is_datagram=True).read(raw)
    assert not mapping.is_armed(frame.payload)
    assert law.counts(state)["steps"] == 1


def test_an_armed_frame_behind_a_disarmed_one_carries_the_command_again() -> None:
    law = make_law("pd", FLAPPER)
    sink, state, writer = HilSink(vehicle_writer(), lockstep=True), law.start(), vehicle_writer()
    (first, q), (second, other) = samples(2)
    sink.answer(law, state, first, q, armed=False)
    writer.sequence = 1
    raw = sink.answer(law, state, second, other, armed=True)
    assert raw == command_frame(writer, second, state.tau, law.output.scale)


def test_frames_are_numbered_from_the_writers_number_on_and_wrap_at_256() -> None:
    law = make_law("pd", FLAPPER)
    writer = FrameWriter(7, 8)
    writer.sequence = 250
    sink, state = HilSink(writer, lockstep=True), law.start()
    reader = FrameReader(is_datagram=True)
    frames = [frame for t_ns, q in samples(20) for frame in reader.read(sink.answer(law, state, t_ns, q, armed=True))]
    assert [frame.sequence for frame in frames] == [(250 + k) % 256 for k in range(20)]
    assert {(frame.system, frame.component) for frame in frames} == {(7, 8)}
    assert writer.sequence == (250 + 20) % 256


def test_what_others_seal_in_between_is_counted_in_the_numbers() -> None:
    law = make_law("pd", FLAPPER)
    writer = vehicle_writer()
    sink, state = HilSink(writer, lockstep=True), law.start()
    (first, q), (second, other) = samples(2)
    assert sink.answer(law, state, first, q, armed=True)[4] == 0
    assert writer.seal(mapping.HEARTBEAT, mapping.encode_controller_heartbeat(armed=True))[4] == 1
    assert sink.answer(law, state, second, other, armed=True)[4] == 2
