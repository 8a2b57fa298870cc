"""The controller as a process: read, step, publish, keep time."""

from __future__ import annotations

import functools
import sys
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from bridge.endpoint import Endpoint
from bridge.latency.segments import CONTROLLER_FILE, SAMPLE_COLUMNS, LegTable, save_legs
from bridge.links.link import Link
from bridge.links.memory import memory_pair
from bridge.links.signed_link import signed
from bridge.process import StopFlag, open_patiently, take_folder
from bridge.reporting import Report
from bridge.requests import NEVER
from bridge.station import Station, open_station
from bridge.summary import write_json
from bridge.timing.clock import Clock, MonotonicClock, processor_time_ns
from bridge.timing.rate import RateKeeper, choose_spin_ns
from bridge.timing.realtime import has_own_core, maybe_real_time, report_settings
from bridge.timing.timesync import TimeSync
from controller.laws.law import Law, make_law
from controller.laws.registry import refuse_on_a_link
from controller.options import ControllerOptions
from controller.parameters import Parameters
from controller.quick import QuickAnswers
from controller.sinks.hil import HilActuation
from controller.sources.hil import HilTelemetry
from controller.station.ground_station import GroundStation
from controller.vehicle import Vehicle
from protocol.errors import FwavHilError, Interrupted, LinkClosedError, PeerLostError, PeerMissingError, UsageError
from protocol.messages import VEHICLE, ActuatorCommand, PositionSample
from protocol.scenario import Scenario
from protocol.wire import mapping
from protocol.wire.streams import HEARTBEAT_TIMEOUT_NS, Due
from protocol.wire.tick_frames import CommandWriter

RESULT = "controller.json"
STATION_FILE = "station_controller.tlog"
HELLO_PERIOD_S = 0.1
LOOK_PERIOD_S = 0.1
PATIENCE_PERIODS = 1.5
"""In real time a sample that is this late counts as missing: the last command is then given again."""


