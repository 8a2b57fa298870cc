"""The emulator as a process: meet the controller, run the ticks, end cleanly, report the results."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bridge.endpoint import Endpoint
from bridge.latency.segments import ANSWER_COLUMNS, CLOCK_COLUMNS, EMULATOR_FILE, TICK_COLUMNS, LegTable, save_legs
from bridge.links.faults import DelayedLink
from bridge.links.link import Link
from bridge.links.memory import memory_pair
from bridge.links.signed_link import signed
from bridge.process import StopFlag, open_patiently
from bridge.recording.ring_recorder import RingRecorder
from bridge.recording.sidecar import LinkOfLog
from bridge.reporting import Report
from bridge.station import open_station
from bridge.summary import make_folder, percentiles_us, refuse_existing_run, write_json, write_text
from bridge.timing.clock import MonotonicClock, processor_time_ns
from bridge.timing.rate import RateKeeper, choose_spin_ns
from bridge.timing.realtime import Settings, has_own_core, maybe_real_time, report_settings
from plant_emulator.options import EmulatorOptions
from plant_emulator.pacing.lockstep import Lockstep
from plant_emulator.pacing.meeting import meet_autopilot, meet_controller
from plant_emulator.pacing.pacing import Pacing, Parts
from plant_emulator.pacing.real_time import RealTime
from plant_emulator.pacing.tolerant import Tolerant
from plant_emulator.plant.truth import TruthWriter
from plant_emulator.tick import Emulator
from protocol.errors import FwavHilError, RunFolderError, UsageError
from protocol.logs.tlog import TlogWriter
from protocol.messages import VEHICLE, ActuatorCommand
from protocol.scenario import NANOSECONDS, Scenario
from protocol.wire import mapping

if TYPE_CHECKING:
    from bridge.motor_bus.drives import CanMotors

STATION_FILE = "station_emulator.tlog"
HELLO_PERIOD_S = 0.1
PROGRESS_PERIOD_NS = 100_000_000
FAREWELLS = 3
"""How often the end of the run is sent, since a datagram may be lost."""


def run_emulator(scenario: Scenario, options: EmulatorOptions, report: Report, stop: StopFlag) -> dict[str, Any]:
    """Open the link and `fly`. Raises the errors of `protocol.errors`."""
    if options.clock != "realtime" and (options.delay_ns or options.legs):
        raise UsageError(
            "--delay and --legs need real time: add --clock realtime (in lockstep the scenario's [delay] applies)"
        )
    if options.profile == "tolerant" and (options.clock != "lockstep" or options.motors):
        raise UsageError(
            "--profile tolerant needs lockstep with the gears in the plant: leave out --clock realtime and --motor can"
        )
    if options.legs and not options.out:
        raise UsageError("--legs writes time stamps to a folder: add --out DIR")
    warm_up(scenario)
    with open_patiently(options.link, options.wait_s, stop) as link:
        if options.clock == "lockstep":
            link.spin_s = options.spin_s or 0.0
        if options.legs or options.delay_ns:
            link.stamp_receives()  # a delay counts from the arrival, not from when the process reads it
        delayed = DelayedLink(link, options.delay_ns, MonotonicClock()) if options.delay_ns else link
        return fly(scenario, signed(delayed, options.key), options, report, stop)


def fly(scenario: Scenario, link: Link, options: EmulatorOptions, report: Report, stop: StopFlag) -> dict[str, Any]:
    """Run a scenario with the controller that connects to the link; returns the emulator's summary.

    The log, the ground truth and this summary (in `options.out`) are complete up to the end, also after an error. Raises
    the errors of `protocol.errors`.
    """
    log = truth = None
    try:
        if options.out:
            refuse_existing_run(options.out)
            log, truth = _open_files(scenario, link, options, options.out, report)
        endpoint = Endpoint(link, VEHICLE[0], scenario.wire.emulator_component)
        with (
            _motors(scenario, options, report, stop) as motors,
            open_station(
                options.station,
                (endpoint.writer.system, endpoint.writer.component),
                _heartbeat,
                options.out / STATION_FILE if options.out else None,
                options.wait_s,
                stop,
            ) as station,
            maybe_real_time(options.core, wanted=options.realtime) as settings,
        ):
            emulator = Emulator(scenario, endpoint, truth, motors, station)
            if options.truth_hz:
                emulator.say_truth(options.truth_hz)
            report_settings(report, settings)
            parts = Parts(emulator, endpoint, log, MonotonicClock(), stop, scenario.period_ns, scenario.ticks)
            pacing = _pacing(scenario, options, parts, settings)
            report({"event": "waiting", "link": link.uri})
            if isinstance(pacing, Tolerant):
                meet_autopilot(options.wait_s, endpoint, stop, emulator)
            else:
                meet_controller(scenario, options.wait_s, endpoint, stop, emulator)
            report({"event": "started", "peer": link.peer})
            if options.legs and isinstance(pacing, RealTime):
                pacing.legs = LegTable(TICK_COLUMNS), LegTable(ANSWER_COLUMNS)
            return _run_ticks(scenario, emulator, pacing, options.out, report, settings)
    finally:
        _close_files(log, truth)


def _open_files(
    scenario: Scenario, link: Link, options: EmulatorOptions, out: Path, report: Report
) -> tuple[TlogWriter | None, TruthWriter | None]:
    """Open the log and the ground truth of a run; None each where writing fails and the user chose to continue."""
    tell = _teller(options, report)
    source = {
        "scenario": scenario.name,
        "law": scenario.law,
        "seed": scenario.seed,
        "rate_hz": scenario.rate_hz,
        "duration_s": scenario.duration_s,
        "digest": scenario.digest().hex(),
        "clock": options.clock,
    }
    recorded = LinkOfLog(link.uri, sent_by=((VEHICLE[0], scenario.wire.emulator_component),))
    lockstep = options.clock == "lockstep"
    stamps = "simulation time" if lockstep else "Unix time"
    log = truth = None
    try:
        make_folder(out)
        write_text(out / "scenario.toml", scenario.to_toml())
        truth = TruthWriter(out / "ground_truth.npy", tell=tell)
        log = RingRecorder(out / "run.tlog", recorded, stamps=stamps, source=source, may_wait=lockstep, tell=tell)
    except RunFolderError as error:
        if tell is None:
            _close_files(log, truth)
            raise
        tell(str(error))
    return log, truth


def _teller(options: EmulatorOptions, report: Report) -> Callable[[str], None] | None:
    """The function that reports a failed write, where the user chose to continue; None: a failed write ends the run."""
    if options.on_log_error != "continue":
        return None
    return lambda sentence: report({"event": "warning", "text": f"{sentence}; the run continues"})


def warm_up(scenario: Scenario) -> None:
    """Compile every kernel of a run (or load it from the cache) before a controller waits for an answer."""
    near, far = memory_pair()
    with near, far:
        endpoint = Endpoint(near, *VEHICLE)
        emulator = Emulator(scenario, endpoint, None)
        emulator.sense(0)
        emulator.source.feed(
            endpoint.seal(
                mapping.COMMAND,
                mapping.encode_command(ActuatorCommand(0, np.zeros(6), armed=True), np.ones(6), lockstep=True),
            )
        )
        emulator.source.read()
        emulator.act(0, 0)
        emulator.check_staleness(0)
        emulator.advance(scenario.period_ns)


def _motors(
    scenario: Scenario, options: EmulatorOptions, report: Report, stop: StopFlag
) -> contextlib.AbstractContextManager[CanMotors | None]:
    """The drives on a CAN bus, if any: python-can is loaded only then."""
    if options.motors is None:
        return contextlib.nullcontext()
    from plant_emulator.drives.motor_setup import open_motors

    return open_motors(
        scenario,
        options.motors,
        options.out,
        clock=options.clock,
        wait_s=options.wait_s,
        report=report,
        stop=stop,
        tell=_teller(options, report),
    )


def _pacing(scenario: Scenario, options: EmulatorOptions, parts: Parts, settings: Settings) -> Pacing:
    if options.clock == "realtime":
        spin_ns = choose_spin_ns(parts.clock, scenario.period_ns, options.spin_s, measure=has_own_core(settings))
        through = not options.motors and parts.endpoint.link.stamp_receives()  # drives on a bus get commands at once
        return RealTime(parts, spin_ns=spin_ns, sleeps_through=through, added_delay_ns=options.delay_ns)
    keeper = RateKeeper(parts.clock, round(scenario.period_ns / options.speed)) if options.speed else None
    if options.profile == "tolerant":
        return Tolerant(parts, delay_ns=scenario.delay_ns, keeper=keeper, wait_s=options.wait_s)
    return Lockstep(parts, delay_ns=scenario.delay_ns, keeper=keeper)


def _heartbeat() -> bytes:
    return mapping.encode_emulator_heartbeat()


def _run_ticks(
    scenario: Scenario, emulator: Emulator, pacing: Pacing, out: Path | None, report: Report, settings: Settings
) -> dict[str, Any]:
    period_ns, clock = scenario.period_ns, pacing.clock
    begun_ns, processor_ns = clock.now_ns(), processor_time_ns()
    next_progress_ns = last_ns = begun_ns
    ticks_ns: list[int] = []
    done = 0
    error: FwavHilError | None = None
    try:
        for tick in range(scenario.ticks):
            t_ns = tick * period_ns
            pacing.exchange(t_ns)
            done = tick + 1
            now_ns = clock.now_ns()
            ticks_ns.append(now_ns - last_ns)
            last_ns = now_ns
            if now_ns >= next_progress_ns:
                next_progress_ns = now_ns + PROGRESS_PERIOD_NS
                pacing.flush()
                emulator.flush()
                report({"event": "progress", "t_ns": t_ns + period_ns, "q": emulator.plant.state.motion[:6].tolist()})
    except FwavHilError as stopped:
        error = stopped
    wall_ns = clock.now_ns() - begun_ns
    processor_ns = processor_time_ns() - processor_ns
    _say_farewell(emulator, pacing, done * period_ns)
    counters = {**emulator.all_counters(), **pacing.all_counters()}
    summary = {
        "clock": "realtime" if isinstance(pacing, RealTime) else "lockstep",
        "ticks": done,
        "wall_s": wall_ns / NANOSECONDS,
        "latency_us": percentiles_us(pacing.latencies_ns),
        "tick_us": percentiles_us(ticks_ns),
        "lateness_us": pacing.keeper.summary() if pacing.keeper else None,
        "realtime": settings,
        "processor_share": processor_ns / max(1, wall_ns),
        "counters": counters,
        "error": str(error) if error else None,
    }
    if isinstance(pacing.log, RingRecorder):
        pacing.log.sidecar["counters"] = counters
        pacing.log.sidecar["links"][0]["peer"] = pacing.endpoint.link.peer
    if emulator.motors:
        summary["can"] = emulator.motors.summary(done * period_ns / NANOSECONDS)
    if out:
        write_json(out / "emulator.json", summary)
        if isinstance(pacing, RealTime) and pacing.legs:
            ticks, answers = pacing.legs
            clocks = LegTable(CLOCK_COLUMNS)
            for answer in pacing.time_sync.answers:
                clocks.add(*answer)
            tables = {"ticks": ticks, "answers": answers, "clocks": clocks}
            save_legs(out / EMULATOR_FILE, tables, pacing.time_sync.estimate)
    report({"event": "ended", **summary})
    if error:
        raise error
    return summary


def _say_farewell(emulator: Emulator, pacing: Pacing, t_ns: int) -> None:
    """Tell the controller that the run is over, and log it once."""
    payload = mapping.encode_emulator_heartbeat(ending=True)
    frames = [pacing.endpoint.seal(mapping.HEARTBEAT, payload) for _ in range(FAREWELLS)]
    try:
        for frame in frames:
            pacing.endpoint.send([frame])
    except FwavHilError:
        pass  # the link may be what ended the run
    if isinstance(pacing, Lockstep):
        pacing.owe_log(t_ns // 1000, frames[:1])
    pacing.settle_log()


def _close_files(log: TlogWriter | None, truth: TruthWriter | None) -> None:
    """Close both files, the second one even if writing the first fails."""
    problem: RunFolderError | None = None
    for file in (log, truth):
        try:
            if file:
                file.close()
        except RunFolderError as error:
            problem = error
    if problem:
        raise problem
