"""The controller as a process: wait for samples, have `Tick` answer them, and keep time."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from bridge.endpoint import Endpoint
from bridge.latency.segments import CONTROLLER_FILE, SAMPLE_COLUMNS, LegTable, save_legs
from bridge.links.link import Link
from bridge.links.memory import memory_pair
from bridge.links.signed_link import signed
from bridge.process import StopFlag, open_patiently, take_folder
from bridge.reporting import Report
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
from controller.session import HilSession
from controller.sinks.hil import HilSink
from controller.sources.hil import HilSource
from controller.station.ground_station import GroundStation
from controller.tick import Tick, reference_encoders
from protocol.due import NEVER
from protocol.errors import FwavHilError, Interrupted, LinkClosedError, PeerLostError, UsageError
from protocol.messages import VEHICLE
from protocol.scenario import Scenario
from protocol.wire import mapping

RESULT = "controller.json"
STATION_FILE = "station_controller.tlog"
LOOK_PERIOD_S = 0.1
PATIENCE_PERIODS = 1.5
"""In real time a sample that is this many periods late counts as missing: the last command is sent again."""


class Controller:
    """One law on one link.

    The law's period is the scenario's, even where the emulator's differs: the law also steps through periods without a
    sample, and a sample that arrives before its period is over is answered with the last command.

    keeper     schedule of its own clock, with trigger `clock`
    counters   late_samples     real time: periods in which no sample arrived in time
               reused_samples   trigger clock: steps without a new sample, at which the last command was sent again
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
        self._lockstep = lockstep = options.clock == "lockstep"
        self.law, self.stop, self.clock, self.options = law, stop, clock, options
        self.endpoint = endpoint = Endpoint(link, *VEHICLE)
        self.parameters = Parameters(scenario, lambda changed: law.adopt(make_law(law.name, changed)))
        self.time_sync = TimeSync(endpoint.seal, clock)
        emulator = (VEHICLE[0], scenario.wire.emulator_component)
        self.session = HilSession(
            endpoint,
            scenario.digest(),
            emulator,
            arm=options.arm,
            parameters=self.parameters,
            encoders=reference_encoders(law),
            time_sync=None if lockstep else self.time_sync,
        )
        self.source = HilSource(endpoint.reader, emulator)
        self.keeper = RateKeeper(clock, law.period_ns, spin_ns) if options.trigger == "clock" else None
        sink = HilSink(endpoint.writer, lockstep=lockstep)
        self.tick = Tick(law, self.source, sink, self.session, endpoint.writer, self._send, at_once=self.keeper is None)
        self.station = GroundStation(station, self.session, self.parameters) if station else None
        self.legs = LegTable(SAMPLE_COLUMNS) if options.legs else None
        self.counters = {"late_samples": 0, "reused_samples": 0}
        self._look_ns = 0 if station else NEVER
        self._patience_s = LOOK_PERIOD_S if lockstep else PATIENCE_PERIODS * law.period_ns * 1e-9
        self._spin_ns = spin_ns
        self._noted_ns = -1
        self._due_ns = self._woke_ns = 0
        self._run_began_ns = clock.now_ns(), processor_time_ns()

    def run(self) -> None:
        """Meet the emulator, then answer its samples until it reports the end of the run."""
        self.session.meet(self._listen, lambda: self.source.t_ns >= 0, self.clock, self.options.wait_s, self.stop)
        self._run_began_ns = self.clock.now_ns(), processor_time_ns()
        if self.keeper:
            self.keeper.resume()  # the phase of this clock within the emulator's period is random, as between two machines
        while not self.session.ended:
            self.stop.check()
            if self.keeper:
                self._step_by_clock(self.keeper)
            else:
                self._step_by_sample()

    def _step_by_sample(self) -> None:
        """Answer the next sample; in real time, while a sample is late, send the last command again once a period."""
        begun_ns = self.clock.now_ns()
        self._ask_the_time(begun_ns)
        late = self.session.is_silent and not self._lockstep
        data = self._receive(self.law.period_ns * 1e-9 if late else self._patience_s)
        if data:
            self._process(data)
            return
        self._count_silence(begun_ns)
        if not self._lockstep:
            self.counters["late_samples"] += 1
            self.tick.repeat()

    def _step_by_clock(self, keeper: RateKeeper) -> None:
        """At the next deadline of the controller's own clock answer the newest sample, or send the last command again."""
        begun_ns = self.clock.now_ns()
        heard = False
        while not self.session.ended and (wait_s := keeper.remaining_s()) is not None:
            self.stop.check()
            self._ask_the_time(begun_ns)
            data = self._receive(wait_s)
            if data:
                self._process(data)
                heard = True
        if not heard:
            self._count_silence(begun_ns)
        if self.session.ended:
            return
        keeper.tick()
        if self.tick.is_fresh:
            self.tick.answer()
        else:
            self.counters["reused_samples"] += 1
            self.tick.repeat()

    def _listen(self, timeout_s: float) -> None:
        """Receive from the link and the ground station, before the first sample."""
        data = self._receive(timeout_s)
        if data:
            self._process(data)
        if self.station:
            self.station.poll(0)

    def _process(self, data: bytes) -> None:
        """Have `Tick` process the received bytes, then do what can wait until the answer has been sent."""
        self.session.heard()
        self.tick.process(data)
        if self.station and self.tick.answered_ns >= self._look_ns:
            self.station.poll_if_due(self.tick.answered_ns)
            self._look_ns = self.station.next_ns

    def _send(self, answer: bytes) -> None:
        """Send an answer, and record the time stamps of it and of its sample."""
        link = self.endpoint.link
        if not self.legs:
            link.send(answer)
            return
        computed_ns = self.clock.now_ns()
        link.send(answer)
        t_ns = self.tick.answered_ns
        if t_ns != self._noted_ns:
            self._noted_ns = t_ns
            self.legs.add(t_ns, link.received_ns, self._woke_ns, computed_ns, self.clock.now_ns())

    def _ask_the_time(self, now_ns: int) -> None:
        """Send a TIMESYNC, in real time, when one is due."""
        if not self._lockstep and self.source.t_ns >= 0 and now_ns >= self.time_sync.next_ns:
            self.endpoint.send([self.time_sync.question()])

    def _count_silence(self, begun_ns: int) -> None:
        """Count a wait, begun at that time, in which nothing arrived. Raises PeerLostError after 3 s of such waits."""
        if self.station:
            self.station.poll(self.tick.answered_ns)
        waited_ns = self.clock.now_ns() - begun_ns
        self.session.count_silence(waited_ns, round(2e9 * self._patience_s), self.tick.answered_ns)

    def _receive(self, timeout_s: float) -> bytes | None:
        """The bytes received within the timeout, or None; in real time it polls around the time at which a sample is due."""
        link, clock = self.endpoint.link, self.clock
        try:
            if self._lockstep:
                return link.recv(timeout_s)
            data = self._receive_punctually(timeout_s) if self._spin_ns else link.recv(timeout_s)
        except LinkClosedError:
            if self.tick.answered_ns < 0:
                raise
            raise PeerLostError(
                f"the emulator at {link.uri} closed the link in the middle of the run: see why it ended"
            ) from None
        self._woke_ns = clock.now_ns()
        self._due_ns = self._woke_ns + self.law.period_ns if data else self._due_ns
        return data

    def _receive_punctually(self, timeout_s: float) -> bytes | None:
        """`Link.recv`, polling from shortly before to shortly after the time at which the next sample is due."""
        recv, now_ns = self.endpoint.link.recv, self.clock.now_ns
        begun_ns = now_ns()
        end_ns = begun_ns + round(timeout_s * 1e9)
        sleep_ns = self._due_ns - self._spin_ns - begun_ns
        if 0 < sleep_ns < end_ns - begun_ns and (data := recv(sleep_ns * 1e-9)):
            return data
        while now_ns() < self._due_ns + self._spin_ns:
            if data := recv(0.0):
                return data
        return recv(max(0, end_ns - now_ns()) * 1e-9)

    def processor_share(self) -> float:
        """The share of a core that the run has used since its first sample."""
        wall_ns, processor_ns = self._run_began_ns
        return (processor_time_ns() - processor_ns) / max(1, self.clock.now_ns() - wall_ns)

    def summary(self) -> dict[str, int]:
        """All counters of the controller, by name."""
        return {
            **self.endpoint.counters(),
            **self.source.counters(),
            **self.tick.counters,
            **self.law.counts(self.tick.state),
            **self.counters,
            **self.session.requests.counters,
            **self.parameters.counters,
            **(self.station.counters() if self.station else {}),
            **(self.keeper.counters if self.keeper else {}),
        }