class Controller:
    """One law in front of one link.

    The law's period is the scenario's, whatever the emulator's is: periods without a sample are made up for, and a sample
    that comes before its period is over is answered with the command that stands.

    keeper     of its own clock, with trigger `clock`
    counters   late_samples     real time: periods in which no sample came in time
               reused_samples   trigger clock: steps for which no new sample was there, so that the last command stood
               skipped_samples  trigger clock: samples of which a newer one was there by the time of the step
    """

    def __init__(
        self,
        scenario: Scenario,
        law: Law,
        link: Link,
        options: ControllerOptions,
        clock: Clock,
        stop: StopFlag,
        spin_ns: int = 0,
        station: Station | None = None,
    ) -> None:
        component = scenario.wire.emulator_component
        self.law = law
        self.state = law.start()
        self.stop = stop
        self.clock = clock
        self.options = options
        self.endpoint = Endpoint(link, *VEHICLE)
        self.parameters = Parameters(scenario, lambda changed: law.adopt(make_law(law.name, changed)))
        self.vehicle = Vehicle(self.endpoint, scenario.digest(), component, arm=options.arm, parameters=self.parameters)
        self.station = GroundStation(station, self.vehicle, self.parameters) if station else None
        self._look_ns = 0 if station else NEVER
        self.telemetry = HilTelemetry(component)
        lockstep = options.clock == "lockstep"
        self.actuation = HilActuation(self.endpoint, self.vehicle, law.output.scale, clock, lockstep=lockstep)
        self._quick = QuickAnswers(
            law, self.state, self.endpoint, self.actuation.commands, component, lockstep=lockstep
        )
        self._patience_s = LOOK_PERIOD_S if lockstep else PATIENCE_PERIODS * scenario.period_ns * 1e-9
        self._period_s = self._patience_s if lockstep else scenario.period_ns * 1e-9
        self._lockstep = lockstep
        self._spin_ns = spin_ns
        self._due_ns = 0
        self.keeper = RateKeeper(clock, scenario.period_ns, spin_ns) if options.trigger == "clock" else None
        self._samples: deque[PositionSample] = deque()
        self._silence_ns = 0
        self._begun = self._was_armed = False
        self.time_sync = TimeSync(self.endpoint.seal, clock)
        self.legs = LegTable(SAMPLE_COLUMNS) if options.legs else None
        self._woke_ns = 0
        self._came_ns = (0, 0)
        self._run_began_ns = clock.now_ns(), processor_time_ns()
        self.counters = {"late_samples": 0, "reused_samples": 0, "skipped_samples": 0}

    def run(self) -> None:
        """Meet the emulator, then answer its samples until it says that the run is over."""
        self._meet()
        self._run_began_ns = self.clock.now_ns(), processor_time_ns()
        read: Callable[[], PositionSample | None] = self._read
        if self.keeper:
            self.keeper.resume()  # where in the emulator's period this clock ticks is chance, as between two machines
            read = functools.partial(self._read_by_clock, self.keeper)
        while (sample := read()) or not self.vehicle.ended:
            if sample is None or sample.t_ns == self.actuation.answered_ns:
                self.actuation.repeat()
                continue
            armed = self.vehicle.armed
            if not (armed and self._was_armed):
                self.law.restart(self.state)  # what a disarmed law remembers never acted
            self._was_armed = armed
            tau = self.law.step(self.state, sample.t_ns, sample.q)
            computed_ns = self.clock.now_ns()
            self.actuation.publish(ActuatorCommand(sample.t_ns, tau, armed), self.state.desired)
            self._note(sample.t_ns, computed_ns)
            self._hear_station(sample.t_ns)
            self._get_ready()

    def _hear_station(self, t_ns: int) -> None:
        if self.station:
            self.station.poll_if_due(t_ns)
            self._look_ns = self.station.next_ns

    def _meet(self) -> None:
        """Say hello until the first sample comes."""
        give_up_ns = self.clock.now_ns() + round(self.options.wait_s * 1e9)
        hello = Due(1.0 / HELLO_PERIOD_S)
        said = False
        while (now_ns := self.clock.now_ns()) < give_up_ns:
            self.stop.check()
            if hello.at(now_ns) or said != self.vehicle.agreed:
                self.endpoint.send(self.vehicle.hello())
                said = self.vehicle.agreed
            self._look(HELLO_PERIOD_S)
            if self.station:
                self.station.poll(0)
            if self._samples or self.vehicle.ended:
                return
        uri = self.endpoint.link.uri
        if self.vehicle.agreed:
            raise PeerMissingError(
                f"the emulator at {uri} sent no tick within {self.options.wait_s:g} s: arm this controller with --arm"
            )
        raise PeerMissingError(
            f"no emulator at {uri} within {self.options.wait_s:g} s: start one with `fwav-hil emulator SCENARIO "
            f"--link {uri.replace('out://', 'in://', 1)}`, or wait longer with --wait"
        )

    def _read(self) -> PositionSample | None:
        """The next sample; None where the run is over or, in real time, where none came in time."""
        while not self._samples and not self.vehicle.ended:
            self.stop.check()
            begun_ns = self.clock.now_ns()
            self._ask_the_time(begun_ns)
            # Once a sample is late, the command that stands is given again each period.
            if self._await(self._period_s if self._silence_ns else self._patience_s):
                self._silence_ns = 0
                continue
            self._count_silence(begun_ns)
            if not self._lockstep:
                self.counters["late_samples"] += 1
                return None
        return self._samples.popleft() if self._samples else None

    def _read_by_clock(self, keeper: RateKeeper) -> PositionSample | None:
        """The newest sample at the next deadline of this end's own clock; None where the run is over or none is new."""
        heard = False
        begun_ns = self.clock.now_ns()
        while not self.vehicle.ended and (wait_s := keeper.remaining_s()) is not None:
            self.stop.check()
            self._ask_the_time(begun_ns)
            heard = self._look(wait_s) or heard
        if heard:
            self._silence_ns = 0
        else:
            self._count_silence(begun_ns)
        if self.vehicle.ended:
            return None
        keeper.tick()
        new = {sample.t_ns: sample for sample in self._samples if sample.t_ns > self.actuation.answered_ns}
        self._samples.clear()
        if not new:
            self.counters["reused_samples"] += 1
            return None
        self.counters["skipped_samples"] += len(new) - 1
        return new[max(new)]

    def _ask_the_time(self, now_ns: int) -> None:
        """Send a TIMESYNC, in real time, when one is due."""
        if not self._lockstep and self._begun and now_ns >= self.time_sync.next_ns:
            self.endpoint.send([self.time_sync.question()])

    def _count_silence(self, begun_ns: int) -> None:
        """Add up a wait in which nothing came. Raises PeerLostError after 3 s of them.

        One by one: a stall of the whole machine then counts as one wait, not as silence.
        """
        if self.station:
            self.station.poll(self.actuation.answered_ns)
        self._silence_ns += min(self.clock.now_ns() - begun_ns, round(2e9 * self._patience_s))
        if self._silence_ns > HEARTBEAT_TIMEOUT_NS:
            raise PeerLostError(
                f"the emulator at {self.endpoint.link.uri} fell silent for 3 s after t = "
                f"{self.actuation.answered_ns * 1e-9:.3f} s: see whether it still runs"
            )

    def _await(self, timeout_s: float) -> bool:
        """`_look`, polling around the time at which the next sample is due."""
        if not self._spin_ns or self._lockstep:
            return self._look(timeout_s)
        now_ns = self.clock.now_ns()
        end_ns = now_ns + round(timeout_s * 1e9)
        sleep_ns = self._due_ns - self._spin_ns - now_ns
        if 0 < sleep_ns < end_ns - now_ns and self._look(sleep_ns * 1e-9):
            return True
        while self.clock.now_ns() < self._due_ns + self._spin_ns:
            if self._look(0.0):
                return True
        return self._look(max(0, end_ns - self.clock.now_ns()) * 1e-9)

    def _look(self, timeout_s: float) -> bool:
        """Take what comes within the timeout; whether anything came."""
        try:
            data = self.endpoint.link.recv(timeout_s)
        except LinkClosedError:
            if self.actuation.answered_ns < 0:
                raise
            raise PeerLostError(
                f"the emulator at {self.endpoint.link.uri} closed the link in the middle of the run: see why it ended"
            ) from None
        if not data:
            return False
        if not self._lockstep:
            self._woke_ns = self.clock.now_ns()
        if self.keeper is None and self._answer_at_once(data):
            return True
        for frame in self.endpoint.reader.read(data):
            if self.telemetry.is_telemetry(frame):
                sample = self.telemetry.take(frame)
                if sample is not None:
                    if not self._begun:
                        self._begun = True
                        self.endpoint.reader.restart_sequences([(frame.system, frame.component, frame.sequence + 1)])
                    self._samples.append(sample)
                    self._note_arrival()
            elif frame.message_id == mapping.TIMESYNC.message_id and not self._lockstep:
                answer = self.time_sync.take(frame, self.endpoint.link.received_ns or self._woke_ns)
                if answer:
                    self.endpoint.send([answer])
            else:
                self.vehicle.take(frame)
        self._get_ready()
        return True

    def _answer_at_once(self, data: bytes) -> bool:
        """Answer a plain sample on the short way; False, with nothing done, where it is not one."""
        t_ns, answer = self._quick.to(data)
        if t_ns < 0:
            return False
        self._note_arrival()
        computed_ns = self.clock.now_ns() if self.legs else 0
        self.actuation.send(t_ns, answer)
        self._note(t_ns, computed_ns)
        self.telemetry.taken(t_ns)
        self._get_ready()
        return True

    def _note_arrival(self) -> None:
        """Note when the sample just read came, and so when the next one is due."""
        self._due_ns = self._woke_ns + self.law.period_ns
        if self.legs:
            self._came_ns = (self.endpoint.link.received_ns, self._woke_ns)

    def _note(self, t_ns: int, computed_ns: int) -> None:
        """Note when the sample of t_ns and its command, just sent, were where."""
        if self.legs:
            self.legs.add(t_ns, *self._came_ns, computed_ns, self.actuation.sent_ns)

    def _get_ready(self) -> None:
        """Say which samples may be answered at once: those after the last one, while armed and nothing else is due."""
        armed = self._was_armed and self.vehicle.armed and not self._samples
        quiet_until_ns = min(self.actuation.quiet_until_ns, self._look_ns) if armed else 0
        self._quick.get_ready(self.actuation.answered_ns, quiet_until_ns)

    def processor_share(self) -> float:
        """The share of a core that the run has taken since its first sample."""
        wall_ns, processor_ns = self._run_began_ns
        return (processor_time_ns() - processor_ns) / max(1, self.clock.now_ns() - wall_ns)

    def summary(self) -> dict[str, int]:
        """Everything counted at this end, by name."""
        return {
            **self.endpoint.counters(),
            **self.telemetry.counters,
            **self.actuation.counters,
            **self.law.counts(self.state),
            **self.counters,
            **self.vehicle.requests.counters,
            **self.parameters.counters,
            **(self.station.counters() if self.station else {}),
            **(self.keeper.counters if self.keeper else {}),
        }


