"""The controller's session with the emulator: meet, agree on the scenario, arm, watch, leave.

To its peers it is a MAVLink vehicle. It starts disarmed. With `--arm` it arms once the emulator has reported the same
scenario; otherwise MAV_CMD_COMPONENT_ARM_DISARM from a ground station arms it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

from bridge.endpoint import Endpoint, refuse_other_scenario
from bridge.links.link import counterpart
from bridge.process import StopFlag
from bridge.requests import Handler, Requests
from bridge.timing.clock import Clock
from bridge.timing.timesync import TimeSync
from controller.parameters import Parameters
from protocol.due import Due
from protocol.errors import PeerLostError, PeerMissingError
from protocol.wire import mapping
from protocol.wire.codec import Frame
from protocol.wire.parameter_mapping import VALUE
from protocol.wire.requests import ARM_DISARM, Request, Result, wanted_arming
from protocol.wire.schedule import Encoder, Saying, Schedule
from protocol.wire.streams import HEARTBEAT_TIMEOUT_NS

OFFERED = ("HEARTBEAT", "AUTOPILOT_VERSION")
"""Messages that are sent on request."""
PARAMETERS_HZ = 50.0
"""How many parameters a second are sent at the start of a run, at most one with each answer."""
HELLO_PERIOD_S = 0.1


class HilSession:
    """Heartbeats, arming, the scenario's digest; from the first tick on also each parameter once, so that the log has them all.

    who        our own (system, component)             emulator   the peer's
    encoders   of the other streams sent with the answers                time_sync   in real time: answers TIMESYNC

    armed      commands act                            agreed     the emulator has reported the same scenario
    ended      the emulator has reported the end of the run
    schedule   messages sent on the loop's link besides the answers
    commands   those it obeys, on any link             requests   those received on the loop's link
    """

    def __init__(
        self,
        endpoint: Endpoint,
        digest: bytes,
        emulator: tuple[int, int],
        *,
        arm: bool,
        parameters: Parameters | None = None,
        encoders: Mapping[str, Encoder] | None = None,
        time_sync: TimeSync | None = None,
    ) -> None:
        self.who = (endpoint.writer.system, endpoint.writer.component)
        self.emulator = emulator
        self._endpoint = endpoint
        self._digest = digest
        self._arm_at_start = arm
        self._time_sync = time_sync
        self._parameters = parameters
        self._changed: list[int] = []
        self._unsaid = deque(range(len(parameters.table)) if parameters else ())
        self.encoders: Mapping[str, Encoder] = {
            "HEARTBEAT": lambda _t_ns: [self._heartbeat()],
            "AUTOPILOT_VERSION": lambda _t_ns: [self._version()],
        }
        said = {**self.encoders, "PARAM_VALUE": self._next_parameters, **(encoders or {})}
        self.schedule = Schedule(said, {"PARAM_VALUE": PARAMETERS_HZ if self._unsaid else None})
        self.commands: Mapping[int, Handler] = {ARM_DISARM: self.arm_or_disarm}
        self.requests = Requests(self.who, self.schedule, OFFERED, self.commands)
        self.armed = self.agreed = self.ended = False
        self._silence_ns = 0

    def meet(
        self, listen: Callable[[float], None], met: Callable[[], bool], clock: Clock, wait_s: float, stop: StopFlag
    ) -> None:
        """Send heartbeats until the first sample arrives (`met`) or the run ends; `listen` receives for a time (s).

        Raises PeerMissingError, Interrupted.
        """
        give_up_ns = clock.now_ns() + round(wait_s * 1e9)
        hello = Due(1.0 / HELLO_PERIOD_S)
        said = False
        while (now_ns := clock.now_ns()) < give_up_ns:
            stop.check()
            if hello.at(now_ns) or said != self.agreed:
                sayings = [self._heartbeat(), self._version(), *self.schedule.answers()]
                self._endpoint.send(self._endpoint.seal(*saying) for saying in sayings)
                said = self.agreed
            listen(HELLO_PERIOD_S)
            if met() or self.ended:
                return
        uri = self._endpoint.link.uri
        if self.agreed:
            raise PeerMissingError(
                f"the emulator at {uri} sent no tick within {wait_s:g} s: arm this controller with --arm"
            )
        raise PeerMissingError(
            f"no emulator at {uri} within {wait_s:g} s: start one with `fwav-hil emulator SCENARIO "
            f"--link {counterpart(uri)}`, or wait longer with --wait"
        )

    def due_frames(self, t_ns: int) -> list[bytes]:
        """Heartbeat, replies and requested messages that are due at t_ns."""
        if t_ns < self.schedule.next_ns:
            return []
        return [self._endpoint.seal(*saying) for saying in self.schedule.due(t_ns)]

    def hear(self, frame: Frame) -> None:
        """React to a frame that carries no pose. Raises ScenarioMismatchError."""
        if self.requests.handle(frame) or (frame.system, frame.component) != self.emulator:
            return
        if frame.message_id == mapping.VERSION.message_id:
            refuse_other_scenario("emulator", mapping.decode_version(frame.payload), self._digest)
            if not self.agreed and self._arm_at_start:
                self.armed = True
            self.agreed = True
        elif frame.message_id == mapping.HEARTBEAT.message_id and mapping.heartbeat_is_ending(frame.payload):
            self.ended = True
        elif frame.message_id == mapping.TIMESYNC.message_id and self._time_sync:
            answer = self._time_sync.handle(frame, self._endpoint.link.received_ns)
            if answer:
                self._endpoint.send([answer])

    def heard(self) -> None:
        """Note that a frame of the peer has just arrived."""
        self._silence_ns = 0

    @property
    def is_silent(self) -> bool:
        """Whether nothing arrived during the last wait."""
        return self._silence_ns > 0

    def count_silence(self, waited_ns: int, most_ns: int, t_ns: int) -> None:
        """Add up a wait in which nothing arrived, after the sample of t_ns. Raises PeerLostError after 3 s of such waits.

        Each wait counts for `most_ns` at most, so that a stall of the whole machine counts as one wait, not as silence.
        """
        self._silence_ns += min(waited_ns, most_ns)
        if self._silence_ns > HEARTBEAT_TIMEOUT_NS:
            raise PeerLostError(
                f"the emulator at {self._endpoint.link.uri} fell silent for 3 s after t = {t_ns * 1e-9:.3f} s: "
                "check that it still runs"
            )

    def say_parameter(self, index: int) -> None:
        """Send a changed parameter on the loop's link, and so to the run's log, with the next answer."""
        self._changed.append(index)
        self.schedule.ask_once(VALUE.message_id)

    def arm_or_disarm(self, request: Request) -> Result:
        """Obey MAV_CMD_COMPONENT_ARM_DISARM: disarm at any time, arm once the emulator has reported the same scenario."""
        wanted = wanted_arming(request)
        if wanted is None or (wanted and not self.agreed):
            return Result.DENIED
        self.armed = wanted
        return Result.ACCEPTED

    def _next_parameters(self, _t_ns: int) -> list[Saying]:
        """The parameters that were changed; else the next one that has not been sent yet."""
        indices, self._changed = self._changed, []
        if not indices and self._unsaid:
            indices = [self._unsaid.popleft()]
        if not self._unsaid:
            self.schedule.set_rate(VALUE.message_id, None)
        return [self._parameters.saying(index) for index in indices] if self._parameters else []

    def _heartbeat(self) -> Saying:
        return mapping.HEARTBEAT, mapping.encode_controller_heartbeat(armed=self.armed)

    def _version(self) -> Saying:
        return mapping.VERSION, mapping.encode_version(self._digest, has_parameters=True)