def warm_up(scenario: Scenario, law: Law) -> None:
    """Compile every kernel of the loop (or load it from the cache) before the emulator waits for an answer."""
    near, far = memory_pair()
    with near, far:
        endpoint = Endpoint(near, *VEHICLE)
        pose = endpoint.seal(mapping.POSE, mapping.encode_pose(0, np.zeros(6)))
        tick = endpoint.seal(mapping.TICK, mapping.encode_tick(0, np.zeros(13)))
        source = HilSource(endpoint.reader, VEHICLE)
        sink = HilSink(endpoint.writer, lockstep=True)
        session = HilSession(endpoint, scenario.digest(), VEHICLE, arm=False, encoders=reference_encoders(law))
        Tick(law, source, sink, session, endpoint.writer, near.send).process(pose + tick)


def run_controller(scenario: Scenario, options: ControllerOptions, report: Report, stop: StopFlag) -> dict[str, Any]:
    """Build the scenario's law, open the link and `serve`.

    Raises the errors of `protocol.errors`; UsageError for a law that needs velocities.
    """
    refuse_on_a_link(scenario)
    law = make_law(scenario.law, scenario)
    if options.legs and (options.clock != "realtime" or not options.out):
        raise UsageError("--legs writes time stamps of a real-time run to a folder: add --clock realtime and --out DIR")
    if options.out:
        take_folder(options.out, RESULT, CONTROLLER_FILE)
    warm_up(scenario, law)
    uri = _told_link() if options.link == "-" else options.link
    report({"event": "waiting", "link": uri})
    with open_patiently(uri, options.wait_s, stop) as link:
        if options.clock == "lockstep":
            link.spin_s = options.spin_s or 0.0
        if options.legs:
            link.stamp_receives()
        return serve(scenario, law, signed(link, options.key), options, report, stop)


def _told_link() -> str:
    """The URI on the first line of standard input. Raises Interrupted where the input ends without one."""
    uri = sys.stdin.readline().strip()
    if not uri:
        raise Interrupted("interrupted before a link was given on standard input")
    return uri


def serve(
    scenario: Scenario, law: Law, link: Link, options: ControllerOptions, report: Report, stop: StopFlag
) -> dict[str, Any]:
    """Run a law with the emulator on the link; returns the controller's summary.

    Raises the errors of `protocol.errors`, after the summary is written.
    """
    clock = MonotonicClock()
    error: FwavHilError | None = None
    with (
        open_station(
            options.station, VEHICLE, lambda: mapping.encode_controller_heartbeat(armed=controller.session.armed),
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