def warm_up(law: Law) -> None:
    """Have every kernel of the loop compiled (or loaded) before the emulator waits for an answer."""
    mapping.decode_pose(mapping.encode_pose(0, np.zeros(6)))
    mapping.encode_attitude_target(0, np.zeros(6))
    state = law.start()
    command = ActuatorCommand(0, law.step(state, 0, np.zeros(6)), armed=True)
    near, far = memory_pair()
    with near, far:
        endpoint = Endpoint(near, *VEHICLE)
        commands = CommandWriter(endpoint.writer, law.output.scale, lockstep=True)
        commands.frame(command)
        endpoint.reader.expect(VEHICLE, 0)
        quick = QuickAnswers(law, state, endpoint, commands, VEHICLE[1], lockstep=True)
        quick.get_ready(-1, 0)
        quick.to(b"")


def run_controller(scenario: Scenario, options: ControllerOptions, report: Report, stop: StopFlag) -> dict[str, Any]:
    """Build the scenario's law, open the link and `serve`.

    Raises the errors of `protocol.errors`; a law that needs velocities is refused.
    """
    refuse_on_a_link(scenario)
    law = make_law(scenario.law, scenario)
    if options.legs and (options.clock != "realtime" or not options.out):
        raise UsageError("--legs notes times of a real-time run in a folder: add --clock realtime and --out DIR")
    if options.out:
        take_folder(options.out, RESULT, CONTROLLER_FILE)
    warm_up(law)
    uri = _told_link() if options.link == "-" else options.link
    report({"event": "waiting", "link": uri})
    with open_patiently(uri, options.wait_s, stop) as link:
        if options.clock == "lockstep":
            link.spin_s = options.spin_s or 0.0
        if options.legs:
            link.stamp_receives()
        return serve(scenario, law, signed(link, options.key), options, report, stop)


