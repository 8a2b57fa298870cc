"""Where commands go: HIL_ACTUATOR_CONTROLS to the emulator, with what else is due travelling in front of it."""

from __future__ import annotations

from bridge.endpoint import Endpoint
from bridge.timing.clock import Clock
from controller.vehicle import Vehicle
from protocol.messages import ActuatorCommand, FloatArray
from protocol.wire import mapping
from protocol.wire.streams import Due, stream
from protocol.wire.tick_frames import CommandWriter


class HilActuation:
    """Publishes commands, and the reference for the log; keeps the last answer, to give it again.

    sent_ns    when the last answer was handed to the link, on the clock

    counters   repeated  answers given again, because their tick came again or the next one is missing
    """

    def __init__(
        self, endpoint: Endpoint, vehicle: Vehicle, scale: FloatArray, clock: Clock, *, lockstep: bool
    ) -> None:
        self._endpoint = endpoint
        self._vehicle = vehicle
        self.commands = CommandWriter(endpoint.writer, scale, lockstep=lockstep)
        self._reference = Due(stream("POSITION_TARGET_LOCAL_NED").rate_hz or 1.0)
        self._clock = clock
        self._last = b""
        self.sent_ns = 0
        self.answered_ns = -1
        self.counters = {"repeated": 0}

    def publish(self, command: ActuatorCommand, desired: FloatArray) -> None:
        """Answer the sample of command.t_ns; desired (3, 6) is q_d, q_d', q_d'' at that time."""
        seal, t_ns = self._endpoint.seal, command.t_ns
        if self.answered_ns < 0:
            self._endpoint.writer.sequence = 0  # the numbers of the run begin with its first answer
        frames = self._vehicle.due_frames(t_ns)
        if self._reference.at(t_ns):
            frames.append(seal(mapping.POSITION_TARGET, mapping.encode_position_target(t_ns, *desired)))
            frames.append(seal(mapping.ATTITUDE_TARGET, mapping.encode_attitude_target(t_ns, desired[0])))
        frames.append(self.commands.frame(command))
        self.send(t_ns, b"".join(frames))

    def send(self, t_ns: int, answer: bytes) -> None:
        """Send the whole answer to the sample of t_ns, and keep it."""
        self._last = answer
        self.answered_ns = t_ns
        self.sent_ns = self._clock.now_ns()
        self._endpoint.link.send(answer)

    @property
    def quiet_until_ns(self) -> int:
        """An answer to a sample before this time is the command alone."""
        return min(self._vehicle.quiet_until_ns, self._reference.next_ns)

    def repeat(self) -> None:
        """Give the last answer again, the same bytes, without a step of the law."""
        if self._last:
            self.counters["repeated"] += 1
            self._endpoint.link.send(self._last)
