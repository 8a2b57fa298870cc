"""The controller's part of a tick in one compiled call: read the sample, step the law, write the command.

The kernels are those that everything else is made of (`law`, `protocol.wire.tick_frames`), called one after the other without
the way through Python. It takes the plain case only, a pose and its tick that are next in line and nothing beside them; for all
else it changes nothing and says so, and the caller goes the long way.
"""

from __future__ import annotations

import numpy as np

from bridge.endpoint import Endpoint
from controller.laws.law import Law, LawState, packed_control_step
from protocol.compiled import Packed, compiled
from protocol.messages import VEHICLE, FloatArray
from protocol.wire.framing import Bytes
from protocol.wire.tick_frames import CommandWriter, parse_tick, write_command

NOT_PLAIN = -1


@compiled
def _answer(
    command: Packed, payload: Bytes, out: Bytes, data: Bytes, law: Packed, state: Packed, sample: FloatArray,
    after_us: int, before_us: int, expected: int, emulator: int, lockstep: bool, sequence: int, system: int,
    component: int,
) -> tuple[int, int]:  # fmt: skip
    """(time of the sample in us, where the command in `out` ends), the law stepped; (NOT_PLAIN, 0) with nothing changed."""
    t_us, number = parse_tick(data, system, emulator, sample[0])
    if number != expected or t_us <= after_us or t_us >= before_us:
        return NOT_PLAIN, 0
    packed_control_step(law, state, t_us * 1000, sample[0], sample[1])
    end = write_command(
        command, payload, out, t_us, state[0].tau, law[0].scale, True, lockstep, sequence, system, component
    )  # fmt: skip
    return t_us, end


class QuickAnswers:
    """Answers plain samples, armed, with a law and its state."""

    def __init__(
        self, law: Law, state: LawState, endpoint: Endpoint, commands: CommandWriter, emulator: int, *, lockstep: bool
    ) -> None:
        self._reader, self._writer = endpoint.reader, endpoint.writer
        self._commands = commands
        self._sender = (VEHICLE[0], emulator)
        self._lockstep = lockstep
        self._sample = np.zeros((2, 6))
        """The sample, and in place of velocities, which no law on a link reads, zeros."""
        self._after_us = self._before_us = 0
        self._expected = -1
        self._arguments = (law.packed, state.packed, self._sample)

    def get_ready(self, after_ns: int, before_ns: int) -> None:
        """Plain is from now on a sample between these two times whose frames are the next of the emulator's."""
        self._after_us, self._before_us = after_ns // 1000, before_ns // 1000
        self._expected = self._reader.expected(self._sender)

    def to(self, datagram: bytes) -> tuple[int, bytes]:
        """(time of the sample in ns, command frame) for a plain sample; `get_ready` must follow. Else (NOT_PLAIN, b"")."""
        if self._expected < 0:
            return NOT_PLAIN, b""
        t_us, end = _answer(
            *self._commands.buffers, np.frombuffer(datagram, np.uint8), *self._arguments, self._after_us,
            self._before_us, self._expected, self._sender[1], self._lockstep, self._writer.sequence, *VEHICLE,
        )  # fmt: skip
        if t_us < 0:
            return NOT_PLAIN, b""
        self._reader.expect(self._sender, self._expected + 2)
        return t_us * 1000, self._commands.taken(end)