def _told_link() -> str:
    """The URI on the first line of standard input. Raises Interrupted where it ends without one."""
    uri = sys.stdin.readline().strip()
    if not uri:
        raise Interrupted("interrupted before a link was named on standard input")
    return uri


def serve(
    scenario: Scenario, law: Law, link: Link, options: ControllerOptions, report: Report, stop: StopFlag
) -> dict[str, Any]:
    """Run a law in front of whatever emulator is at the link; returns the summary of this end.

    Raises the errors of `protocol.errors`, after the summary is written.
    """
    clock = MonotonicClock()
    error: FwavHilError | None = None
    with (
        open_station(
            options.station, VEHICLE, lambda: mapping.encode_controller_heartbeat(armed=controller.vehicle.armed),
            options.out / STATION_FILE if options.out else None, options.wait_s, stop,
        ) as station,
        maybe_real_time(options.core, wanted=options.realtime) as settings,
    ):  # fmt: skip
        report_settings(report, settings)
        lockstep = options.clock == "lockstep"
        spin_ns = choose_spin_ns(
            clock, law.period_ns, 0.0 if lockstep else options.spin_s, measure=has_own_core(settings)
        )
        controller = Controller(scenario, law, link, options, clock, stop, spin_ns, station)
        try:
            controller.run()
        except FwavHilError as stopped:
            error = stopped
        processor_share = controller.processor_share()
    summary = {
        "law": law.name,
        "trigger": options.trigger,
        "lateness_us": controller.keeper.summary() if controller.keeper else None,
        "spin_us": spin_ns / 1e3,
        "realtime": settings,
        "processor_share": processor_share,
        "counters": controller.summary(),
        "error": str(error) if error else None,
    }
    if options.out:
        write_json(options.out / RESULT, summary)
        if controller.legs:
            save_legs(options.out / CONTROLLER_FILE, {"samples": controller.legs}, controller.time_sync.estimate)
    report({"event": "ended", **summary})
    if error:
        raise error
    return summary
