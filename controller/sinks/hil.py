"""Commands to the emulator, compiled: HIL_ACTUATOR_CONTROLS, which echoes the time of the sample that it answers."""

from __future__ import annotations

import numpy as np

from controller.laws.law import Law, LawState, control_step
from controller.sinks.sink import CommandSink
from protocol.compiled import Packed, compiled, entry_point, pack
from protocol.messages import FloatArray
from protocol.wire.codec import FrameWriter
from protocol.wire.framing import LONGEST_FRAME, Output
from protocol.wire.mapping import COMMAND
from protocol.wire.tick_frames import write_command


@compiled
def answer(
    law: Packed, state: Packed, q: FloatArray, sink: Packed, t_ns: int, armed: bool, sequence: int, system: int,
    component: int,
) -> int:  # fmt: skip
    """Step the law on q (6,), write the frame of its command into the sink's memory; returns where it ends."""
    data, memory = law[0], sink[0]
    control_step(data, data, data, data.period_ns, state[0], t_ns, q, memory.no_velocity)
    return write_command(memory, t_ns // 1000, state[0].tau, data.scale, armed, sequence, system, component)


class HilSink(CommandSink):
    """One frame for each sample, also when disarmed (zeros then)."""

    def __init__(self, writer: FrameWriter, *, lockstep: bool) -> None:
        self._writer = writer
        self._memory = pack(
            {"no_velocity": np.zeros(6), "lockstep": lockstep, "out": np.zeros(LONGEST_FRAME, dtype=np.uint8)},
            {"command": COMMAND.dtype},
        )
        self._out: Output = self._memory["out"][0]
        self._law: Law | None = None
        self._answer = answer

    def answer(self, law: Law, state: LawState, t_ns: int, q: FloatArray, *, armed: bool) -> bytes:
        """Step the law on the sample q (6,) of time t_ns; returns the frame of the command."""
        writer = self._writer
        arguments = (
            law.packed, state.packed, q, self._memory, t_ns, armed, writer.sequence, writer.system, writer.component,
        )  # fmt: skip
        if law is not self._law:
            self._law, self._answer = law, entry_point(answer, *arguments)
        end = self._answer(*arguments)
        writer.sequence = (writer.sequence + 1) & 0xFF
        return self._out[:end].tobytes()
