"""The short way from a sample to its command against the long one: the same bytes; and only for plain samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from bridge.endpoint import Endpoint
from bridge.links.memory import memory_pair
from controller.laws.law import Law, LawState, make_law
from controller.quick import NOT_PLAIN, QuickAnswers
from protocol.messages import VEHICLE, ActuatorCommand, FloatArray
from protocol.wire import mapping
from protocol.wire.codec import FrameWriter
from protocol.wire.tick_frames import CommandWriter, TickWriter
from tests.loop import scenario_of

FLAPPER = scenario_of("flapper")
EMULATOR = FLAPPER.wire.emulator_component
PERIOD_NS = FLAPPER.period_ns
FOREVER_NS = 2**60


class End(NamedTuple):
    """A law behind the short way."""

    law: Law
    state: LawState
    endpoint: Endpoint
    quick: QuickAnswers


def new_end(law_name: str = "ude") -> End:
    near, _ = memory_pair()
    endpoint = Endpoint(near, *VEHICLE)
    endpoint.reader.restart_sequences([(VEHICLE[0], EMULATOR, 0)])
    law = make_law(law_name, FLAPPER)
    state = law.start()
    commands = CommandWriter(endpoint.writer, law.output.scale, lockstep=True)
    return End(law, state, endpoint, QuickAnswers(law, state, endpoint, commands, EMULATOR, lockstep=True))


def tick(writer: FrameWriter, t_ns: int, q: FloatArray) -> bytes:
    return b"".join(TickWriter(writer).frames(t_ns, q, np.zeros(13)))


@pytest.mark.parametrize("law_name", ["ude", "pd", "dob"])
def test_the_short_way_gives_the_same_bytes_as_the_long_one(law_name: str) -> None:
    end, random = new_end(law_name), np.random.default_rng(2)
    law = make_law(law_name, FLAPPER)
    state, writer = law.start(), FrameWriter(VEHICLE[0], EMULATOR)
    commands = CommandWriter(FrameWriter(*VEHICLE), law.output.scale, lockstep=True)
    t_ns = -PERIOD_NS
    for periods in random.integers(1, 4, 200):  # samples go missing
        after_ns, t_ns = t_ns, t_ns + int(periods) * PERIOD_NS
        q = FLAPPER.initial_motion[:6] + 0.01 * random.normal(size=6)
        end.quick.get_ready(after_ns, FOREVER_NS)
        answered_ns, frame = end.quick.to(tick(writer, t_ns, q))
        sample = mapping.decode_pose(mapping.encode_pose(t_ns, q))
        assert sample is not None
        assert answered_ns == t_ns
        assert frame == commands.frame(ActuatorCommand(t_ns, law.step(state, t_ns, sample.q), armed=True))
    assert end.state.packed.tobytes() == state.packed.tobytes()
    assert end.endpoint.reader.expected((VEHICLE[0], EMULATOR)) == 400 % 256


@pytest.mark.parametrize("why", ["answered", "others are due", "number", "damaged", "more", "no pose", "not ready"])
def test_any_other_datagram_changes_nothing(why: str) -> None:
    end, writer = new_end(), FrameWriter(VEHICLE[0], EMULATOR)
    if why == "number":
        writer.sequence = 2
    q = np.full(6, np.nan) if why == "no pose" else np.zeros(6)
    data = tick(writer, PERIOD_NS, q)
    if why == "damaged":
        data = data[:30] + bytes([data[30] ^ 1]) + data[31:]
    elif why == "more":
        data += tick(writer, 2 * PERIOD_NS, q)
    if why != "not ready":
        after_ns = PERIOD_NS if why == "answered" else 0
        end.quick.get_ready(after_ns, PERIOD_NS if why == "others are due" else FOREVER_NS)
    before = end.state.packed.copy()
    assert end.quick.to(data) == (NOT_PLAIN, b"")
    assert end.state.packed.tobytes() == before.tobytes()
    assert end.endpoint.writer.sequence == 0
    assert end.endpoint.reader.expected((VEHICLE[0], EMULATOR)) == 0


def test_a_plain_sample_is_answered_at_once() -> None:
    end = new_end()
    end.quick.get_ready(0, FOREVER_NS)
    t_ns, frame = end.quick.to(tick(FrameWriter(VEHICLE[0], EMULATOR), PERIOD_NS, np.zeros(6)))
    assert t_ns == PERIOD_NS
    command = mapping.decode_command(frame[10:-2], np.array(FLAPPER.actuators.scale))
    assert command is not None
    assert (command.t_ns, command.armed) == (PERIOD_NS, True)
